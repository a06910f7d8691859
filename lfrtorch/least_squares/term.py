"""A term: one summand |r(θ)|² of a problem, and the rows that it has in the Jacobian."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lfrtorch.least_squares.linear_systems import GramAccumulator, QRAccumulator
from lfrtorch.least_squares.start_states import StartStates


class Term(Protocol):
    """One summand |r(θ)|² of a problem."""

    eliminates: bool = True
    """Whether initial states can be eliminated from its rows."""

    def residual(self, theta: Float[Tensor, " P"]) -> Float[Tensor, " M"]:
        """r at θ; infinite or NaN where it is undefined."""
        ...

    def linearise(
        self, theta: Float[Tensor, " P"], *, eliminate: bool
    ) -> Sequence[TermRows | PenaltyRows]:
        """The rows of dr/dθ at θ; ``eliminate``: initial states are eliminated from them."""
        ...

    def release(self) -> None:
        """Free the memory of what only speeds up the next evaluation."""

    def state_dict(self) -> dict[str, Tensor]:
        """What the next evaluations depend on besides θ, to the last bit."""
        return {}

    def load_state_dict(self, tensors: Mapping[str, Tensor]) -> None:
        """Take over what the same term had."""


class TermRows(Protocol):
    """Some rows of J, weighted, and the residual there; gauge directions leave them as they are."""

    count: int
    """How many rows there are."""

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
