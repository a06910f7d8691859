"""A term: one summand |r(θ)|² of a problem, and its rows of the Jacobian."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lfrtorch.least_squares.linear_systems import GramAccumulator, QRAccumulator
from lfrtorch.least_squares.start_states import StartStates

Seen = tuple[Any, ...]
"""Values of a term at a θ that its linearisation needs, such as trajectories: tuples of tensors."""


class Term(Protocol):
    """One summand |r(θ)|² of a problem."""

    def evaluate(self, theta: Float[Tensor, " P"], near: Seen | None = None) -> tuple[Tensor, Seen]:
        """r at θ, infinite or NaN where it is undefined, and the values that ``linearise`` needs.

        ``near`` has these values at a nearby θ, which may save time.
        """
        ...

    def linearise(
        self, theta: Float[Tensor, " P"], seen: Seen, *, eliminate: bool
    ) -> Sequence[TermRows | PenaltyRows]:
        """The rows of dr/dθ at θ; with ``eliminate``, initial states are eliminated from them."""
        ...

    def release(self) -> None:
        """Free memory that only speeds up the next call."""


class TermRows(Protocol):
    """Some weighted rows of J and their residual; gauge directions do not change this residual."""

    count: int
    """Number of rows."""

    states: StartStates | None
    """The initial states that the last ``fold`` eliminated."""

    def fold(
        self, kept: Int[Tensor, " K"], total: QRAccumulator | GramAccumulator, room: int
    ) -> int:
        """Add the rows [J r] in the kept columns; return the bytes cached, up to ``room``."""
        ...

    def tangent(
        self, d_theta: Float[Tensor, " P"], reduced: Float[Tensor, " K"]
    ) -> Float[Tensor, " count"]:
        """J dθ; ``reduced`` is dθ in the kept columns."""
        ...

    def adjoint(
        self,
        residual: Float[Tensor, " count"],
        gradient: Float[Tensor, " P"],
        reduced: Float[Tensor, " K"],
    ) -> None:
        """Add Jᵀ residual to the gradient, or to ``reduced``, the gradient in the kept columns."""
        ...

    def whole(self, parameters: int) -> Float[Tensor, "count P"]:
        """All rows, with as many columns as θ has parameters."""
        ...


class PenaltyRows:
    """A diagonal part of J: each row depends on one entry of θ, so gauge directions change it."""

    # If initial states are eliminated, all of them have the same factor on the diagonal.

    def __init__(self, diagonal: Float[Tensor, " P"], residual: Float[Tensor, " P"]) -> None:
        self.diagonal, self.residual, self.count = diagonal, residual, len(diagonal)

    def tangent(
        self, d_theta: Float[Tensor, " P"], reduced: Float[Tensor, " K"]
    ) -> Float[Tensor, " P"]:
        """J dθ."""
        return self.diagonal * d_theta

    def adjoint(
        self,
        residual: Float[Tensor, " P"],
        gradient: Float[Tensor, " P"],
        reduced: Float[Tensor, " K"],
    ) -> None:
        """Add Jᵀ residual to the gradient."""
        gradient += self.diagonal * residual

    def whole(self, parameters: int) -> Float[Tensor, "P P"]:
        """All rows."""
        return torch.diag(self.diagonal)
