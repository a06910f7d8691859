"""Operation count of an iteration beside its seconds, part by part, at three sizes.

    python benchmarks/parts.py

prints the table of docs/guide/engine.md: one core, records in periodic steady state.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from unittest import mock

import problems
import torch
from cases import ENDLESS, NEARBY, RESTART, parts, search
from engine import available_cores, pinned
from scaling import operations

from lfrtorch._support.threads import spread_by_hand
from lfrtorch.engine import simulation
from lfrtorch.engine.nonlinearity import Network
from lfrtorch.least_squares.jacobian import CACHED_BYTES, OutputRows
from lfrtorch.least_squares.problem import Problem

NAMES = {"boucwen": "Bouc-Wen", problems.AIRCRAFT: "aircraft", problems.MIRROR: "mirror"}
REPETITIONS = 5


def main() -> None:
    """Measure and print."""
    argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0]).parse_args()
    torch.set_num_threads(1)
    columns, sizes = [], []
    with tempfile.TemporaryDirectory() as scratch, pinned(available_cores()[-1:]):
        folder = Path(scratch)
        problems.prepare(folder, None)
        for name, short in NAMES.items():
            with spread_by_hand():
                problem = problems.problem(folder, name)
                counted = counts(problem)
                measured = parts(folder, name, REPETITIONS)["parts_s"]
            measured["one iteration, one trial"] = (
                2 * measured["simulation of a trial"]
                + measured["linearisation"]
                + measured["rows and normal equations"]
                + 2 * measured["Cholesky solution"]
                + measured["tangent"]
                + measured["adjoint"]
            )
            cell = problem.lfr.cell
            samples = sum(group.u.shape[0] * group.u.shape[1] for group in problem.errors.groups)
            sizes.append(
                f"{short}: {cell.nx} states, {cell.ny} outputs, {samples} samples, "
                f"{len(problem.theta)} parameters"
            )
            columns.append({part: (counted[part], measured[part]) for part in counted})
    print("\n".join(sizes))
    print("\n| part | " + " | ".join(f"{short}: 10⁶, ms, 10⁹/s" for short in NAMES.values()) + " |")
    print("|---" * (1 + len(NAMES)) + "|")
    for part in columns[0]:
        cells = []
        for column in columns:
            count, seconds = column[part]
            cells.append(f"{count / 1e6:.3g}, {1e3 * seconds:.3g}, {count / seconds / 1e9:.2g}")
        print(f"| {part} | " + " | ".join(cells) + " |")


def counts(problem: Problem) -> dict[str, float]:
    """Operations of each part that ``cases.parts`` measures, and of an iteration."""
    state, _ = search(problem, RESTART)
    with mock.patch.object(simulation, "_compiled", wraps=simulation._compiled) as passes:
        problem.residual(state.theta * next(NEARBY))
        problem.residual(ENDLESS.step(problem, state).theta * next(NEARBY))
    cell, reduced = problem.lfr.cell, problem.linearise(state.theta)._reduced
    part = problem.linearise(state.theta).parts[0]
    assert isinstance(part, OutputRows)
    by_x, _, by_y = part.linearisation.layout.columns(reduced.kept)[:3]
    rows = sum(group.y.numel() for group in problem.errors.groups)
    K, nx = len(reduced.kept), cell.nx
    assert isinstance(cell.static, Network)
    about = {
        "samples": rows // cell.ny,
        "ports": cell.ny,
        "inputs": cell.nu,
        **{"nx": nx, "nz": cell.nz, "nw": cell.nw, "nn": cell.static.bz.shape[-1]},
        **{"P": len(problem.theta), "K": K, "Kx": len(by_x), "Ky": len(by_y)},
        "cached": 8 * rows * (K + nx + 1) <= CACHED_BYTES,
    }
    each = operations(about)
    # The initial state of a period has nx columns, which are those of the state equation.
    wider = operations(about | {"K": K + nx, "Kx": len(by_x) + nx})
    rows_of = "rows" if "rows" in wider else "rows in blocks"
    found = {
        "simulation of a trial": passes.call_count / 2 * each["two simulations"] / 2,
        "linearisation": each["slopes"] + each["gauge"],
        "rows and normal equations": wider[rows_of]
        + wider["normal equations"]
        + each["reduced coordinates"],
        "Cholesky solution": each["two Cholesky solutions"] / 2,
        "tangent": each["tangent and adjoint"] / 2,
        "adjoint": each["tangent and adjoint"] / 2,
    }
    twice = found["simulation of a trial"] + found["Cholesky solution"]
    return found | {"one iteration, one trial": sum(found.values()) + twice}


if __name__ == "__main__":
    main()
