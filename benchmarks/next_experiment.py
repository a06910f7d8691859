"""The next experiment beside a flat multisine of the same rms, on two simulated plants.

    python benchmarks/next_experiment.py [--runs 10] [--only saturation hysteresis] [--show]

saturation   a resonance at 5 Hz behind an amplifier that saturates, at 100 Hz
hysteresis   a Bouc-Wen system, at 750 Hz, as in benchmarks/update.py

A first model is fitted to 1000 samples of a flat multisine. Then N samples are measured: of
``next_experiment`` for this model, within the same rms and peak, or of a flat multisine, N or 2 N
of them. The model is fitted to all data. Printed: the rms error on noise-free data of the plant,
a flat multisine and a staircase, as the mean of the runs; and in how many runs N designed samples
are better than 2 N flat ones.
"""

from __future__ import annotations

import argparse
from copy import deepcopy
from typing import Any

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from update import hysteresis

import lfrtorch
from lfrtorch import LevenbergMarquardt, Model, Record

Array = NDArray[np.float64]
FIRST, NEXT = 1000, 1000
SHOWN: list[bool] = []  # whether each experiment is printed
PEAK = 3.5  # largest input over its rms


@njit
def saturation(u: Array) -> Array:
    """Position of a resonance driven by tanh of the input, in Euler steps of 1 ms."""
    x, v, y, omega = 0.0, 0.0, np.empty(len(u)), 2 * np.pi * 5.0
    for i in range(len(u)):
        y[i] = x
        for _ in range(10):
            v += 1e-3 * (omega**2 * (np.tanh(u[i]) - x) - 2 * 0.1 * omega * v)
            x += 1e-3 * v
    return y


class Plant:
    """A plant with its rate, the rms of its input, its noise, and the sizes of its model."""

    def __init__(self, name: str) -> None:
        self.name = name
        slow = name == "saturation"
        self.fs, self.rms, self.noise = (100.0, 1.0, 0.02) if slow else (750.0, 50.0, 8e-6)
        self.sizes = (
            {"nx": 2, "nz": 1, "nw": 1, "nn": 5} if slow else {"nx": 3, "nz": 2, "nw": 2, "nn": 8}
        )

    def record(self, u: Array, seed: int | None, name: str) -> Record:
        """A measurement from rest; without a seed it has no noise."""
        y = saturation(u) if self.name == "saturation" else hysteresis(u, 1.0, 1 / 750)
        if seed is not None:
            y = y + self.noise * np.random.default_rng(seed).standard_normal(len(y))
        return Record(u, y, fs=self.fs, name=name)

    def flat(self, samples: int, seed: int) -> Array:
        """A flat multisine of all lines, cut off at the limits."""
        u = lfrtorch.multisine(samples, rms=self.rms, seed=seed).u[0, :, 0]
        return np.clip(u, -PEAK * self.rms, PEAK * self.rms)

    def fitted(self, records: list[Record]) -> Model:
        """The best of four starts."""
        bla = lfrtorch.estimate_bla(records, nx=self.sizes["nx"])
        sizes: Any = {name: size for name, size in self.sizes.items() if name != "nx"}
        starts = [lfrtorch.initialise(bla, records, **sizes, seed=s) for s in range(4)]
        return lfrtorch.fit(
            starts, records, trainer=LevenbergMarquardt(max_iter=80), monitors=[]
        ).model

    def again(self, model: Model, records: list[Record]) -> Model:
        """The model, fitted to more records."""
        model = deepcopy(model)
        lfrtorch.fit(model, records, trainer=LevenbergMarquardt(max_iter=80), monitors=[])
        return model


def run(plant: Plant, seed: int) -> list[float]:
    """Errors of the first model, and after N designed, N flat and 2 N flat samples."""
    rng = np.random.default_rng(1000 + seed)
    stairs = np.repeat(plant.rms * rng.uniform(-1.7, 1.7, 200), 20)
    tests = [plant.record(u, None, "test") for u in (plant.flat(4000, 500 + seed), stairs)]
    first = plant.record(plant.flat(FIRST, seed), seed, "first")
    model = plant.fitted([first])
    limits = {"u": (-PEAK * plant.rms, PEAK * plant.rms), "rms": plant.rms}
    designed = lfrtorch.next_experiment(model, first, limits=limits, samples=NEXT, seed=seed)
    if SHOWN:
        print(designed)
    inputs = [designed.record.u[:, 0], *(plant.flat(n * NEXT, 100 + seed) for n in (1, 2))]
    models = [plant.again(model, [first, plant.record(u, 200 + seed, "next")]) for u in inputs]

    def error(one: Model) -> float:
        return float(np.sqrt(np.mean([lfrtorch.rmse(t, one.simulate(t)) ** 2 for t in tests])))

    return [error(one) for one in (model, *models)]


def main() -> None:
    """Run the plants."""
    parser = argparse.ArgumentParser(description=str(__doc__).split("\n", maxsplit=1)[0])
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--only", nargs="*", default=["saturation", "hysteresis"])
    parser.add_argument("--show", action="store_true", help="print each experiment")
    given = parser.parse_args()
    SHOWN.extend([True] * given.show)
    torch.set_num_threads(2)
    for name in given.only:
        plant = Plant(name)
        errors = np.array([run(plant, seed) for seed in range(given.runs)])
        mean = np.sqrt((errors**2).mean(0))
        won = int((errors[:, 1] < errors[:, 3]).sum())
        print(
            f"{name:10} first {mean[0]:.4g}; {NEXT} designed {mean[1]:.4g}, {NEXT} flat "
            f"{mean[2]:.4g}, {2 * NEXT} flat {mean[3]:.4g}; better than these in {won} of "
            f"{given.runs}; median ratio {np.median(errors[:, 1] / errors[:, 3]):.3f}", flush=True
        )  # fmt: skip


if __name__ == "__main__":
    main()
