"""Noise inside the system: the fit of predictions against that of the simulation error.

    python benchmarks/noise.py [--runs 50] [--samples 500 2000 8000] [--only innovations states]
    python benchmarks/noise.py --circuit 2
    python benchmarks/noise.py --observer
    python benchmarks/noise.py --iteration 6 8 12
    python benchmarks/noise.py --folds DIR

An oscillator with a softening spring (two states, one neuron) is driven by white noise of unit
variance. A force that nobody measures acts on it, and its sensor has noise: as innovations with the
gain of the Kalman filter about rest, or on the states and the output. ``SNR`` is the power of the
output without noise over that of what noise adds. Models of nx = 2, nz = nw = 1 and four neurons
start from linear models and are fitted 40 iterations at most.

Printed: the median over the runs of the error against the true output without noise on another
input, over its rms, of both fits, its bias (the mean over the runs), and the error of the
prediction one sample ahead on another record, over the rms of the true innovations.

``--circuit`` makes records like those of the Wiener-Hammerstein benchmark with process noise: two
filters of third order, a saturation between them, and noise below 2 kHz before it, at levels that
give the rms and the error's spectrum of the estimation records; ten random multisines, of which two
validate and are simulated without noise in the end. Printed: errors in mV.

``--iteration`` times iterations of both fits on eight such records, for these nx: the cost of the
prediction over that of the simulation, in turns, on one thread.

``--folds`` leaves out each of the ten estimation records of the Wiener-Hammerstein benchmark with
process noise in turn, and fits the others. ``DIR`` holds its files. Printed: errors one sample
ahead on the record left out, in mV; of the simulation's fit it is its simulation error.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy
import torch

import lfrtorch
from lfrtorch._support.types import Array
from lfrtorch.data.metrics import rms
from lfrtorch.data.records import Scaler, with_past_outputs
from lfrtorch.fitting.plain_settings import Noise
from lfrtorch.least_squares.problem import Problem
from lfrtorch.linear.bla import Criterion

FORCE = 10.0
"""Deviation of the force that nobody measures over that of the sensor's noise, per sample, as
deviations of the states."""

RATE = 78125.0
"""Of the circuit, Hz."""

FOLDS: tuple[tuple[Noise, int, Criterion], ...]
FOLDS = ("output", 6, "simulation"), ("innovation", 8, "prediction")
"""Fits to the records of the benchmark: those of the filters, or with the noise."""

SETTLING = 200
"""Samples that are not scored."""


class Noisy(NamedTuple):
    """What a record was made of.

    Args:
        record: as it is measured.
        clean: the output without any noise, (T, 1).
        innovations: e, (T, 1); of noise on the states those of the Kalman filter are not known.
    """

    record: lfrtorch.Record
    clean: np.ndarray
    innovations: np.ndarray | None


def oscillator() -> lfrtorch.Model:
    """Two states, resonance at a twentieth of the rate, damping 0.1, a spring that softens."""
    angle, radius = 0.3, 0.97
    static = lfrtorch.Network(1, 1, 1, dtype=torch.float64)
    cell = lfrtorch.LFRCell(1, 1, 2, 1, 1, static, dtype=torch.float64, random=False)
    turn = radius * np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    with torch.no_grad():
        cell.A.copy_(torch.as_tensor(turn))
        cell.Bu.copy_(torch.tensor([[0.0], [0.3]]))
        cell.Bw.copy_(torch.tensor([[0.0], [0.3]]))
        cell.Cz.copy_(torch.tensor([[1.0, 0.0]]))
        cell.Cy.copy_(torch.tensor([[1.0, 0.0]]))
        for name, value in (("Wz", 1.0), ("bz", 0.3), ("Ww", -1.0), ("bw", np.tanh(0.3))):
            static.get_parameter(name).fill_(value)
    zero, one = np.zeros(1), np.ones(1)
    channels = (lfrtorch.Channel("u"),), (lfrtorch.Channel("y"),)
    return lfrtorch.Model(lfrtorch.LFR(cell), Scaler(zero, one, zero, one), 1.0, *channels)


def kalman_gain(model: lfrtorch.Model) -> np.ndarray:
    """Of the linearisation at rest, (2, 1)."""
    linear = lfrtorch.analysis.linearise(model)
    A, C = np.asarray(linear.A), np.asarray(linear.C)
    force = FORCE**2 * np.outer([0.0, 0.3], [0.0, 0.3])
    P = scipy.linalg.solve_discrete_are(A.T, C.T, force, np.eye(1))
    return A @ P @ C.T / (C @ P @ C.T + 1.0)


def measured(
    model: lfrtorch.Model, kind: str, level: float, T: int, rng: np.random.Generator
) -> Noisy:
    """A record of the oscillator with noise of a level."""
    cell, u = model.lfr.cell, rng.standard_normal((T, 1))
    K = kalman_gain(model)
    e = level * rng.standard_normal((T, 1))
    force = level * FORCE * rng.standard_normal((T, 1)) * np.array([0.0, 0.3])
    moved = e @ K.T if kind == "innovations" else force
    x, y = torch.zeros(1, 2), np.zeros((T, 1))
    with torch.no_grad():
        for k in range(T):
            found, x = cell(torch.as_tensor(u[k : k + 1]), x.double())
            y[k] = found.numpy()[0] + e[k]
            x = x + torch.as_tensor(moved[k])
    record = lfrtorch.Record(u, y, fs=model.fs, skip=SETTLING, inputs=model.inputs)
    return Noisy(record, model.simulate(u), e if kind == "innovations" else None)


def level_of(model: lfrtorch.Model, kind: str, decibels: float) -> float:
    """The level of noise that gives a signal-to-noise ratio, by bisection on one long record."""
    low, high, level = 1e-5, 10.0, 1e-2
    for _ in range(25):
        made = measured(model, kind, level, 4000, np.random.default_rng(99))
        ratio = rms(made.clean) / rms(made.record.y - made.clean)
        low, high = (level, high) if 20 * np.log10(ratio) > decibels else (low, level)
        level = float(np.sqrt(low * high))
    return level


def fits(record: lfrtorch.Record) -> Iterator[tuple[str, lfrtorch.Model]]:
    """The fits of the simulation error and of predictions."""
    trainer = lfrtorch.LevenbergMarquardt(max_iter=40)
    kinds: tuple[tuple[Noise, Criterion], ...]
    kinds = (("output", "simulation"), ("innovation", "prediction"))
    for noise, refine in kinds:
        linear = lfrtorch.estimate_bla(record, nx=2, refine=refine)
        start = lfrtorch.initialise(linear, record, nz=1, nw=1, nn=4)
        result = lfrtorch.fit(start, record, noise=noise, trainer=trainer, monitors=[])
        yield noise, result.model


def circuit(u: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """The circuit's output as it is measured, and without any noise."""
    before = scipy.signal.cheby1(3, 0.5, 4400, fs=RATE)
    after = scipy.signal.cheby2(3, 40, 5000, fs=RATE)
    low_pass = scipy.signal.butter(2, 2000, fs=RATE)
    x = scipy.signal.lfilter(*before, u)
    v = scipy.signal.lfilter(*low_pass, rng.standard_normal(len(u) + 4000))[4000:]
    gain = rms(np.abs(scipy.signal.freqz(*low_pass, worN=8192)[1]))

    def saturated(z: Array) -> Array:
        return np.asarray(scipy.signal.lfilter(*after, 0.28 * np.tanh(z / 0.28)))

    noise = 2.5e-4 * rng.standard_normal(len(u))
    return saturated(x + 0.22 / gain * v) + noise, saturated(x)


def of_circuit(seed: int) -> Iterator[tuple[str, float, float]]:
    """Each fit, its error against the output without noise, and its error one sample ahead."""
    rng, records, still = np.random.default_rng(seed), [], []
    for number in range(10):
        # Estimation records of the benchmark have such lines and this rms.
        design = lfrtorch.multisine(
            8192, fs=RATE, band=(10.0, 15e3), rms=0.76, seed=100 * seed + number
        )
        u = design.u[0, :, 0]
        y, clean = circuit(u, rng)
        record = lfrtorch.Record(u, y, fs=RATE, skip=100, name=f"r{number}")
        records.append(record)
        still.append(replace(record, y=clean))
    train, validation, still = records[:8], records[8:], still[8:]
    trainer = lfrtorch.LevenbergMarquardt(max_iter=80)
    linear = lfrtorch.estimate_bla(train, 6)
    ahead = lfrtorch.estimate_bla(train, 8, refine="prediction")

    def errors(model: lfrtorch.Model | lfrtorch.LinearModel) -> tuple[float, float]:
        found = rms(np.array([lfrtorch.rmse(r, model.simulate(r)) for r in still]))
        if model.K is None:
            return float(found), float("nan")
        each = [lfrtorch.rmse(r, model.predict(r)) for r in validation]
        return float(found), float(rms(np.array(each)))

    yield "linear", errors(linear)[0], errors(ahead)[1]
    kinds: tuple[tuple[Noise, lfrtorch.LinearModel], ...]
    kinds = ("output", linear), ("innovation", ahead)
    for noise, begin in kinds:
        starts = [lfrtorch.initialise(begin, train, nz=1, nw=1, nn=10, seed=s) for s in range(4)]
        result = lfrtorch.fit(
            starts, train, validation, noise=noise, trainer=trainer, monitors=[[]] * 4
        )
        yield noise, *errors(result.model)


def of_folds(root: Path) -> Iterator[tuple[str, dict[str, float]]]:
    """Each record left out, and the errors one sample ahead of each fit to the others."""
    data = lfrtorch.datasets.wh_process_noise.load(root=root)
    records = [*data.train, *data.validation]
    for number, left_out in enumerate(records):
        train = [record for i, record in enumerate(records) if i != number]
        errors: dict[str, float] = {}
        for noise, nx, refine in FOLDS:
            linear = lfrtorch.estimate_bla(train, nx, refine=refine)
            starts = [
                lfrtorch.initialise(linear, train, nz=1, nw=1, nn=15, seed=s) for s in range(2)
            ]
            trainer = lfrtorch.LevenbergMarquardt(max_iter=60)
            result = lfrtorch.fit(starts, train, noise=noise, trainer=trainer, monitors=[[]] * 2)
            for name, model in ("linear", linear), ("", result.model):
                y_hat = (
                    model.predict(left_out) if refine == "prediction" else model.simulate(left_out)
                )
                errors[f"{noise} {name}".strip()] = lfrtorch.rmse(left_out, y_hat)
        yield left_out.name, errors


def iteration_seconds(nx: int, turns: int = 9) -> list[float]:
    """Medians of the seconds of an iteration: of the simulation's fit, and of the prediction's."""
    torch.set_num_threads(1)
    rng, records = np.random.default_rng(0), []
    for seed in range(8):
        design = lfrtorch.multisine(8192, fs=RATE, band=(10.0, 15e3), rms=0.76, seed=seed)
        u = design.u[0, :, 0]
        records.append(lfrtorch.Record(u, circuit(u, rng)[0], fs=RATE, skip=100))
    linear = lfrtorch.estimate_bla(records, nx, refine="prediction", max_iter=5)
    model = lfrtorch.initialise(linear, records, nz=1, nw=1, nn=15)
    driven = [with_past_outputs(record) for record in records]
    problems = [
        Problem.of(model, records),
        Problem.of(model.predictor(), driven),
    ]
    found = np.array([[_seconds(problem, turn) for problem in problems] for turn in range(turns)])
    return np.median(found[1:], axis=0).tolist()


def _seconds(problem: Problem, turn: int) -> float:
    """Of one iteration of one trial, near the start."""
    theta = problem.theta + 1e-9 * turn
    clock = time.perf_counter()
    residual = problem.residual(theta)
    jacobian = problem.linearise(theta)
    system, gradient = jacobian.system(1e-3, 1e-10)
    step = system.solve(gradient, 1e-3 * system.scale)
    jacobian.tangent(step)
    jacobian.adjoint(residual)
    problem.residual(theta + 1e-3 * step)
    return time.perf_counter() - clock


def print_folds(root: Path) -> int:
    """The table of the records left out, and the mean differences with their standard errors."""
    table: dict[str, list[float]] = {}
    for name, errors in of_folds(root):
        if not table:
            print("| left out |", " | ".join(errors), "|\n" + "|---" * (1 + len(errors)) + "|")
        print("|", " | ".join([name, *(f"{1e3 * error:.3f}" for error in errors.values())]), "|")
        sys.stdout.flush()
        for each, error in errors.items():
            table.setdefault(each, []).append(1e3 * error)
    ahead = np.array(table.pop("innovation"))
    for each, found in table.items():
        less = np.array(found) - ahead
        deviation = less.std(ddof=1) / np.sqrt(len(less))
        print(f"{each} - innovation: {less.mean():.3f} +- {deviation:.3f} mV")
    return 0


def seconds_a_step(model: lfrtorch.Model) -> float:
    """Of the observer: the median of 20 times 500 steps."""
    observer = replace(model, K=torch.as_tensor(kalman_gain(model))).observer()
    u, y, found = np.array([0.1]), np.array([0.0]), []
    for _ in range(20):
        clock = time.perf_counter()
        for _ in range(500):
            observer.predict(u)
            observer.update(y)
        found.append((time.perf_counter() - clock) / 500)
    return float(np.median(found))


def main() -> int:
    """The table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=50)
    parser.add_argument("--samples", type=int, nargs="*", default=[500, 2000, 8000])
    parser.add_argument("--decibels", type=float, nargs="*", default=[30, 20, 10])
    parser.add_argument("--only", nargs="*", default=["innovations", "states"])
    parser.add_argument("--circuit", type=int, default=0, help="draws of the circuit")
    parser.add_argument("--observer", action="store_true", help="time a step of the observer")
    parser.add_argument("--iteration", type=int, nargs="*", default=[], help="nx to time")
    parser.add_argument("--folds", type=Path, help="folder of the estimation records")
    options = parser.parse_args()
    if options.folds:
        return print_folds(options.folds)
    if options.iteration:
        print("| nx | simulation: ms | prediction: ms | ratio |")
        print("|---" * 4 + "|")
    for nx in options.iteration:
        own, ahead = iteration_seconds(nx)
        print(f"| {nx} | {1e3 * own:.0f} | {1e3 * ahead:.0f} | {ahead / own:.2f} |")
        sys.stdout.flush()
    if options.iteration:
        return 0
    truth = oscillator()
    if options.observer:
        print(f"{1e6 * seconds_a_step(truth):.1f} µs a step of observer.predict and update")
        return 0
    if options.circuit:
        print("| draw | fit | simulation of the circuit without noise | one sample ahead |")
        print("|---" * 4 + "|")
        for seed in range(options.circuit):
            for name, still, ahead in of_circuit(seed):
                print(f"| {seed} | {name} | {1e3 * still:.2f} | {1e3 * ahead:.3f} |")
                sys.stdout.flush()
        return 0
    print(
        "| noise | SNR (dB) | samples | simulation fit | bias | prediction fit | bias | one step |"
    )
    print("|---" * 8 + "|")
    for kind in options.only:
        for decibels in options.decibels:
            level = level_of(truth, kind, decibels)
            other = measured(truth, kind, level, 4000, np.random.default_rng(12345))
            clean = other.clean[SETTLING:]
            for samples in options.samples:
                errors: dict[str, list[np.ndarray]] = {"output": [], "innovation": []}
                ahead = []
                for run in range(options.runs):
                    rng = np.random.default_rng(run)
                    made = measured(truth, kind, level, samples + SETTLING, rng)
                    for noise, model in fits(made.record):
                        y_hat = model.simulate(other.record.u)[SETTLING:]
                        errors[noise].append(y_hat - clean)
                        if noise == "innovation":
                            ahead.append(lfrtorch.rmse(other.record, model.predict(other.record)))
                cells = [kind, f"{decibels:g}", str(samples)]
                scale = rms(clean)
                for found in errors.values():
                    each = [rms(error) for error in found]
                    bias = rms(np.mean(found, axis=0))
                    cells += [f"{np.median(each) / scale:.4f}", f"{bias / scale:.4f}"]
                true = other.innovations
                least = "-"
                if true is not None:
                    least = f"{np.median(ahead) / rms(true[SETTLING:]):.4f}"
                print("|", " | ".join([*cells, least]), "|")
                sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
