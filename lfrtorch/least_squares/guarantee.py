"""Guarantees that every model of a search keeps: a stable linear part, or contraction."""

from __future__ import annotations

from importlib import import_module
from typing import Literal, Protocol

import torch
from jaxtyping import Float
from torch import Tensor

from lfrtorch.engine.cell import LFRCell
from lfrtorch.least_squares.box import Box, bounds_of
from lfrtorch.least_squares.linear_systems import System
from lfrtorch.least_squares.options import check_guarantee
from lfrtorch.least_squares.stable_states import Stable

Name = Literal["stable", "contracting"] | float
"""``"stable"``: the eigenvalues of A stay within the unit circle. ``"contracting"``: every model is
proven to contract. A number: every model is proven to contract at this rate."""


class Guarantee(Protocol):
    """A guarantee, with the two methods that a search calls."""

    def admissible(self, theta: Float[Tensor, " P"]) -> Float[Tensor, " P"]:
        """θ, or a nearby θ that keeps the guarantee."""
        ...

    def bounded(self, theta: Float[Tensor, " P"], system: System) -> System:
        """The system at θ whose steps keep the guarantee, at least to first order."""
        ...


def guarantee_of(name: Name | None, samples: int, cell: LFRCell) -> Guarantee | None:
    """The guarantee of a name; None without a name, or if no free parameter could break it."""
    # ``samples`` is the length of the longest record, before records are cut into windows.
    if isinstance(name, float):
        check_guarantee(name)
    if name == "contracting" or isinstance(name, float):
        contracting = import_module("lfrtorch.guarantees.contracting").Contracting
        return contracting(cell, name) if isinstance(name, float) else contracting(cell)
    bounds = bounds_of(cell)
    if name is None and torch.isfinite(bounds).any():
        return Box(bounds)
    moves = cell.A.requires_grad and not cell.held.get("A", cell.A.new_zeros(1)).all()
    return Stable(cell, samples) if name == "stable" and moves else None
