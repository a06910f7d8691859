"""Estimation records of public benchmarks, and two that are simulated, which advice is tried on.

Each function takes the folder of the benchmarks' files; no official test record is read.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.io import loadmat

import lfrtorch
from lfrtorch._support.types import Array

Signals = tuple[Array, Array]
"""Inputs (T, nu) and outputs (T, ny)."""


def tanks(root: Path) -> Signals:
    """The whole estimation record of the cascaded tanks, whose levels begin anywhere."""
    return _signals(lfrtorch.datasets.cascaded_tanks.load(root=root).train[0])


def silverbox(root: Path) -> Signals:
    """6000 samples amid the first multisine realisations."""
    record = lfrtorch.datasets.silverbox.load(root=root).train[0]
    return _signals(record[2000:8000])


def wiener_hammerstein(root: Path) -> Signals:
    """6000 samples amid the estimation record."""
    record = lfrtorch.datasets.wiener_hammerstein.load(root=root).train[0]
    return _signals(record[20000:26000])


def emps(root: Path) -> Signals:
    """The estimation record of the positioning system, every fourth sample."""
    file = loadmat(root / "EMPS/DATA_EMPS.mat")
    return file["vir"][::4] * file["gtau"], file["qm"][::4]


def ced(root: Path) -> Signals:
    """The estimation part of the coupled drives' first uniform record."""
    return _signals(lfrtorch.datasets.ced.load(root=root).validation[0])


def cart(root: Path) -> Signals:
    """A simulated axis: force -> position, with friction, in a position loop that is closed.

    m dv/dt = F - c v - Fc tanh(v / vs), dx/dt = v, F = Kp (r - x) - Kd v, at 1 kHz, kept at 100 Hz;
    the noise of the position, 20 µm rms, is that of the record alone.
    """
    del root
    rng, fs, steps, T = np.random.default_rng(5), 100.0, 10, 4000
    target = np.repeat(rng.uniform(-0.1, 0.1, T // 100), 100)
    smooth = np.convolve(np.r_[np.zeros(59), target], np.ones(60) / 60, "valid")
    mass, viscous, coulomb, slip, dt = 2.0, 4.0, 3.0, 5e-3, 1.0 / fs / steps
    x = v = 0.0
    u, y = np.zeros((T, 1)), np.zeros((T, 1))
    for k in range(T):
        force = 400.0 * (smooth[k] - x) - 30.0 * v
        u[k], y[k] = force, x
        for _ in range(steps):
            v += dt * (force - viscous * v - coulomb * np.tanh(v / slip)) / mass
            x += dt * v
    return u, y + 20e-6 * rng.standard_normal(y.shape)


def linear(root: Path) -> Signals:
    """A linear system of two resonances, with white noise of 5 % at its output."""
    del root
    rng, T = np.random.default_rng(7), 3000
    u = rng.standard_normal((T, 1))
    poles = np.array([0.9 * np.exp(0.4j), 0.85 * np.exp(1.1j)])
    state, y = np.zeros(2, complex), np.zeros((T, 1))
    for k in range(T):
        y[k] = np.real(state @ np.array([1.0 + 0.3j, 0.5 - 0.4j]))
        state = poles * state + u[k]
    return u, y + 0.05 * y.std() * rng.standard_normal(y.shape)


def _signals(record: lfrtorch.Record) -> Signals:
    return record.u, record.y
