"""Milliseconds of an iteration of Levenberg-Marquardt, and of the kernels in it, by size.

    python benchmarks/iteration.py [--baseline DIR] [--bare FILE] [--only CASE ...]

One core, medians over rounds. With ``--baseline`` another checkout takes its turn after each round,
with ``--bare`` a module with a bare loop ``lm(theta, sizes, u, y, x0, iterations)`` does so on the
small records. Kernels are compiled loops and products of rows; the rest is Python.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

SMALL = {
    "500 samples, 2 states": (500, (2, 1, 1, 1, 1, 8)),
    "500 samples, 3 states": (500, (3, 1, 1, 2, 2, 8)),
    "2000 samples, 3 states": (2000, (3, 1, 1, 2, 2, 8)),
}
"""Samples, then nx, nu, ny, nz, nw and nn."""
LARGE = {
    "boucwen": ("Bouc-Wen", 40), "parallel_wh": ("parallel Wiener-Hammerstein", 4),
    "aircraft size": ("aircraft", 4), "mirror size": ("mirror", 2),
}  # fmt: skip
"""Problems of ``problems.py``, their names here and iterations."""
LONG, MANY = "Wiener-Hammerstein", "600 records of 50 samples"
CASES = [*SMALL, *(name for name, _ in LARGE.values()), LONG, MANY]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--baseline", type=Path)
    parser.add_argument("--bare", type=Path)
    parser.add_argument("--only", nargs="*", choices=CASES, default=CASES)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--child", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.child:
        print(json.dumps(measured(given.child, given.bare)))
        return
    here = Path(__file__).resolve().parents[1]
    sides = {"here": here} | ({"baseline": given.baseline} if given.baseline else {})
    print("| case | here, ms | kernels | baseline | of it | bare loop | times that |")
    print("|---|---|---|---|---|---|---|")
    for case in given.only:
        found: dict[str, list[dict]] = {side: [] for side in sides}
        for _ in range(given.rounds):
            for side, checkout in sides.items():
                found[side].append(in_a_process(checkout, case, given.bare))
        middle = {
            f"{side} {name}": float(np.median([each[name] for each in rounds]))
            for side, rounds in found.items()
            for name in rounds[0]
        }
        own, old, bare = (
            middle.get(name) for name in ("here ms", "baseline ms", "here bare")
        )  # fmt: skip
        assert own is not None
        cells = [own, middle["here kernels"], old, old and own / old, bare, bare and own / bare]
        print(f"| {case} | " + " | ".join("" if c is None else f"{c:.3g}" for c in cells) + " |")


def in_a_process(checkout: Path, case: str, bare: Path | None) -> dict[str, float]:
    """One measurement with the package of a checkout, on the last core."""
    environment = os.environ | {"PYTHONPATH": str(checkout), "OMP_NUM_THREADS": "1"}
    words = [sys.executable, __file__, "--child", case]
    words += [] if bare is None else ["--bare", str(bare)]
    if hasattr(os, "sched_getaffinity"):
        words = ["taskset", "-c", str(max(os.sched_getaffinity(0))), *words]
    ran = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    if ran.returncode:
        raise SystemExit(ran.stderr)
    return json.loads(ran.stdout.splitlines()[-1])


def measured(case: str, bare: Path | None) -> dict[str, float]:
    """Milliseconds of an iteration and of its kernels, and of the bare loop's on a small record."""
    kernels = timed_kernels()
    import torch

    torch.set_num_threads(1)
    fit = prepared(case)
    fit(2)  # compiles
    kernels["seconds"], clock = 0.0, time.perf_counter()
    result = fit(None)
    spent = time.perf_counter() - clock
    found = {"ms": 1e3 * result.seconds_per_iteration}
    # What the kernels take of all the time, of one iteration.
    found["kernels"] = found["ms"] * kernels["seconds"] / spent
    if bare is not None and case in SMALL:
        found["bare"] = bare_loop(bare, case)
    return found


def timed_kernels() -> dict[str, float]:
    """Seconds that compiled loops and products take from now on; before the package is used."""
    from lfrtorch._support import threads
    from lfrtorch.least_squares import linear_systems

    total = {"seconds": 0.0}

    def timed(function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*given: Any) -> Any:
            clock = time.perf_counter()
            found = function(*given)
            total["seconds"] += time.perf_counter() - clock
            return found

        return call

    outer = "spread_loop" if hasattr(threads, "spread_loop") else "spread"
    made = timed(getattr(threads, outer))
    for module in [m for n, m in sys.modules.items() if n.startswith("lfrtorch")]:
        if hasattr(module, outer):
            setattr(module, outer, made)
    linear_systems.product = timed(linear_systems.product)
    return total


def prepared(case: str) -> Callable[[int | None], Any]:
    """A fit of a case that is asked for some iterations; None: as many as are timed."""
    import lfrtorch

    def of(start: Callable[[], Any], records: Any, usual: int) -> Callable[[int | None], Any]:
        def fit(count: int | None) -> Any:
            trainer = lfrtorch.LevenbergMarquardt(max_iter=count or usual)
            return lfrtorch.fit(start(), records, trainer=trainer, monitors=[])

        return fit

    if case in SMALL:
        u, y = signals(SMALL[case][0])
        nx, _, _, nz, nw, nn = SMALL[case][1]
        data, usual = [lfrtorch.Record(u, y, fs=1.0)], 60
    elif case == MANY:
        nx, nz, nw, nn, usual = 2, 1, 1, 5, 12
        whole = [signals(50, seed) for seed in range(600)]
        data = [lfrtorch.Record(u, y, fs=1.0, start="estimated") for u, y in whole]
    elif case == LONG:
        nx, nz, nw, nn, usual = 6, 1, 1, 15, 6
        data = [lfrtorch.Record(*signals(100_000), fs=1.0)]
    else:
        return of_problem(case, of)
    bla = lfrtorch.estimate_bla(data[:30], nx)
    start = lambda: lfrtorch.initialise(bla, data, nz=nz, nw=nw, nn=nn, seed=0)  # noqa: E731
    return of(start, data, usual)


def of_problem(case: str, of: Callable[..., Any]) -> Any:
    """A fit of a prepared problem."""
    import problems

    import lfrtorch

    name, (_, usual) = next((n, v) for n, v in LARGE.items() if v[0] == case)
    folder = Path(tempfile.mkdtemp())
    problems.prepare(folder, None)
    return of(lambda: lfrtorch.load(folder / name), problems.records(folder, name), usual)


def signals(samples: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Input and output of a spring that stiffens, with noise."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.standard_normal(samples // 5 + 1), 5)[:samples, None]
    y, x, v = np.zeros(samples), 0.0, 0.0
    for k in range(samples):
        y[k] = x
        x, v = x + 0.2 * v, 0.8 * v + 0.2 * (u[k, 0] - x - 0.5 * x**3)
    return u, (y + 0.01 * rng.standard_normal(samples))[:, None]


def bare_loop(path: Path, case: str) -> float:
    """Milliseconds of an iteration of the bare loop."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules[path.stem] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    samples, sizes = SMALL[case]
    (u, y), (nx, nu, ny, nz, nw, nn) = signals(samples), sizes
    count = nx * (nx + nu + nw) + nz * (nx + nu) + ny * (nx + nu + nw) + nn * (nz + 1 + nw) + nw
    theta = 0.3 * np.random.default_rng(1).standard_normal(count)
    theta[: nx * nx] = (0.8 * np.eye(nx)).ravel()
    found = []
    with np.errstate(over="ignore", invalid="ignore"):
        for iterations in (2, 100, 100, 100):
            clock = time.perf_counter()
            done = module.lm(theta, sizes, u, y, np.zeros(nx), iterations)[2]
            found.append(1e3 * (time.perf_counter() - clock) / max(done, 1))
    return float(np.median(found[1:]))


if __name__ == "__main__":
    main()
