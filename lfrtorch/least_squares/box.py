"""Bounds of single parameters: steps that end at them, and a θ that is put back within them."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.nonlinearity import known_parts
from lfrtorch.least_squares.bounded_system import BoundedSystem
from lfrtorch.least_squares.linear_systems import System


def bounds_of(cell: LFRCell) -> Float[Tensor, "free 2"]:
    """Least and largest value of each free parameter of a cell; infinite where there is none."""
    parts = known_parts(cell.static)
    model = None if parts is None else parts[0]
    free = []
    for p in cell.parameters():
        if p.requires_grad:
            ends = p.new_tensor([-torch.inf, torch.inf]).repeat(p.numel(), 1)
            if model is not None and p is model.p:
                ends = model.bounds / model.p_scale.unsqueeze(-1)
            free.append(ends)
    return torch.cat([cell.A.new_zeros(0, 2), *free])


class Box:
    """A guarantee: parameters within bounds."""

    def __init__(self, bounds: Float[Tensor, "free 2"]) -> None:
        self._low, self._high = bounds.unbind(-1)

    def admissible(self, theta: Float[Tensor, " P"]) -> Float[Tensor, " P"]:
        """θ with each parameter at the nearest value within its bounds."""
        own = theta[: len(self._low)].clamp(self._low, self._high)
        return torch.cat([own, theta[len(own) :]])

    def bounded(self, theta: Float[Tensor, " P"], system: System) -> System:
        """The system whose steps end at the nearer bound of each parameter."""
        return BoundedSystem(system, _Nearest(theta[: len(self._low)], self._low, self._high))


class _Nearest:
    """The nearer bound of each parameter, as bounds of a step."""

    trusted, corrections = True, 1

    def __init__(self, own: Tensor, low: Tensor, high: Tensor) -> None:
        up, down = high - own, own - low
        near = torch.nonzero(torch.isfinite(torch.minimum(up, down))).flatten()
        sign = torch.where(up <= down, 1.0, -1.0).to(own)[near]
        self.slopes = own.new_zeros(len(near), len(own))
        self.slopes[torch.arange(len(near)), near] = sign
        self.room = torch.minimum(up, down)[near].clamp_min(0.0)

    def tightened(
        self, step: Float[Tensor, " P"], room: Float[Tensor, " near"]
    ) -> Float[Tensor, " near"] | None:
        """None: the bounds are linear."""
        return None
