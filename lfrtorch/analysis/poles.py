"""Poles and zeros as an engineer reads them: frequency, damping, radius."""

from __future__ import annotations

import numpy as np
import torch

from lfrtorch._support.roots import frequency_and_damping, remark
from lfrtorch._support.types import Complex
from lfrtorch.engine.linearised import linearise
from lfrtorch.model import Model

__all__ = ["frequency_and_damping", "poles_at_rest", "remark"]


@torch.no_grad()
def poles_at_rest(model: Model) -> Complex:
    """Poles (nx,) of the NL-LFR linearised about its rest at the input's offset.

    They are the eigenvalues of A + Bw W'(z) Cz. If no stable rest is found, z is that of x = 0.

    Example:
        >>> from lfrtorch.analysis.poles import poles_at_rest
        >>> bool(abs(poles_at_rest(model)[0]) < 1)
        True
    """
    cell = model.lfr.cell
    u = cell.A.new_zeros(1, 1, cell.nu)
    z = model.lfr.trajectory(u, start="periodic").z
    if not torch.isfinite(z).all():
        z = torch.zeros_like(z)
    return np.asarray(np.linalg.eigvals(linearise(cell, z).F[0, 0].double().cpu().numpy()), complex)
