"""A term: one summand |r(θ)|² of a problem, and the rows that it has in the Jacobian."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lfrtorch.least_squares.linear_systems import GramAccumulator, QRAccumulator
from lfrtorch.least_squares.start_states import StartStates

Seen = tuple[Any, ...]
"""Values of a term at a θ, about which it linearises: tuples of tensors, as trajectories."""


class Term(Protocol):
    """One summand |r(θ)|² of a problem."""

    def evaluate(self, theta: Float[Tensor, " P"], near: Seen | None = None) -> tuple[Tensor, Seen]:
        """r at θ, infinite or NaN where it is undefined, and what else is known there.

        ``near`` is what was seen at a θ close by, which may save time.
        """
        ...

    def linearise(
        self, theta: Float[Tensor, " P"], seen: Seen, *, eliminate: bool
    ) -> Sequence[TermRows | PenaltyRows]:
        """The rows of dr/dθ at θ; ``eliminate``: initial states are eliminated from them."""
        ...

    def release(self) -> None:
        """Free memory that only speeds up the next call."""


class TermRows(Protocol):
    """Some rows of J, weighted, and the residual there; gauge directions leave them as they are."""

    count: int
    """Number of rows."""

    states: StartStates | None
    """The initial states that the last ``fold`` eliminated."""

    def fold(
        self, kept: Int[Tensor, " K"], total: QRAccumulator | GramAccumulator, room: int
    ) -> int:
        """Add the rows [J r] in the kept columns; bytes cached, which are at most ``room``."""
        ...

    def tangent(
        self, d_theta: Float[Tensor, " P"], reduced: Float[Tensor, " K"]
    ) -> Float[Tensor, " count"]:
        """J dθ; the change is given in the kept columns, too."""
        ...

    def adjoint(
        self,
        residual: Float[Tensor, " count"],
        gradient: Float[Tensor, " P"],
        reduced: Float[Tensor, " K"],
    ) -> None:
        """Add Jᵀ residual to the gradient, or to the one in the kept columns."""
        ...

    def whole(self, parameters: int) -> Float[Tensor, "count P"]:
        """All rows, with as many columns as θ has parameters."""
        ...


class PenaltyRows:
    """A diagonal of J: each row sees one entry of θ, so a gauge direction does change it."""

    # If initial states are eliminated, all of them have the same factor.

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
