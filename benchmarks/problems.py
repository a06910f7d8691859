"""The problems that are timed: records and a model to start from.

They are prepared once, in a folder that all processes read: the Bouc-Wen case, five periods of a
parallel Wiener-Hammerstein system of the benchmark's size, and two simulated structures with
lightly damped modes, of the sizes of an aircraft and of a fine steering mirror.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from scipy import signal
from scipy.linalg import block_diag

import lfrtorch
from lfrtorch import Channel, LinearModel, Model, Record
from lfrtorch._support.types import Array
from lfrtorch.least_squares.problem import Problem

SIZES = {
    "boucwen": {"nx": 3, "nz": 2, "nw": 1, "nn": 15},
    "parallel_wh": {"nx": 12, "nz": 2, "nw": 2, "nn": 15},
}
LARGE = {
    "aircraft size": {"records": 3, "nu": 1, "ny": 3, "nx": 20, "nz": 2, "nw": 2, "nn": 15},
    "mirror size": {"records": 5, "nu": 3, "ny": 3, "nx": 28, "nz": 4, "nw": 4, "nn": 20},
}
"""Those of F16 and of the fine steering mirror: records of 8192 samples, one period each."""
AIRCRAFT, MIRROR = LARGE
LINES = np.arange(40, 2048)
"""That their inputs excite."""
PEER_FILES = {"boucwen": "boucwen.npz", "parallel_wh": "pwh_synth.npz"}
RATES = {"boucwen": 750.0, "parallel_wh": 78e3}
PARALLEL_WH = {"records": 5, "samples": 16384, "lines": 4095}
BLA_ITERATIONS = 3
"""Iterations of the linear start, and of the peer's: its quality is of no concern here."""
RIDGE = 1e-3
"""Ridge of conf/bench/boucwen.yaml."""
RADIUS = 0.9
"""Radius of the poles of a synthetic system."""


def write_signals(folder: Path, peers: Path | None = None) -> None:
    """Write the signals to the folder, the peers' if they are given, with rate and sizes."""
    for name, sizes in SIZES.items():
        u, y = _signals(name, peers)
        about: dict = {"fs": RATES[name], **sizes}
        np.savez(folder / f"{name}.npz", u=u, y=y, **about)


def write_large(folder: Path) -> None:
    """Write records and linear models of structures with nx / 2 lightly damped modes."""
    for name, sizes in LARGE.items():
        rng = np.random.default_rng(0)
        nx, nu, ny, T = sizes["nx"], sizes["nu"], sizes["ny"], 8192
        damping = 0.004 + 0.02 * rng.random(nx // 2)
        poles = np.exp(np.linspace(0.05, 1.2, nx // 2) * (1j * np.sqrt(1.0 - damping**2) - damping))
        blocks = [[[p.real, p.imag], [-p.imag, p.real]] for p in poles]
        turn = np.linalg.qr(rng.standard_normal((nx, nx)))[0]
        A = turn @ block_diag(*blocks) @ turn.T
        B, C = turn @ rng.standard_normal((nx, nu)), rng.standard_normal((ny, nx)) @ turn.T / 10.0
        D = np.zeros((ny, nu))
        spectra = np.zeros((sizes["records"], T // 2 + 1, nu), complex)
        phases = rng.random((sizes["records"], len(LINES), nu))
        spectra[:, LINES] = np.exp(2j * np.pi * phases)
        u = np.fft.irfft(spectra, T, axis=1)
        u /= u.std()
        system = linear_model((A, B, C, D))
        rest = [Record(each, np.zeros((T, ny)), start="periodic") for each in u]
        whole = [replace(r, y=system.simulate(r)) for r in rest]
        nz, nw, nn = (sizes[size] for size in ("nz", "nw", "nn"))
        truth = lfrtorch.initialise(system, whole, nz=nz, nw=nw, nn=nn, seed=5)
        with torch.no_grad():
            generator = torch.Generator().manual_seed(1)
            weights = truth.lfr.cell.get_parameter("static.Ww")
            weights.uniform_(-0.1, 0.1, generator=generator)
            truth.lfr.cell.Bw.mul_(0.1)
        y = np.stack([truth.simulate(record) for record in rest])
        y += 1e-3 * y.std() * rng.standard_normal(y.shape)
        about: dict = {"fs": 1.0, "nx": nx, "nz": nz, "nw": nw, "nn": nn}
        np.savez(folder / f"{name}.npz", u=u, y=y, A=A, B=B, C=C, D=D, **about)


def linear_model(system: tuple[Array, Array, Array, Array]) -> LinearModel:
    """The linear model of these matrices."""
    D = system[3]
    inputs, outputs = (
        tuple(Channel(f"{letter}{i}") for i in range(count))
        for letter, count in (("u", D.shape[1]), ("y", D.shape[0]))
    )
    return LinearModel(*system, 1.0, np.zeros(len(inputs)), np.zeros(len(outputs)), inputs, outputs)


def prepare(folder: Path, peers: Path | None) -> dict[str, int]:
    """Write signals and models to the folder."""
    write_signals(folder, peers)
    write_large(folder)
    parameters = {}
    for name, sizes in (SIZES | LARGE).items():
        data = records(folder, name)
        if name in LARGE:
            with np.load(folder / f"{name}.npz") as file:
                A, B, C, D = (file[matrix] for matrix in "ABCD")
            bla = linear_model((A, B, C, D))
        else:
            bla = lfrtorch.estimate_bla(data, sizes["nx"], offset=False, max_iter=BLA_ITERATIONS)
        nz, nw, nn = (sizes[size] for size in ("nz", "nw", "nn"))
        model = lfrtorch.initialise(bla, data, nz=nz, nw=nw, nn=nn)
        model.save(folder / name)
        parameters[name] = model.parameter_count
    return parameters


def records(
    folder: Path,
    name: str,
    *,
    start: Literal["periodic", "zero"] = "periodic",
    periods: int = 1,
    count: int | None = None,
) -> list[Record]:
    """The first ones of a problem's records, each repeated over some periods."""
    with np.load(folder / f"{name}.npz") as file:
        fs, pairs = float(file["fs"]), zip(file["u"][:count], file["y"][:count], strict=True)
        return [
            Record(*(np.concatenate([signal] * periods) for signal in pair), fs=fs, start=start)
            for pair in pairs
        ]


def problem(
    folder: Path,
    name: str,
    ridge: float = RIDGE,
    *,
    start: Literal["periodic", "zero"] = "periodic",
    periods: int = 1,
    count: int | None = None,
) -> Problem:
    """The residual that a fit of the problem minimises."""
    model = lfrtorch.load(folder / name)
    data = records(folder, name, start=start, periods=periods, count=count)
    return Problem.of(model, data, ridge=ridge)


def synthetic(
    *,
    samples: int = 8192,
    count: int = 1,
    ports: int = 1,
    nx: int = 4,
    nz: int = 2,
    nw: int = 1,
    nn: int = 15,
) -> tuple[Model, Problem]:
    """A fit of any size: a random linear system with quadratic outputs, records from rest.

    It has as many inputs as outputs.
    """
    rng = np.random.default_rng(0)
    A = RADIUS * np.linalg.qr(rng.standard_normal((nx, nx)))[0]
    B, C = rng.standard_normal((nx, ports)), rng.standard_normal((ports, nx)) / np.sqrt(nx)
    system = linear_model((A, B, C, np.zeros((ports, ports))))
    data = []
    for u in rng.standard_normal((count, samples, ports)):
        linear = system.simulate(u)
        data.append(Record(u, linear + 0.1 * linear**2))
    model = lfrtorch.initialise(system, data, nz=nz, nw=nw, nn=nn)
    return model, Problem.of(model, data)


def plain_gradient(problem: Problem, theta: torch.Tensor) -> torch.Tensor:
    """The gradient (P,) of the mean square by autograd through a loop in Python, from rest."""
    problem.write(theta)
    cell, (group,) = problem.lfr.cell, problem.errors.groups
    x, outputs = group.u.new_zeros(len(group.u), cell.nx), []
    for u in group.u.unbind(1):
        y, x = cell(u, x)
        outputs.append(y)
    errors = torch.stack(outputs, dim=1) - group.y
    gradients = torch.autograd.grad(errors.square().mean(), list(cell.parameters()))
    return torch.cat([gradient.flatten() for gradient in gradients])


def _signals(name: str, peers: Path | None) -> tuple[Array, Array]:
    """Inputs and outputs (R, T)."""
    if peers is not None:
        with np.load(peers / PEER_FILES[name]) as file:
            if name == "boucwen":
                return file["u_train"][None], file["y_train"][None]
            return file["u_train_R"], file["y_train_R"]
    if name == "boucwen":
        (record,) = lfrtorch.datasets.boucwen.load().train
        return record.u.T, record.y.T
    pairs = [_parallel_wh(np.random.default_rng(seed)) for seed in range(PARALLEL_WH["records"])]
    u, y = (np.stack(signals) for signals in zip(*pairs, strict=True))
    return u, y


def _parallel_wh(rng: np.random.Generator) -> tuple[Array, Array]:
    """One period in steady state of two branches filter - static map - filter, order 12."""
    T, lines = PARALLEL_WH["samples"], np.arange(1, PARALLEL_WH["lines"] + 1)
    spectrum = np.zeros(T // 2 + 1, dtype=complex)
    spectrum[lines] = np.exp(2j * np.pi * rng.random(len(lines)))
    u = np.fft.irfft(spectrum, T)
    u /= u.std()
    branches = (
        (signal.butter(3, 0.25), lambda v: np.tanh(1.2 * v), signal.cheby1(3, 0.5, 0.3)),
        (signal.cheby2(3, 30, 0.35), lambda v: v / (1.0 + 0.1 * v**2), signal.butter(3, 0.2)),
    )
    settled = np.tile(u, 3)
    outputs = [
        signal.lfilter(*behind, static(signal.lfilter(*ahead, settled)))
        for ahead, static, behind in branches
    ]
    return u, np.sum(outputs, axis=0)[-T:]
