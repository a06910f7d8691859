"""A residual r(θ) and its Jacobian, as far as a search needs them."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

from jaxtyping import Float
from torch import Tensor

from lfrtorch.least_squares.linear_systems import System


class Jacobian(Protocol):
    """The Jacobian J of a residual r, as far as the search needs it: never the whole matrix."""

    def system(self, damping: float, truncation: float) -> tuple[System, Float[Tensor, " P"]]:
        """The system (JᵀJ + λI) δ = -gradient, and the gradient Jᵀr."""
        # ``damping`` is about λ of the next trial relative to the largest eigenvalue of JᵀJ; errors
        # of the system may be a small part of it. Singular values below ``truncation`` of the
        # largest are left out.
        ...

    def tangent(self, d_theta: Float[Tensor, " P"]) -> Float[Tensor, " M"]:
        """J dθ."""
        ...

    def adjoint(self, residual: Float[Tensor, " M"]) -> Float[Tensor, " P"]:
        """Jᵀ residual."""
        ...


class Point(NamedTuple):
    """A θ and what a problem found there.

    Args:
        theta: θ (P,).
        residual: r (M,).
        cost: |r|².
        seen: further values for derivatives there, as trajectories: tuples of tensors.
    """

    theta: Tensor
    residual: Tensor
    cost: float
    seen: tuple[Any, ...] = ()


class LeastSquares(Protocol):
    """A residual and its Jacobian. A residual that is undefined is infinite or NaN."""

    # A simple problem has ``residual`` and ``linearise``. One that keeps more of a θ than r has
    # ``evaluate`` and ``linearise_at``.

    def residual(self, theta: Float[Tensor, " P"]) -> Float[Tensor, " M"]:
        """r at θ."""
        ...

    def linearise(self, theta: Float[Tensor, " P"]) -> Jacobian:
        """dr/dθ at θ."""
        ...

    def evaluate(self, theta: Float[Tensor, " P"], near: Point | None = None) -> Point:
        """r at θ; ``near`` is a point close by."""
        residual = self.residual(theta)
        return Point(theta, residual, self.cost(residual))

    def linearise_at(self, point: Point) -> Jacobian:
        """dr/dθ at a point."""
        return self.linearise(point.theta)

    def cost(self, residual: Float[Tensor, " M"]) -> float:
        """|r|², summed over the processes that share r."""
        return float(residual @ residual)

    def admissible(self, theta: Float[Tensor, " P"]) -> Float[Tensor, " P"]:
        """θ, or one near it that the search may go to."""
        return theta
