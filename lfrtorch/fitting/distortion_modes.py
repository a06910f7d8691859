"""Modes above the band of the inputs: no linear model has them, the nonlinearity excites them."""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy

import numpy as np
import torch
from jaxtyping import Float

from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array
from lfrtorch.engine.cell import LFRCell
from lfrtorch.survey.signal import band

GRID = 4096
"""Frequencies at which the spectra of records are put together."""

LAST = 0.95
"""Part of the frequencies up to fs / 2 from which on inputs are said to excite all of them."""

DAMPING = 0.03
"""Damping ratio of the modes."""

RANGE = 0.3
"""Entries of Bw and Cy are in -RANGE .. RANGE."""


def distortion_frequencies(
    inputs: Sequence[Float[Array, "T nu"]], errors: Sequence[Float[Array, "T ny"]], count: int
) -> Float[Array, " count"]:
    """Frequencies that split the power of the nonlinear distortions into equal parts.

    Above the band of the inputs a linear model has no output, and all of its error is distortion.

    Args:
        inputs: of every record.
        errors: measured output minus that of the linear model, normalised.
        count: how many frequencies.

    Returns:
        Angles per sample, between 0 and π, rising.

    Raises:
        ValueError: the inputs reach up to half the sampling rate, or there are no errors above.
    """
    bands = [band(channel) for u in inputs for channel in u.T]
    edge = 2.0 * np.pi * max((high for found in bands if found for high in found), default=0.0)
    grid = np.linspace(edge, np.pi, GRID)
    power = np.zeros(GRID)  # of all frequencies from the edge up to each
    for error in errors:
        spectrum = np.fft.rfft(np.hanning(len(error) + 1)[:-1, None] * error, axis=0)
        below = np.cumsum((np.abs(spectrum) ** 2).sum(axis=1)) / len(error)
        power += np.interp(grid, np.linspace(0.0, np.pi, len(below)), below)
    power -= power[0]
    if edge >= LAST * np.pi or not power[-1] > 0:
        raise InputError(
            f"modes is {count}, and the linear model leaves no errors above the band that the "
            "inputs excite; give modes=0."
        )
    return np.interp((np.arange(count) + 0.5) / count, power / power[-1], grid)


@torch.no_grad()
def with_modes(
    cell: LFRCell, angles: Float[Array, " modes"], generator: torch.Generator
) -> LFRCell:
    """A cell with the same output, and modes that w alone drives beside its states.

    Their entries of Bw and Cy are random; those of Bu and Cz are 0, so that the modes are at rest
    as long as w is 0, and z is what it was.

    Args:
        cell: is copied.
        angles: natural frequency of each mode, rad per sample.
        generator: of the random entries.
    """
    nx, states = cell.nx, 2 * len(angles)
    like = {"dtype": cell.A.dtype, "device": cell.A.device}
    larger = LFRCell(cell.nu, cell.ny, nx + states, cell.nz, cell.nw, deepcopy(cell.static), **like)
    for name in ("A", "Bu", "Bw", "Cy", "Cz"):
        entries, own = larger.get_parameter(name).zero_(), cell.get_parameter(name)
        entries[: len(own), : own.shape[1]] = own
    for name in ("Dyu", "Dyw", "Dzu"):
        larger.get_parameter(name).copy_(cell.get_parameter(name))
    decay = torch.exp(-DAMPING * torch.as_tensor(angles))
    turn = np.sqrt(1.0 - DAMPING**2) * torch.as_tensor(angles)
    for i, (radius, angle) in enumerate(zip(decay.tolist(), turn.tolist(), strict=True)):
        at = slice(nx + 2 * i, nx + 2 * i + 2)
        cosine, sine = radius * np.cos(angle), radius * np.sin(angle)
        larger.A[at, at] = torch.tensor([[cosine, sine], [-sine, cosine]], **like)
    # White w of unit variance makes for states of about that.
    gain = (1.0 - decay**2).sqrt().repeat_interleave(2).to(**like)
    Bw, Cy = torch.empty(states, cell.nw, **like), torch.empty(cell.ny, states, **like)
    for entries in (Bw, Cy):
        entries.uniform_(-RANGE, RANGE, generator=generator)
    larger.Bw[nx:], larger.Cy[:, nx:] = gain[:, None] * Bw, Cy
    return larger
