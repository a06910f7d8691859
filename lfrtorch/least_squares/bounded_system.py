"""Steps of a search within bounds that hold to first order, tightened until they hold."""

from __future__ import annotations

from typing import Protocol

import scipy
import torch
from jaxtyping import Float
from torch import Tensor

from lfrtorch.least_squares.linear_systems import System

ROUNDING = 1e-12
"""A step at a bound is not beyond it."""


class Bounds(Protocol):
    """Bounds C δ <= room of a step δ, to first order."""

    slopes: Float[Tensor, "bounds own"]
    """C, for the first entries of a step; the others are 0."""

    room: Float[Tensor, " bounds"]
    """Limits of a step."""

    trusted: bool
    """Tell if a free step within the bounds is taken unchanged."""

    corrections: int
    """Most rounds in which they are tightened."""

    def tightened(
        self, step: Float[Tensor, " P"], room: Float[Tensor, " bounds"]
    ) -> Float[Tensor, " bounds"] | None:
        """The room to try next if the step passes the bounds by higher orders; else None."""
        # It is -inf if a step must be shorter before that can be told.
        ...


class BoundedSystem:
    """A system whose steps keep bounds."""

    # A step beyond them is replaced by the minimum of |r + J δ|² + λ|δ|² under C δ <= room, which
    # is tightened until the step keeps the bounds to all orders.

    def __init__(self, system: System, bounds: Bounds) -> None:
        self._system, self.size, self.rank = system, system.size, system.rank
        self.bounds = bounds

    @property
    def scale(self) -> float:
        """Largest eigenvalue of JᵀJ."""
        return self._system.scale

    def solve(self, gradient: Float[Tensor, " P"], damping: float) -> Float[Tensor, " P"]:
        """-(JᵀJ + λI)⁻¹ gradient, within the bounds."""
        free = step = self._system.solve(gradient, damping)
        slopes, room = self.bounds.slopes.to(free), self.bounds.room.to(free)
        C = free.new_zeros(len(slopes), len(free))
        C[:, : slopes.shape[1]] = slopes
        within = not (C @ free - room > ROUNDING).any()
        if not torch.isfinite(free).all() or (within and self.bounds.trusted):
            return free
        across = torch.stack([-self._system.solve(c, damping) for c in C])
        # Multipliers μ >= 0 of the bounds: the least |Lᵀμ - L⁻¹ excess|² for L Lᵀ = C across.
        G = C @ across.mT
        G.diagonal().add_(ROUNDING * G.diagonal().max() + torch.finfo(G.dtype).tiny)
        L = torch.linalg.cholesky(G)
        for _ in range(self.bounds.corrections):
            excess = (C @ free - room).unsqueeze(-1)
            rest = torch.linalg.solve_triangular(L, excess, upper=False).squeeze(-1)
            multipliers, _ = scipy.optimize.nnls(L.mT.cpu().numpy(), rest.cpu().numpy())
            step = free - across.mT @ torch.as_tensor(multipliers).to(free)
            tighter = self.bounds.tightened(step, room)
            if tighter is None:
                break
            if not torch.isfinite(tighter).all():
                return torch.full_like(free, torch.nan)  # refused; the next damping is larger
            room = tighter
        return step
