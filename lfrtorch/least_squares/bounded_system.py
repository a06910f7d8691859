"""Steps of a search within bounds: linear bounds, tightened until the exact bounds hold."""

from __future__ import annotations

from typing import Protocol

import scipy
import torch
from jaxtyping import Float
from torch import Tensor

from lfrtorch.least_squares.linear_systems import System

ROUNDING = 1e-12
"""Relative excess over a bound that counts as rounding."""


class Bounds(Protocol):
    """Bounds C δ <= room of a step δ, to first order."""

    slopes: Float[Tensor, "bounds own"]
    """C for the first entries of a step; its columns for further entries are 0."""

    room: Float[Tensor, " bounds"]
    """Upper limits of C δ."""

    trusted: bool
    """True if an unconstrained step within the linear bounds is taken without a further check."""

    corrections: int
    """Largest number of times that the bounds are tightened."""

    def tightened(
        self, step: Float[Tensor, " P"], room: Float[Tensor, " bounds"]
    ) -> Float[Tensor, " bounds"] | None:
        """The room to try next if the step passes the exact bounds; otherwise None."""
        # The room is -inf if only a shorter step can be checked.
        ...


class BoundedSystem:
    """A least-squares system whose steps stay within bounds."""

    # A step beyond the bounds is replaced by the minimum of |r + J δ|² + λ|δ|² under C δ <= room.
    # ``room`` is tightened until the step keeps the exact bounds.

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
        # Multipliers μ >= 0 of the bounds minimise |Lᵀμ - L⁻¹ excess|², with L Lᵀ = C across.
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
                return torch.full_like(free, torch.nan)  # refused; the search raises the damping
            room = tighter
        return step
