"""One measurement in a process of its own, so that its memory and compile time are its own.

    python benchmarks/cases.py CASE FOLDER [--threads 2] [--set name=value ...]

prints one line of JSON; ``engine.py`` calls it.
"""

from __future__ import annotations

import argparse
import ctypes
import gc
import itertools
import json
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Literal

import numpy as np
import problems
import torch

import lfrtorch
from lfrtorch._support.threads import spread_by_hand
from lfrtorch.least_squares.gauge import reduction
from lfrtorch.least_squares.jacobian import CACHED_BYTES
from lfrtorch.least_squares.levenberg_marquardt import LMState
from lfrtorch.least_squares.problem import Problem

NEARBY = (1.0 + 1e-12 * i for i in itertools.count())
"""Factors of what is kept from one call to the next if it is the same."""
ENDLESS = lfrtorch.LevenbergMarquardt(max_iter=10**9, tolerance=0.0, least_damping=1.0)
"""Its first iteration is like the others: it does not lower the damping in several trials."""
REPETITIONS = 15
RESTART = 4
"""Steps from the start that nearly always accept their first trial."""
LONG_ENOUGH = 1.0
"""Seconds to measure a point for."""


def main() -> None:
    """Measure one case and print it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("case", choices=CASES)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--begun", type=float, default=time.time(), help="start of the process")
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME=JSON")
    options = parser.parse_args()
    imports = time.time() - options.begun - waited()
    torch.set_num_threads(options.threads)
    settings = {name: json.loads(value) for name, value in (s.split("=", 1) for s in options.set)}
    idle, begin, waited_before = start_of_peak(), time.perf_counter(), waited("task/*")
    with spread_by_hand():  # as a fit does
        result = CASES[options.case](options.folder, **settings)
    peak = status("VmHWM")
    about = {
        "imports_s": imports,
        "memory_mb": None if peak is None or idle is None else peak - idle,
        "waited": (waited("task/*") - waited_before) / (time.perf_counter() - begin),
    }
    print(json.dumps({**about, **result}))


def prepare(folder: Path, peers: str | None = None) -> dict:
    """Write the records and the models that the others read."""
    return {"parameters": problems.prepare(folder, None if peers is None else Path(peers))}


def iteration(folder: Path, name: str, count: int, records: int | None = None) -> dict:
    """The first iterations of a fit: trial simulations, acceleration, Jacobian, factor."""
    problem = problems.problem(folder, name, count=records)
    _, steps = search(problem, count)
    seconds = [s for s, _ in steps]
    return {
        "iterations": len(steps),
        "s": float(np.median(seconds)),
        "one_trial_s": one_trial(steps),
        "trials": float(np.mean([trials for _, trials in steps])),
        "trial_s": sum(seconds) / sum(trials for _, trials in steps),
    }


def parts(folder: Path, name: str, repetitions: int = REPETITIONS) -> dict:
    """What an iteration is made of."""
    problem = problems.problem(folder, name)
    state, _ = search(problem, RESTART)
    ahead = ENDLESS.step(problem, state).theta
    jacobian = problem.linearise_at(state.point)
    system, gradient = jacobian.system(1.0, ENDLESS.truncation)
    residual = state.residual

    def simulated_anew() -> None:
        problem.evaluate(ahead * next(NEARBY), state.point)

    def linearised() -> None:
        problem.linearise_at(state.point)

    measured = {
        "simulation of a trial": median(simulated_anew, repetitions),
        "linearisation": median(linearised, repetitions),
        "rows and normal equations": median(lambda: jacobian.system(1.0, 1e-12), repetitions),
        "rows and QR": median(lambda: jacobian.system(0.0, 1e-12), repetitions),
        "Cholesky solution": median(
            lambda: system.solve(gradient, system.scale * next(NEARBY)), repetitions
        ),
        "tangent": median(lambda: jacobian.tangent(gradient), repetitions),
        "adjoint": median(lambda: jacobian.adjoint(residual), repetitions),
    }
    return {"parts_s": measured}


def long(folder: Path, start: Literal["periodic", "zero"], periods: int) -> dict:
    """One record of many periods beside one of a single period."""
    problem = problems.problem(folder, "boucwen", start=start, periods=periods)
    seconds = one_trial(search(problem, 1 + RESTART)[1][1:])
    samples = problem.size
    del problem
    short = problems.problem(folder, "boucwen", start=start)
    theta = short.theta
    steps = [step for _ in range(5) for step in search(short, RESTART, theta)[1]]
    short_seconds = one_trial(steps[1:])
    ratio = seconds / samples / (short_seconds / short.size)
    return {"samples": samples, "s": seconds, "short_s": short_seconds, "ratio": ratio}


def gradient(folder: Path) -> dict:
    """One gradient, in steady state and from rest, and the latter by a loop in Python."""
    periodic = problems.problem(folder, "boucwen")
    problem = problems.problem(folder, "boucwen", ridge=0.0, start="zero")
    # Away from the start, where the network gives zero.
    theta = search(problem, RESTART)[0].theta
    own = problem.gradient(theta)[1]
    seconds, plain = [], own
    for _ in range(3):
        begin = clock()
        plain = problems.plain_gradient(problem, theta)
        seconds.append(clock() - begin)
    return {
        "s": median(lambda: periodic.gradient(theta * next(NEARBY))),
        "from_rest_s": median(lambda: problem.gradient(theta * next(NEARBY))),
        "python_loop_s": float(np.median(seconds)),
        "difference": float((plain - own).norm() / own.norm()),
    }


def scaling(folder: Path, axis: str, values: list[int], sizes: dict[str, int]) -> dict:
    """Seconds of an iteration with one accepted trial, from rest, against one size."""
    del folder
    points = []
    for value in values:
        idle = start_of_peak()
        model, problem = problems.synthetic(**{**sizes, axis: value})
        start_of_peak()  # that of the iterations; the start and its data are made by other code
        theta = problem.theta
        search(problem, 1, theta)
        steps: list[tuple[float, int]] = []
        begin = clock()
        while not one_trials(steps) or (clock() - begin < LONG_ENOUGH and len(steps) < 40):
            steps += search(problem, RESTART, theta)[1]
        cell, rows = model.lfr.cell, sum(group.y.numel() for group in problem.errors.groups)
        kept = reduction(cell, torch.zeros(0, cell.nx).to(cell.A)).kept
        layout = cell.weights().layout
        by_x, _, by_y = layout.direct_terms(layout.free[kept.numpy()])[:3]
        shape = {"P": model.parameter_count, "K": len(kept), "Kx": len(by_x)}
        shape |= {"Ky": len(by_y), "cached": 8 * rows * (len(kept) + 1) <= CACHED_BYTES}
        ports = {"samples": rows // cell.ny, "ports": cell.ny}
        point = {**ports, **model.sizes, **shape, "value": value, "s": one_trial(steps)}
        peak = status("VmHWM")
        points.append({**point, "memory_mb": None if not peak or not idle else peak - idle})
        del problem
    return {"points": points}


def first_call(folder: Path) -> dict:
    """Linear model, start and first iteration of a fit, twice in a process."""
    data = problems.records(folder, "boucwen")
    runs = []
    for _ in range(2):
        stages, last = {}, clock()

        def stage(name: str, stages: dict = stages) -> None:
            nonlocal last
            stages[name] = clock() - last
            last = clock()

        bla = lfrtorch.estimate_bla(data, 3, offset=False)
        stage("estimate_bla")
        model = lfrtorch.initialise(bla, data, nz=2, nw=1, nn=15)
        stage("initialise")
        search(Problem.of(model, data, ridge=problems.RIDGE), 1)
        stage("first iteration")
        runs.append(stages)
    return {"first_s": runs[0], "again_s": runs[1]}


def search(
    problem: Problem, count: int, theta: torch.Tensor | None = None
) -> tuple[LMState, list[tuple[float, int]]]:
    """State of the search after ``count`` iterations, and seconds and trials of each."""
    state = ENDLESS.init(problem, problem.theta if theta is None else theta.clone())
    steps = []
    for _ in range(count):
        begin = clock()
        state = ENDLESS.step(problem, state)
        steps.append((clock() - begin, state.trials))
    return state, steps


def one_trial(steps: list[tuple[float, int]]) -> float:
    """Median seconds of the iterations that accept their first trial."""
    return float(np.median(one_trials(steps)))


def one_trials(steps: list[tuple[float, int]]) -> list[float]:
    """Seconds of each of these."""
    return [s for s, trials in steps if trials == 1]


def median(function: Callable[[], object], repetitions: int = REPETITIONS) -> float:
    """Median seconds of a call."""
    function()
    seconds = []
    for _ in range(repetitions):
        begin = clock()
        function()
        seconds.append(clock() - begin)
    return float(np.median(seconds))


def clock() -> float:
    """Seconds of this thread, less those that it waited for a core that others had."""
    return time.perf_counter() - waited()


def waited(threads: str = "") -> float:
    """Seconds that threads of this process could run and had no core; 0 if not known."""
    files = Path("/proc/self").glob(f"{threads}/schedstat" if threads else "schedstat")
    with suppress(OSError):
        return sum(int(file.read_text().split()[1]) for file in files) / 1e9
    return 0.0


def start_of_peak() -> float | None:
    """Forget the peak memory so far; MB in use now, without what could be given back."""
    gc.collect()
    with suppress(OSError, AttributeError):  # of a C library that has it
        ctypes.CDLL(None).malloc_trim(0)
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
    return status("VmRSS")


def status(entry: str) -> float | None:
    """MB of an entry of /proc/self/status; None if there is no such file."""
    with suppress(OSError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith(f"{entry}:"):
                return int(line.split()[1]) / 1024
    return None


CASES = {f.__name__: f for f in (prepare, iteration, parts, long, gradient, scaling, first_call)}

if __name__ == "__main__":
    sys.exit(main())
