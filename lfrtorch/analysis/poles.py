"""Poles and zeros as an engineer reads them: frequency, damping, radius."""

from __future__ import annotations

import numpy as np

from lfrtorch._support.roots import frequency_and_damping, remark
from lfrtorch._support.types import Complex
from lfrtorch.engine.operating_point import double, equilibrium, linearised_at
from lfrtorch.model import Model

__all__ = ["frequency_and_damping", "poles_at_rest", "remark"]


def poles_at_rest(model: Model) -> Complex:
    """Poles (nx,) of the NL-LFR linearised about its rest, stable or not, at the input's offset.

    They are the eigenvalues of A + Bw W'(z) Cz. If no rest is found, z is that of x = 0.

    Example:
        >>> from lfrtorch.analysis.poles import poles_at_rest
        >>> bool(abs(poles_at_rest(model)[0]) < 1)
        True
    """
    cell = double(model.lfr.cell)
    u = cell.A.new_zeros(cell.nu)
    x = equilibrium(cell, u)
    at = linearised_at(cell, u, u.new_zeros(cell.nx) if x is None else x)
    return np.asarray(np.linalg.eigvals(at.A), complex)
