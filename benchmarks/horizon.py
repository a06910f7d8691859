"""Fits over windows against fits of whole records, where these may end in a poor minimum.

    python benchmarks/horizon.py [--runs 10] [--horizons 50 200] [--only wells cycle start]

Three systems with two states, sampled at 0.1 s, with noise of 1 % of the output's rms:

wells   a mass between two wells of its potential, driven by noise from one to the other:
        x'' = -0.3 x' + x - x³ + u; which well it is in after a while is chaotic
cycle   the oscillator of van der Pol, x'' = 1.5 (1 - x²) x' - x + u, unstable at rest
start   a lightly damped spring that softens, from a linear part whose poles are at the wrong
        frequency, by up to 40 %, as if the linear model had failed

Of each run 3000 samples train, 600 validate and 2000 test. Models of nx = 2, nz = 2, nw = 1 and
eight neurons start from the linear model and are fitted 60 iterations at most. Printed for each
run and, in the end, as medians: the test's error over its rms, in 100 samples from where a state
was estimated from the 30 before, and of the whole simulation; and seconds of processor time.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace

import numpy as np
import scipy
import torch

import lfrtorch
from lfrtorch._support.types import Array
from lfrtorch.data.metrics import rms

STEP, NOISE = 0.1, 0.01
TRAIN, VALIDATION, TEST = 3000, 600, 2000
AHEAD, BEFORE = 100, 30


def wells(x: float, v: float, u: float) -> float:
    """Acceleration of the mass between two wells."""
    return -0.3 * v + x - x**3 + u


def cycle(x: float, v: float, u: float) -> float:
    """That of the oscillator of van der Pol."""
    return 1.5 * (1.0 - x**2) * v - x + u


def spring(x: float, v: float, u: float) -> float:
    """That of a mass at a softening spring."""
    return -0.1 * v - 4.0 * np.tanh(x) + u


SYSTEMS: dict[str, tuple[Callable[[float, float, float], float], float]] = {
    "wells": (wells, 1.0), "cycle": (cycle, 0.5), "start": (spring, 1.5)
}  # fmt: skip
"""Accelerations, and the rms of the input."""


def measured(system: str, samples: int, rng: np.random.Generator) -> lfrtorch.Record:
    """A record amid a measurement."""
    force, level = SYSTEMS[system]
    u = scipy.signal.lfilter(*scipy.signal.butter(2, 0.2), rng.standard_normal(samples + 200))
    u *= level / rms(u)
    y, x, v = np.zeros(len(u)), 0.1 * rng.standard_normal(), 0.0
    for k in range(len(u)):
        y[k] = x
        for _ in range(4):
            v += STEP / 4 * force(x, v, u[k])
            x += STEP / 4 * v
    y += NOISE * rms(y) * rng.standard_normal(len(y))
    return lfrtorch.Record(u[200:], y[200:], fs=1 / STEP, start="estimated", name=system)


def spoilt(model: lfrtorch.Model, rng: np.random.Generator) -> lfrtorch.Model:
    """The model with poles at another frequency."""
    model = deepcopy(model)
    A = model.lfr.cell.A.detach().numpy()
    values, vectors = np.linalg.eig(A)
    turned = np.abs(values) * np.exp(1j * np.angle(values) * rng.choice([0.6, 0.8, 1.2, 1.4]))
    with torch.no_grad():
        moved = (vectors * turned) @ np.linalg.inv(vectors)
        model.lfr.cell.A.copy_(torch.as_tensor(moved.real))
    return model


def relative(model: lfrtorch.Model, record: lfrtorch.Record, length: int) -> float:
    """Error in stretches of ``length`` samples over the output's rms."""
    errors: list[Array] = []
    for begin in range(0, record.samples - length - BEFORE + 1, length):
        part = record[begin : begin + BEFORE + length]
        part = replace(part, start="estimated", skip=BEFORE)
        errors.append((model.simulate(part) - part.y)[BEFORE:])
    found = float(rms(np.concatenate(errors)) / np.std(record.y))
    return found if np.isfinite(found) else np.inf


def main() -> None:
    """Read the command line and print the errors."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=10, help="realisations of each system")
    parser.add_argument("--first", type=int, default=0, help="seed of the first")
    parser.add_argument("--horizons", nargs="+", type=int, default=[50, 200])
    parser.add_argument("--only", nargs="+", choices=SYSTEMS, default=list(SYSTEMS))
    args = parser.parse_args()
    torch.set_num_threads(1)
    for system in args.only:
        errors: dict[int | None, list[tuple[float, ...]]] = {h: [] for h in (None, *args.horizons)}
        for seed in range(args.first, args.first + args.runs):
            rng = np.random.default_rng(seed)
            train, validation, test = (measured(system, n, rng) for n in (TRAIN, VALIDATION, TEST))
            validation = replace(validation, skip=BEFORE)
            linear = lfrtorch.estimate_bla(train, 2)
            start = lfrtorch.initialise(linear, train, nz=2, nw=1, nn=8, seed=seed)
            start = spoilt(start, rng) if system == "start" else start
            for horizon, found in errors.items():
                clock = time.process_time()
                result = lfrtorch.fit(
                    deepcopy(start), train, validation, horizon=horizon, monitors=[],
                    trainer=lfrtorch.LevenbergMarquardt(max_iter=60),
                )  # fmt: skip
                model, seconds = result.model, time.process_time() - clock
                whole = relative(model, test, TEST - BEFORE)
                found.append((relative(model, test, AHEAD), whole, seconds))
                print(system, seed, horizon, *(f"{value:.4f}" for value in found[-1]), flush=True)
        for horizon, found in errors.items():
            near, whole, seconds = np.median(found, axis=0)
            good = sum(error[0] < 3 * NOISE for error in found)
            print(
                f"{system}, horizon {horizon}: {near:.4f} {whole:.4f} {seconds:.1f} s, "
                f"{good} of {len(found)} within 3 times the noise"
            )


if __name__ == "__main__":
    main()
