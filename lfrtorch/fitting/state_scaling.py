"""Scaling of states to unit rms over the training data, at the end of a fit."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from lfrtorch.data.records import Record
from lfrtorch.engine.cell import LFRCell
from lfrtorch.model.model import Model, state_moment


@torch.no_grad()
def scale_states(
    model: Model, records: Record | Sequence[Record], *, keep_coordinates: bool = False
) -> None:
    """Scale a model's states to unit rms over records, in place, and store their covariance."""
    # The covariance is E x xᵀ about 0: the error of an observer or a simulation that begins at
    # x = 0 amid such data. The coordinates change by a diagonal matrix. So zeros of A stay zero,
    # and the diagonal of A keeps its bits: exact integrators stay exact, and a certificate of
    # contraction stays valid with another P. No state is scaled if one of their matrices is frozen
    # or has another held entry, if start states are given (``keep_coordinates``), or if the model
    # diverges. In the last case the covariance is the identity.
    cell, moment = model.lfr.cell, state_moment(model, records)
    if not torch.isfinite(moment).all():
        moment = torch.eye(cell.nx, dtype=torch.float64)
    rms = moment.diagonal().sqrt()
    into, of = (cell.Bu, cell.Bw), (cell.Cz, cell.Cy)
    free = all(weight.requires_grad for weight in (cell.A, *into, *of)) and _scalable(cell)
    if keep_coordinates or not free:
        rms = torch.ones_like(rms)
    rms = torch.where((rms == 0) | ((rms - 1.0).abs() < 1e-9), 1.0, rms)  # ignores rounding
    cell.state_covariance.copy_(moment / torch.outer(rms, rms))
    cell.A.mul_((rms / rms[:, None]).to(cell.A))
    for weight in into:
        weight.div_(rms[:, None].to(weight))
    for weight in of:
        weight.mul_(rms.to(weight))
    if cell.of_system and "A" in cell.of_system:
        mask, A = cell.of_system["A"]
        cell.of_system = {**cell.of_system, "A": (mask, A * (rms / rms[:, None]).to(A))}


def _scalable(cell: LFRCell) -> bool:
    """Tell if scaling the states changes no held entry.

    Zeros and the diagonal of A never change. Held entries between integrators may change, as the
    integrators stay exact.
    """
    own = {name: (cell.held[name], cell.get_parameter(name).detach()) for name in cell.held}
    for name, (mask, values) in {**own, **(cell.of_system or {})}.items():
        moves = mask & (values != 0).cpu()
        if name == "A":
            chained = (values.diagonal() == 1).cpu()
            moves &= ~(torch.eye(cell.nx, dtype=torch.bool) | chained[:, None] & chained)
        if name in ("A", "Bu", "Bw", "Cz", "Cy") and moves.any():
            return False
    return True
