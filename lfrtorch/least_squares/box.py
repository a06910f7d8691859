"""Bounds of single parameters: steps end at the bounds, and θ is clipped to them."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from lfrtorch.engine.cell import LFRCell
from lfrtorch.least_squares.bounded_system import BoundedSystem
from lfrtorch.least_squares.linear_systems import System


def bounds_of(cell: LFRCell) -> Float[Tensor, "free 2"]:
    """Lower and upper bound of each free parameter of a cell; infinite without a bound."""
    sizes = [(name, p.numel(), p.requires_grad) for name, p in cell.named_parameters()]
    of_map, at, free = cell.map.weight_bounds, 0, [cell.A.new_zeros(0, 2)]
    for name, count, is_free in sizes:
        ends = cell.A.new_tensor([-torch.inf, torch.inf]).repeat(count, 1)
        if name.startswith("static."):
            ends, at = of_map[at : at + count], at + count
        free += [ends] * is_free
    return torch.cat(free)


class Box:
    """The guarantee that parameters stay within bounds."""

    def __init__(self, bounds: Float[Tensor, "free 2"]) -> None:
        self._low, self._high = bounds.unbind(-1)

    def admissible(self, theta: Float[Tensor, " P"]) -> Float[Tensor, " P"]:
        """θ with each parameter clipped to its bounds."""
        own = theta[: len(self._low)].clamp(self._low, self._high)
        return torch.cat([own, theta[len(own) :]])

    def bounded(self, theta: Float[Tensor, " P"], system: System) -> System:
        """The system whose steps do not pass the nearer bound of each parameter."""
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
        """None, as the bounds are linear."""
        return None
