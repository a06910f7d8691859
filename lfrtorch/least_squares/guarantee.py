"""Guarantees of every model of a search: a stable linear part, or contraction."""

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
"""``"stable"``: A's eigenvalues stay within the unit circle. ``"contracting"``: every model is
proven to contract, and a number to contract by that rate."""


class Guarantee(Protocol):
    """A guarantee, of which a search asks two things."""

    def admissible(self, theta: Float[Tensor, " P"]) -> Float[Tensor, " P"]:
        """θ, or one near it that keeps the guarantee."""
        ...

    def bounded(self, theta: Float[Tensor, " P"], system: System) -> System:
        """The system at θ, whose steps keep the guarantee, to first order at least."""
        ...


def guarantee_of(name: Name | None, samples: int, cell: LFRCell) -> Guarantee | None:
    """The guarantee of a name; None if there is none, or nothing that could break it."""
    # ``samples``: of the longest record before they were cut into windows.
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
