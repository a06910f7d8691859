"""Seconds of one Levenberg-Marquardt iteration, part by part, at the size of the Bouc-Wen case.

    python benchmarks/lm_iteration.py [--threads 1] [--out result.json]

Medians over repetitions in one process, after compilation; no file is needed (the data are
simulated). Compare the numbers of one run with each other: machines and loads differ.
"""

from __future__ import annotations

import argparse
import json
import platform
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

import lfrtorch
from lfrtorch.residual import SimulationError

REPETITIONS = 15


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=Path, help="write the result as JSON")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)

    data = lfrtorch.datasets.boucwen.load()
    bla = lfrtorch.estimate_bla(data.train, 3, offset=False)
    model = lfrtorch.initialise(bla, data.train, nz=2, nw=1, nn=15)
    problem = SimulationError(model, data.train, ridge=1e-3)
    optimiser = lfrtorch.LevenbergMarquardt(max_iter=1000)
    state = optimiser.init(problem, problem.theta)

    steps = []
    for _ in range(REPETITIONS + 5):
        begin = time.perf_counter()
        state = optimiser.step(problem, state)
        steps.append((time.perf_counter() - begin, state.trials))
    theta = state.theta
    J = problem.jacobian(theta)
    result = {
        "one iteration": float(np.median([s for s, _ in steps[5:]])),
        "trials in it": float(np.median([trials for _, trials in steps[5:]])),
        "residual (one simulation)": median(lambda: problem.residual(theta.clone())),
        "Jacobian": median(lambda: problem.jacobian(theta)),
        "R factor and its SVD": median(lambda: torch.linalg.svd(torch.linalg.qr(J, mode="r").R)),
        "gradient (one Adam step)": median(lambda: problem.gradient(theta)),
    }
    print(
        f"{len(data.train[0].u)} samples, {model.parameters} parameters, {options.threads} threads"
    )
    for name, value in result.items():
        print(f"{name:28} {value:6.1f}" if "trials" in name else f"{name:28} {1e3 * value:6.1f} ms")
    if options.out is not None:
        about = {"threads": options.threads, "machine": platform.processor() or platform.machine()}
        options.out.write_text(json.dumps({**about, **result}, indent=2) + "\n")


def median(function: Callable[[], object]) -> float:
    """Median seconds of a call."""
    function()
    seconds = []
    for _ in range(REPETITIONS):
        begin = time.perf_counter()
        function()
        seconds.append(time.perf_counter() - begin)
    return float(np.median(seconds))


if __name__ == "__main__":
    main()
