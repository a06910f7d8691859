"""States that w alone drives, added to the states of the linear model.

A linear model has only states that the input drives. This module adds states that the nonlinearity
drives: modes above the band of the inputs, which friction and impacts excite, and relaxations,
which describe hysteresis. They are at rest at the start of a fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch.nn.functional import pad

from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array
from lfrtorch.data.records import Record
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.lfr import LFR
from lfrtorch.model.model import Model
from lfrtorch.survey.signal import band

_DAMPING = 0.03  # damping ratio of the modes


def distortion_frequencies(
    inputs: Sequence[Float[Array, "T nu"]], errors: Sequence[Float[Array, "T ny"]], count: int
) -> Float[Array, " count"]:
    """Frequencies, rad per sample, that split the nonlinear distortions into equal powers."""
    # Above the band of the inputs a linear model has no output, so all of its error there is
    # distortion. The errors are normalised.
    edge = _edge(inputs)
    grid = np.linspace(edge, np.pi, 4096)  # frequencies at which the spectra of records are added
    power = np.zeros_like(grid)  # cumulative from the edge
    for error in errors:
        spectrum = np.fft.rfft(np.hanning(len(error) + 1)[:-1, None] * error, axis=0)
        below = np.cumsum((np.abs(spectrum) ** 2).sum(axis=1)) / len(error)
        power += np.interp(grid, np.linspace(0.0, np.pi, len(below)), below)
    power -= power[0]
    if edge >= 0.95 * np.pi or not power[-1] > 0:
        raise InputError(
            f"modes is {count}, but the errors of the linear model have no power above the band "
            "of the inputs; give modes=0."
        )
    return np.interp((np.arange(count) + 0.5) / count, power / power[-1], grid)


def relaxation_frequencies(
    inputs: Sequence[Float[Array, "T nu"]], count: int
) -> Float[Array, " count"]:
    """Corner frequencies, rad per sample, in equal ratios over two decades up to half the band."""
    return 0.5 * _edge(inputs) * 100.0 ** -((np.arange(count) + 0.5) / count)


def frequencies(
    model: Model, records: Sequence[Record], relaxations: int, modes: int
) -> tuple[Float[Array, " r"], Float[Array, " m"]]:
    """Corner frequencies of relaxations and natural frequencies of modes, rad per sample."""
    inputs = [record.u for record in records]
    corners = relaxation_frequencies(inputs, relaxations)
    if not modes:
        return corners, corners[:0]
    errors = [record.errors(model.simulate(record)) / model.scaler.y_scale for record in records]
    return corners, distortion_frequencies(inputs, errors, modes)


@torch.no_grad()
def begin_driven(
    cell: LFRCell,
    relaxations: Float[Array, " r"],
    modes: Float[Array, " m"],
    generator: torch.Generator,
    *,
    z: slice = slice(None),
    w: slice = slice(None),
) -> None:
    """Make the last states of a cell relaxations and modes of these frequencies, in place.

    The entries of these states in Bw and Cy are random. Their entries in Bu are 0, so these states
    are at rest as long as w is 0. A relaxation has one state, which z sees; a mode has two states,
    which z does not see. Frequencies are in rad per sample. The slice ``z`` selects the z that see
    relaxations, and ``w`` the w that drive these states. Held entries do not change.
    """
    before = {name: cell.get_parameter(name).clone() for name in cell.held}
    decay = np.exp(-np.concatenate([relaxations, np.repeat(_DAMPING * modes, 2)]))
    first, A = cell.nx - len(decay), np.diag(decay)
    for i, angle in enumerate(np.sqrt(1.0 - _DAMPING**2) * modes):
        at = slice(len(relaxations) + 2 * i, len(relaxations) + 2 * i + 2)
        A[at, at] @= [[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]
    cell.A[first:, first:] = torch.as_tensor(A)
    cell.Bu[first:] = 0.0
    cell.Cz[z, first:] = 0.0
    # With this gain, white w of unit variance gives states of about unit variance.
    gain = torch.as_tensor(np.sqrt(1.0 - decay**2)).to(cell.A)
    seen = slice(first, first + len(relaxations))
    for entries in (cell.Bw[first:, w], cell.Cy[:, first:], cell.Cz[z, seen]):
        entries.uniform_(-0.3, 0.3, generator=generator)
    cell.Bw[first:, w] *= gain[:, None]
    for name, mask in cell.held.items():
        entries = cell.get_parameter(name)
        entries.copy_(torch.where(mask.to(entries.device), before[name], entries))


def with_driven_states(
    model: Model,
    records: Sequence[Record],
    relaxations: int,
    modes: int,
    generator: torch.Generator,
) -> Model:
    """A model with the same output, and with additional states that w alone drives."""
    if not relaxations + modes:
        return model
    found = frequencies(model, records, relaxations, modes)
    cell = _larger(model.lfr.cell, relaxations + 2 * modes)
    begin_driven(cell, *found, generator)
    K = model.K
    if K is not None:
        K = torch.cat([K, K.new_zeros(cell.nx - len(K), cell.ny)])
    return replace(model, lfr=LFR(cell), K=K)


@torch.no_grad()
def _larger(cell: LFRCell, states: int) -> LFRCell:
    """The cell with additional states, whose matrix entries are 0."""
    like = {"dtype": cell.A.dtype, "device": cell.A.device}
    larger = LFRCell(
        cell.nu, cell.ny, cell.nx + states, cell.nz, cell.nw, deepcopy(cell.static),
        **like, random=False,
    )  # fmt: skip
    for name in ("A", "Bu", "Bw", "Cy", "Cz"):
        entries, own = larger.get_parameter(name).zero_(), cell.get_parameter(name)
        entries[: len(own), : own.shape[1]] = own
    for name in ("Dyu", "Dyw", "Dzu"):
        larger.get_parameter(name).copy_(cell.get_parameter(name))
    for name, mask in cell.held.items():
        beside = [n - m for n, m in zip(larger.get_parameter(name).shape, mask.shape, strict=True)]
        larger.held[name] = pad(mask, (0, beside[-1], 0, beside[0]) if mask.ndim == 2 else (0, 0))
    return larger


def _edge(inputs: Sequence[Float[Array, "T nu"]]) -> float:
    """Return the upper end of the inputs' band, rad per sample."""
    bands = [band(channel) for u in inputs for channel in u.T]
    return 2.0 * np.pi * max((high for found in bands if found for high in found), default=0.5)
