"""One side of a comparison: times cases as it is asked, in a process that stays.

    PYTHONPATH=CHECKOUT python benchmarks/baseline_side.py FOLDER

``baseline.py`` starts it, writes the name of a case a line and reads a line of JSON: the CPU
seconds, and a number that is the same on both sides if they did the same work. Only names of the
public interface stand here, so that older checkouts run as well.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch

import lfrtorch
from lfrtorch import LevenbergMarquardt, Model, Record

NAMES = ("boucwen", "parallel_wh", "aircraft size", "mirror size")
RIDGE = 1e-3
"""Ridge of conf/bench/boucwen.yaml."""
CUTS = (0, 1024, 2048, 3072, 5120, 8192)
"""Where the Bouc-Wen record is cut: three records of one length and two of others."""
ONE_TRIAL: dict = {name: 1.0 for name in ("least_damping",) if hasattr(LevenbergMarquardt, name)}
"""Older searches do not lower the damping within the first iteration; nor does ours then."""

Timed = tuple[float, float]


def main() -> None:
    """Answer until there are no more questions."""
    folder = Path(sys.argv[1])
    torch.set_num_threads(1)
    print(json.dumps({"package": lfrtorch.__file__}), flush=True)
    for line in sys.stdin:
        seconds, outcome = CASES[line.strip()](folder)
        print(json.dumps({"seconds": seconds, "outcome": outcome}), flush=True)


def prepare(folder: Path) -> Timed:
    """Save the models that both sides start from."""
    begin = time.process_time()
    for name in NAMES:
        with np.load(folder / f"{name}.npz") as file:
            nx, nz, nw, nn = (int(file[size]) for size in ("nx", "nz", "nw", "nn"))
            system = [file[matrix] for matrix in "ABCD" if matrix in file]
            fs = float(file["fs"])
        data = records(folder, name)
        if system:
            A, B, C, D = system
            inputs, outputs = data[0].inputs, data[0].outputs
            operating_point = np.zeros(len(inputs)), np.zeros(len(outputs))
            bla = lfrtorch.LinearModel(A, B, C, D, fs, *operating_point, inputs, outputs)
        else:
            bla = lfrtorch.estimate_bla(data, nx, offset=False, max_iter=3)
        lfrtorch.initialise(bla, data, nz=nz, nw=nw, nn=nn).save(folder / name)
    return time.process_time() - begin, 0.0


def iterations(folder: Path, name: str, count: int, *, cut: bool = False) -> Timed:
    """An iteration of a fit by Levenberg-Marquardt, the mean of the first ones."""
    data = records(folder, name)
    if cut:
        whole = data[0]
        data = [replace(whole[first:last], start="estimated") for first, last in pairwise(CUTS)]
    model = lfrtorch.load(folder / name)
    trainer: dict = {"trainer": LevenbergMarquardt(max_iter=count, tolerance=0.0, **ONE_TRIAL)}
    begin = time.process_time()
    result = lfrtorch.fit(model, data, ridge=RIDGE, **trainer)
    return (time.process_time() - begin) / count, result.history[-1].score


def simulations(folder: Path, name: str, count: int) -> Timed:
    """A simulation of all records, physical units in and out."""
    model, data = lfrtorch.load(folder / name), records(folder, name)
    return mean_of(count, lambda: simulated(model, data))


def linear(folder: Path, count: int) -> Timed:
    """The best linear approximation of the Bouc-Wen record."""
    data = records(folder, "boucwen")
    return mean_of(count, lambda: lfrtorch.estimate_bla(data, 3).simulate(data[0]).std())


def simulated(model: Model, data: list[Record]) -> float:
    """RMS of the outputs."""
    outputs = np.concatenate([model.simulate(record) for record in data])
    return float(np.sqrt(np.mean(outputs**2)))


def mean_of(count: int, call: Callable[[], float]) -> Timed:
    """Mean CPU seconds of some calls, and what the last one returned."""
    outcome = 0.0
    begin = time.process_time()
    for _ in range(count):
        outcome = call()
    return (time.process_time() - begin) / count, float(outcome)


def records(folder: Path, name: str) -> list[Record]:
    """The records of a problem, in steady state."""

    with np.load(folder / f"{name}.npz") as file:
        pairs = zip(file["u"], file["y"], strict=True)
        return [Record(u, y, fs=float(file["fs"]), start="periodic") for u, y in pairs]


MEASURED: dict[str, Callable[[Path], Timed]] = {
    "Bouc-Wen, iteration": partial(iterations, name="boucwen", count=4),
    "Bouc-Wen in 5 records, iteration": partial(iterations, name="boucwen", count=3, cut=True),
    "Parallel WH, iteration": partial(iterations, name="parallel_wh", count=1),
    "Aircraft size, iteration": partial(iterations, name="aircraft size", count=2),
    "Mirror size, iteration": partial(iterations, name="mirror size", count=2),
    "Bouc-Wen, simulation": partial(simulations, name="boucwen", count=30),
    "Parallel WH, simulation": partial(simulations, name="parallel_wh", count=2),
    "Bouc-Wen, linear model": partial(linear, count=1),
}
CASES = {"prepare": prepare, **MEASURED}

if __name__ == "__main__":
    main()
