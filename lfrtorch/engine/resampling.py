"""A cell at another sampling rate: u and w are held over a sample, as in the original.

Let w = K z + δw, where K is the slope of the static map at rest. The linear system with the inputs
u and δw is then a continuous system whose inputs are held::

    exp(T [Ac Bc]) = [A B]        so that exp(T' [Ac Bc]) = [A B]^(T'/T)
          [0  0 ]    [0 1]                      [0  0 ]    [0 1]

So the model linearised at rest is resampled exactly. The map is evaluated at the new samples of z.
"""

from __future__ import annotations

from copy import deepcopy

import numpy as np
import torch
from jaxtyping import Float
from scipy.linalg import expm, logm

from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array
from lfrtorch.engine.cell import LFRCell

_ROUNDING = 1e-6  # largest relative error of the logarithm


def resampled_cell(cell: LFRCell, K: Float[Array, "nw nz"], ratio: float) -> LFRCell:
    """Resample a cell to samples of ``ratio`` times the length.

    Raises:
        ValueError: a pole at 0 or on the negative real axis: no continuous system has it.
    """
    A, Bu, Bw, Cz, Dzu, *_ = cell.matrices()
    nx, nu = Bu.shape
    whole = np.eye(nx + nu + cell.nw)
    whole[:nx] = np.hstack([A + Bw @ K @ Cz, Bu + Bw @ K @ Dzu, Bw])
    poles = np.linalg.eigvals(whole[:nx, :nx])
    lost = (np.abs(poles.imag) < _ROUNDING) & (poles.real < _ROUNDING)
    rate = whole if lost.any() else np.real(logm(whole))
    error = np.abs(expm(rate) - whole).max()
    if lost.any() or not error <= _ROUNDING * np.abs(whole).max():
        why = (
            f"has a pole at {poles[lost.argmax()].real:.3g}, which no continuous system has"
            if lost.any()
            else "has a matrix whose logarithm is not accurate"
        )
        raise InputError(f"the model linearised at rest {why}; resample the data, and fit again.")
    after = expm(ratio * rate)[:nx]
    found = deepcopy(cell)
    Bw = after[:, nx + nu :]
    made = {
        "A": after[:, :nx] - Bw @ K @ Cz, "Bu": after[:, nx : nx + nu] - Bw @ K @ Dzu, "Bw": Bw,
    }  # fmt: skip
    with torch.no_grad():
        for name, value in made.items():
            getattr(found, name).copy_(torch.as_tensor(value))
    return found
