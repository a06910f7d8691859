"""Starts whose states are random: the outputs are a static map of linear states, by least squares.

A start of ``lfrtorch.initialise`` has the states of the best linear approximation. These are far
from those of a system whose nonlinearity hides its linear part: the linear model of an output |v|
says next to nothing of v. So other starts draw their states, of which some are modes of the linear
model and the others have random poles, and a network with random hidden neurons. Given both, the
output is linear in the rest of the model, which follows by least squares. The best of many draws is
a Wiener model, from which the fit of the NL-LFR begins.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy
import torch

from lfrtorch._support.types import Array, Booleans
from lfrtorch.data.records import Record
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.lfr import LFR
from lfrtorch.maps.network import Network
from lfrtorch.model.model import Model

_DRAWS = 4, 256
"""Least and largest number of draws of a start, log-uniform. For some systems, the best of many
draws always leads to the same poor minimum."""

_SAMPLES = 5000
"""Largest number of scored samples that the draws are compared on."""

_OF_LINEAR = 0.5
"""Part of the modes that are those of the linear model."""

_PAIRS = 0.6
"""Part of the random modes that oscillate."""

_RIDGE = 1e-3
"""Weight of the squared coefficients, over the mean squared output."""

_UNKNOWN = 200
"""Largest number of samples, and at most an eighth of a record, that an unknown start affects."""


def unsuited(model: Model, records: Sequence[Record]) -> str | None:
    """Return why a model of this kind has no such start, or None."""
    cell = model.lfr.cell
    if not isinstance(cell.static, Network):
        return "the static map is no network"
    if held := sorted({*cell.held} - {"Dzu", "Dyu"}):
        return f"entries of {', '.join(held)} are held"
    if model.K is not None:
        return "the linear model models noise"
    if starts := {record.start for record in records} & {"given", "measured"}:
        return f"a record has start='{starts.pop()}'"
    return None


def with_random_states(model: Model, records: Sequence[Record], seed: int) -> Model:
    """Return the best of many random Wiener models with the sizes of a model.

    Args:
        model: a start that is not ``unsuited``.
        records: the data that are to be fitted.
        seed: seed of the draws.
    """
    cell, rng = model.lfr.cell, np.random.default_rng(seed)
    network = cell.static
    assert isinstance(network, Network)
    nx, nz, nu, nn = cell.nx, cell.nz, cell.nu, len(network.bz)
    inputs, outputs, scored = _signals(model, records)
    u, y = np.concatenate(inputs), np.concatenate(outputs)
    known = _blocks(cell.A.detach().double().cpu().numpy())
    through = not cell.held.get("Dyu", torch.tensor(False)).all()
    z_through = through and not cell.held.get("Dzu", torch.tensor(False)).all()
    least, best = np.inf, dict[str, Array]()
    for _ in range(round(np.exp(rng.uniform(*np.log(_DRAWS))))):
        A = _modes(rng, nx, max(map(len, inputs)), known)
        Bu = rng.standard_normal((nx, nu))
        x = np.concatenate([_states(A, Bu, part) for part in inputs])
        std = _deviation(x)
        x = x / std
        Cz = rng.uniform(-1.0, 1.0, (nz, nx))
        Dzu = rng.uniform(-1.0, 1.0, (nz, nu)) * (z_through and rng.random() < 0.5)
        z = x @ Cz.T + u @ Dzu.T
        spread = _deviation(z)[:, None]
        Wz, bz = rng.uniform(-1.5, 1.5, (nn, nz)), rng.uniform(-1.5, 1.5, nn)
        hidden = network.sigma.value(torch.from_numpy(z / spread.T @ Wz.T + bz)).numpy()
        columns = np.hstack([x, u * through, hidden, np.ones((len(u), 1))])
        found, error = _least_squares(columns, y, scored)
        if error < least:
            least = error
            Cy, Dyu, Ww, bw = np.split(found, np.cumsum([nx, nu, nn]), axis=1)
            best = {
                "A": A * std / std[:, None], "Bu": Bu / std[:, None], "Cz": Cz / spread,
                "Dzu": Dzu / spread, "Cy": Cy, "Dyu": Dyu * through,
                "Wz": Wz, "bz": bz, "Ww": Ww, "bw": bw[:, 0],
            }  # fmt: skip
    return _written(model, best, rng)


def _written(model: Model, found: dict[str, Array], rng: np.random.Generator) -> Model:
    """The model with the matrices of a draw; w beyond the outputs begin at 0."""
    old = model.lfr.cell
    assert isinstance(old.static, Network)
    static = Network(old.nz, old.nw, len(found["bz"]), old.static.activation, dtype=old.A.dtype)
    sizes = old.nu, old.ny, old.nx, old.nz, old.nw
    cell = LFRCell(*sizes, static, dtype=old.A.dtype, random=False)
    # With fewer w than outputs, the maps of the outputs are nearest to multiples of a few.
    left, size, right = np.linalg.svd(
        np.column_stack([found["Ww"], found["bw"]]), full_matrices=False
    )
    own, share = min(len(size), old.nw), np.zeros((old.ny, old.nw))
    share[:, :own] = left[:, :own]
    share[:, own:] = rng.uniform(-0.3, 0.3, (old.ny, old.nw - own))
    maps = np.zeros((old.nw, right.shape[1]))
    maps[:own] = size[:own, None] * right[:own]
    found = {**found, "Dyw": share, "Ww": maps[:, :-1], "bw": maps[:, -1]}
    with torch.no_grad():
        for name, value in found.items():
            weight = getattr(static if name in ("Wz", "bz", "Ww", "bw") else cell, name)
            weight.copy_(torch.as_tensor(value))
    cell.held = old.held
    return replace(model, lfr=LFR(cell), K=None)


def _signals(model: Model, records: Sequence[Record]) -> tuple[list[Array], list[Array], Booleans]:
    """Normalised inputs and outputs of the beginnings of records, and which outputs count."""
    total = sum(record.samples for record in records)
    inputs, outputs, scored = list[Array](), list[Array](), list[Booleans]()
    for record in records:
        normalised = model.scaler.normalise(record)
        u, y = normalised.u, normalised.y
        own = record.factors > 0
        if record.start == "estimated":
            own[: min(record.samples // 8, _UNKNOWN)] = False
        most = max(1, record.samples * min(_SAMPLES, total) // total)
        # What is masked before is simulated, too.
        T = 1 + max(int(np.flatnonzero(each)[:most].max(initial=0)) for each in own.T)
        own, y = own[:T], np.where(own, y, 0.0)[:T]
        if record.start == "periodic":
            u = np.vstack([u[-T:], u])
            own, y = np.vstack([np.zeros_like(own), own]), np.vstack([np.zeros_like(y), y])
        inputs.append(u[: len(y)])
        outputs.append(y)
        scored.append(own)
    return inputs, outputs, np.concatenate(scored)


def _modes(rng: np.random.Generator, nx: int, samples: int, known: Sequence[Array]) -> Array:
    """A stable A of modes: blocks of the linear model, and random ones."""
    blocks, left, pool = list[Array](), nx, list(known)
    while left:
        if pool and rng.random() < _OF_LINEAR:
            block = pool.pop(rng.integers(len(pool)))
        elif left > 1 and rng.random() < _PAIRS:
            turns = np.exp(rng.uniform(np.log(2.0 / samples), np.log(0.5)))  # a sample
            damping = np.exp(rng.uniform(np.log(0.05), 0.0))
            pole = np.exp(2j * np.pi * turns * complex(-damping, np.sqrt(1.0 - damping**2)))
            block = np.array([[pole.real, pole.imag], [-pole.imag, pole.real]])
        else:
            lasts = np.exp(rng.uniform(np.log(0.5), np.log(max(1.0, samples / 4))))
            block = np.array([[np.exp(-1.0 / lasts)]])
        if len(block) <= left:
            blocks.append(block)
            left -= len(block)
    return scipy.linalg.block_diag(*blocks)


def _blocks(A: Array) -> list[Array]:
    """Real poles and pairs of poles of a matrix, as blocks."""
    poles = np.linalg.eigvals(A)
    real = [np.array([[p.real]]) for p in poles[poles.imag == 0]]
    pairs = [np.array([[p.real, p.imag], [-p.imag, p.real]]) for p in poles[poles.imag > 0]]
    return [block for block in (*real, *pairs) if np.linalg.norm(block, 2) < 1.0]


def _states(A: Array, Bu: Array, u: Array) -> Array:
    """States (T, nx) of modes from rest."""
    driven, x, i = u @ Bu.T, np.zeros((len(u), len(A))), 0
    while i < len(A):
        if i + 1 < len(A) and A[i, i + 1]:
            pole = complex(A[i, i], -A[i, i + 1])  # of x1 + j x2
            both = driven[:-1, i] + 1j * driven[:-1, i + 1]
            path = scipy.signal.lfilter([1.0], [1.0, -pole], both)
            x[1:, i], x[1:, i + 1] = path.real, path.imag
            i += 2
        else:
            x[1:, i] = scipy.signal.lfilter([1.0], [1.0, -A[i, i]], driven[:-1, i])
            i += 1
    return x


def _least_squares(columns: Array, y: Array, scored: Booleans) -> tuple[Array, float]:
    """Coefficients of each output, (ny, columns), and the mean squared error where they count."""
    found, total = [], 0.0
    for own, target in zip(scored.T, y.T, strict=True):
        F, t = columns[own], target[own]
        if not len(F):
            found.append(np.zeros(F.shape[1]))
            continue
        gram = F.T @ F + _RIDGE * len(F) * np.eye(F.shape[1])
        found.append(scipy.linalg.solve(gram, F.T @ t, assume_a="pos"))
        total += float(np.mean((t - F @ found[-1]) ** 2))
    return np.array(found), total


def _deviation(signal: Array) -> Array:
    std = signal.std(axis=0)
    return np.where(std > 0.0, std, 1.0)
