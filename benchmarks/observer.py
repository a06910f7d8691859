"""States online: the extended Kalman filter beside a particle filter, and the time of a step.

    python benchmarks/observer.py [--runs 10] [--samples 1000] [--particles 10000]
    python benchmarks/observer.py --seconds

The system is a model of Bouc-Wen data (three states, two inputs and one output of the network, 15
neurons), fitted 40 iterations to one period of the official multisine. It is driven by another
multisine of the same kind, with white noise on its states, whose rms is 1 for each, and on its
output. Both filters know the model and the noise, and begin at x = 0 with covariance 1; the system
begins at a draw of it. The particle filter is the bootstrap filter with systematic resampling at
every sample. A state is estimated from all outputs before its sample.

Printed: the rms error of all states after the first 100 samples, the median over the runs, its
ratio to that of the particle filter, and what the filter's covariance says of it. Errors of an
open-loop simulation from x = 0 are for comparison. ``--seconds`` prints the time of ``predict`` and
``update``.

References:
    Gordon, Salmond and Smith, "Novel approach to nonlinear/non-Gaussian Bayesian state estimation",
    IEE Proceedings F 140(2), 1993 (bootstrap filter).
"""

from __future__ import annotations

import argparse
import sys
import time
from copy import deepcopy
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch

import lfrtorch
from lfrtorch._support.types import Array
from lfrtorch.data.metrics import rms
from lfrtorch.model.state_observer import StateObserver

LEVELS = ((1e-3, 1e-2), (1e-2, 1e-2), (3e-2, 3e-2), (1e-1, 1e-1))
"""Deviations of the noise on the states, of unit rms, and on the output, relative to its rms."""

SETTLING = 100
"""Samples that are not scored."""


def bouc_wen(iterations: int = 40) -> tuple[lfrtorch.Model, Array]:
    """A model of the benchmark, and another input, in N."""
    data = lfrtorch.datasets.boucwen.load()
    train, validation = data.train[0], data.validation
    linear = lfrtorch.estimate_bla(train, nx=3)
    start = lfrtorch.initialise(linear, train, nz=2, nw=1, nn=15)
    trainer = lfrtorch.LevenbergMarquardt(max_iter=iterations)
    model = lfrtorch.fit(start, train, validation, trainer=trainer, monitors=[]).model
    assert validation is not None
    other = (validation if isinstance(validation, lfrtorch.Record) else validation[0]).u
    return model, other


class Noisy(NamedTuple):
    """States (T + 1, nx) of a run with noise, and its measured output (T, ny), normalised."""

    x: Array
    y: Array


def run_with_noise(
    model: lfrtorch.Model, u: Array, q: float, r: float, rng: np.random.Generator
) -> Noisy:
    """From a draw of x ~ N(0, 1)."""
    cell, v = model.lfr.cell, torch.as_tensor(model.scaler.normalise_u(u))
    x, y = rng.standard_normal((len(u) + 1, cell.nx)), np.empty((len(u), cell.ny))
    with torch.no_grad():
        for k in range(len(u)):
            found, x_next = cell(v[k], torch.as_tensor(x[k]))
            y[k] = found.numpy() + r * rng.standard_normal(cell.ny)
            x[k + 1] = x_next.numpy() + q * rng.standard_normal(cell.nx)
    return Noisy(x, y)


def particle_filter(
    model: lfrtorch.Model, u: Array, y: Array, q: float, r: float, count: int, seed: int
) -> Array:
    """The mean of the states at each sample after the first, (T, nx), of the outputs before it."""
    cell, v = model.lfr.cell, torch.as_tensor(model.scaler.normalise_u(u))
    rng, found = np.random.default_rng(seed), np.empty((len(u), cell.nx))
    x = rng.standard_normal((count, cell.nx))
    with torch.no_grad():
        for k in range(len(u)):
            y_hat, x_next = cell(v[k].expand(count, -1), torch.as_tensor(x))
            log_p = -0.5 * np.sum(((y[k] - y_hat.numpy()) / r) ** 2, axis=1)
            weights = np.exp(log_p - log_p.max())
            weights /= weights.sum()
            found[k] = weights @ x_next.numpy()
            at = (rng.random() + np.arange(count)) / count
            chosen = np.minimum(np.searchsorted(np.cumsum(weights), at), count - 1)
            x = x_next.numpy()[chosen] + q * rng.standard_normal(x.shape)
    return found


def kalman_filter(
    model: lfrtorch.Model, u: Array, y: Array, q: float, r: float
) -> tuple[Array, Array]:
    """The same by the observer, and the variances (T, nx) that it gives them."""
    noise = lfrtorch.NoiseCovariance(Q=q**2, R=(r * model.scaler.y_scale) ** 2)
    observer = model.observer(noise=noise, P0=1.0)
    states, variances = [], []
    for u_k, y_k in zip(u, model.scaler.restore_y(y), strict=True):
        observer.predict(u_k)
        observer.update(y_k)
        states.append(observer.state)
        variances.append(np.diag(observer.covariance))
    return np.array(states), np.array(variances)


def seconds_a_step(observer: StateObserver, u: Array, y: Array) -> Array:
    """Of 200 times 100 steps."""
    found = []
    for _ in range(200):
        clock = time.perf_counter()
        for u_k, y_k in zip(u[:100], y[:100], strict=True):
            observer.predict(u_k)
            observer.update(y_k)
        found.append((time.perf_counter() - clock) / 100)
    return np.array(found)


def main() -> int:
    """The table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--samples", type=int, default=1000)
    parser.add_argument("--particles", type=int, default=10000)
    parser.add_argument("--seconds", action="store_true", help="time a step of the observers")
    options = parser.parse_args()
    torch.set_num_threads(1)
    model, u = bouc_wen(3 if options.seconds else 40)
    model = replace(model, lfr=lfrtorch.LFR(deepcopy(model.lfr.cell).double()))
    u = u[: options.samples]
    if options.seconds:
        made = run_with_noise(model, u, 1e-2, 1e-2, np.random.default_rng(0))
        y = model.scaler.restore_y(made.y)
        noise = lfrtorch.NoiseCovariance(Q=1e-4, R=(1e-2 * model.scaler.y_scale) ** 2)
        K = torch.full((3, 1), 0.1, dtype=torch.float64)
        print("| observer | median, µs a step | least |\n|---|---|---|")
        for name, observer in (
            ("constant gain", replace(model, K=K).observer()),
            ("extended Kalman filter", model.observer(noise=noise)),
        ):
            found = 1e6 * seconds_a_step(observer, u, y)
            print(f"| {name} | {np.median(found):.1f} | {found.min():.1f} |")
        return 0
    print("| noise on states | on the output | simulation | EKF | its own | particles | ratio |")
    print("|---" * 7 + "|")
    for q, r in LEVELS:
        errors = []
        for run in range(options.runs):
            made = run_with_noise(model, u, q, r, np.random.default_rng(run))
            x = made.x[1 + SETTLING :]
            still = model.signals(u).x[0, 1 + SETTLING :].numpy()
            found, variances = kalman_filter(model, u, made.y, q, r)
            others = particle_filter(model, u, made.y, q, r, options.particles, run)
            each = [rms(still - x), rms(found[SETTLING:] - x)]
            each += [np.sqrt(variances[SETTLING:].mean()), rms(others[SETTLING:] - x)]
            errors.append(each)
        *middle, last = np.median(errors, axis=0)
        ratio = np.median([each[1] / each[3] for each in errors])
        numbers = " | ".join(f"{number:.4f}" for number in (*middle, last))
        print(f"| {q:g} | {r:g} | {numbers} | {ratio:.3f} |")
        sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
