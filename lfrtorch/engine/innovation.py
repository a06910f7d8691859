"""The innovation form of an NL-LFR, and its one-step predictor, which is an NL-LFR again.

A disturbance inside the system moves the states, and becomes visible in the outputs::

    x+ = A x + Bu u + Bw w + K e
    y  = Cy x + Dyu u + Dyw w + e

with unpredictable innovations e. Inserting e = y - ŷ into the first equation shows that the best
prediction ŷ of the next output is the output of an NL-LFR with the inputs u and the measured y::

    x+ = (A - K Cy) x + (Bu - K Dyu) u + K y + (Bw - K Dyw) w
    ŷ  = Cy x + Dyu u + Dyw w

Neither ŷ nor z has feedthrough from y: these columns are zero, and a fit holds them. The two forms
have the same number of parameters, and each determines the other. If an entry of A, Bu or Bw is
held in the system, an equation between entries of the predictor and of K is held.

References:
    Ljung, "System Identification: Theory for the User", 2nd ed., 1999, section 4.3.
"""

from __future__ import annotations

from copy import deepcopy

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from lfrtorch.engine.cell import LFRCell, Matrices
from lfrtorch.engine.held import TIED, past_outputs


def predictor_cell(cell: LFRCell, K: Float[Tensor, "nx ny"]) -> LFRCell:
    """The one-step predictor of a cell with the innovation gain K: its inputs are u, then y.

    The predictor also holds the held entries of the cell's output equations. Held entries of A, Bu
    and Bw become ``of_system`` of the predictor.
    """
    with torch.no_grad():
        K = K.to(cell.A)
        found = _like(cell, cell.nu + cell.ny)
        found.A.copy_(cell.A - K @ cell.Cy)
        found.Bu.copy_(torch.cat([cell.Bu - K @ cell.Dyu, K], dim=1))
        found.Bw.copy_(cell.Bw - K @ cell.Dyw)
        for name in ("Dzu", "Dyu"):
            getattr(found, name)[:, : cell.nu] = getattr(cell, name)
    for name, mask in cell.held.items():
        if name not in TIED:
            wider = found.get_parameter(name).shape[-1] - mask.shape[-1]
            found.held[name] = pad(mask, (0, wider))
    found.hold(past_outputs(found))
    own = {name: cell.get_parameter(name).detach().clone() for name in TIED}
    found.of_system = {n: (cell.held[n], own[n]) for n in TIED if n in cell.held}
    return found


def split_predictor(cell: LFRCell) -> tuple[LFRCell, Float[Tensor, "nx ny"]]:
    """The cell of a predictor's system, and its innovation gain K."""
    with torch.no_grad():
        found = _like(cell, cell.nu - cell.ny)
        K = cell.Bu[:, found.nu :].clone()
        found.A.copy_(cell.A + K @ cell.Cy)
        found.Bu.copy_(cell.Bu[:, : found.nu] + K @ cell.Dyu[:, : found.nu])
        found.Bw.copy_(cell.Bw + K @ cell.Dyw)
        for name in ("Dzu", "Dyu"):
            getattr(found, name).copy_(getattr(cell, name)[:, : found.nu])
    for name, mask in cell.held.items():
        own = mask[:, : found.nu] if name in ("Dzu", "Dyu") else mask
        if own.any():
            found.held[name] = own.clone()
    found.hold(cell.of_system or {})
    return found, K


def _like(cell: LFRCell, nu: int) -> LFRCell:
    """A cell with ``nu`` inputs, the matrices that both forms share, and a copy of the map."""
    A = cell.A
    sizes = nu, cell.ny, cell.nx, cell.nz, cell.nw
    found = LFRCell(*sizes, deepcopy(cell.static), device=A.device, dtype=A.dtype, random=False)
    for name in ("Cz", "Cy", "Dyw", "state_covariance"):
        getattr(found, name).copy_(getattr(cell, name))
    for name in {*Matrices._fields} - {*TIED}:  # frozen matrices stay frozen
        found.get_parameter(name).requires_grad_(cell.get_parameter(name).requires_grad)
    return found
