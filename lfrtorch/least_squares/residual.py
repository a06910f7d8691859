"""Interfaces of a residual r(θ) and its Jacobian, as a search uses them."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

from jaxtyping import Float
from torch import Tensor

from lfrtorch.least_squares.linear_systems import System


class Jacobian(Protocol):
    """The Jacobian J of a residual r; a search never needs the whole matrix."""

    def system(self, damping: float, truncation: float) -> tuple[System, Float[Tensor, " P"]]:
        """The system (JᵀJ + λI) δ = -gradient, and the gradient Jᵀr."""
        # ``damping`` is approximately λ of the next trial, relative to the largest eigenvalue of
        # JᵀJ; errors of the system may be a small part of it. Singular values below ``truncation``
        # times the largest are left out.
        ...

    def tangent(self, d_theta: Float[Tensor, " P"]) -> Float[Tensor, " M"]:
        """J dθ."""
        ...

    def adjoint(self, residual: Float[Tensor, " M"]) -> Float[Tensor, " P"]:
        """Jᵀ residual."""
        ...


class Point(NamedTuple):
    """A θ and a problem's evaluation there.

    Args:
        theta: θ (P,).
        residual: r (M,).
        cost: |r|².
        seen: further values that derivatives need, such as trajectories: tuples of tensors.
    """

    theta: Tensor
    residual: Tensor
    cost: float
    seen: tuple[Any, ...] = ()


class LeastSquares(Protocol):
    """A residual and its Jacobian. A residual that is undefined is infinite or NaN."""

    # A simple problem defines ``residual`` and ``linearise``. A problem that keeps more than r at a
    # θ defines ``evaluate`` and ``linearise_at``.

    def residual(self, theta: Float[Tensor, " P"]) -> Float[Tensor, " M"]:
        """r at θ."""
        ...

    def linearise(self, theta: Float[Tensor, " P"]) -> Jacobian:
        """dr/dθ at θ."""
        ...

    def evaluate(self, theta: Float[Tensor, " P"], near: Point | None = None) -> Point:
        """r at θ; ``near`` is a nearby point."""
        residual = self.residual(theta)
        return Point(theta, residual, self.cost(residual))

    def linearise_at(self, point: Point) -> Jacobian:
        """dr/dθ at a point."""
        return self.linearise(point.theta)

    def cost(self, residual: Float[Tensor, " M"]) -> float:
        """|r|², summed over the processes that share r."""
        return float(residual @ residual)

    def admissible(self, theta: Float[Tensor, " P"]) -> Float[Tensor, " P"]:
        """θ, or the nearby θ that the search may use in its place."""
        return theta
