"""A normal prior: a penalty on all parameters together, but not on start states of records."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lfrtorch.least_squares.linear_systems import GramAccumulator, QRAccumulator
from lfrtorch.least_squares.start_states import StartStates
from lfrtorch.least_squares.term import Seen, Term


class PriorPenalty(Term):
    """A term of a problem: R (θ - θ_0)."""

    # Its rows depend on gauge directions away from θ_0, so a problem with this term computes all
    # columns of its Jacobian.

    def __init__(self, R: Float[Tensor, "K own"], theta_0: Float[Tensor, " P"]) -> None:
        self._R, self._theta_0 = R.to(theta_0), theta_0[: R.shape[1]]

    def evaluate(self, theta: Float[Tensor, " P"], near: Seen | None = None) -> tuple[Tensor, Seen]:
        """r at θ."""
        return self._R @ (theta[: len(self._theta_0)] - self._theta_0), ()

    def linearise(
        self, theta: Float[Tensor, " P"], seen: Seen, *, eliminate: bool
    ) -> list[PriorRows]:
        """The rows of dr/dθ."""
        return [PriorRows(self._R, self.evaluate(theta)[0])]


class PriorRows:
    """Constant rows R of a Jacobian, and their residual."""

    states: StartStates | None = None

    def __init__(self, R: Float[Tensor, "K own"], residual: Float[Tensor, " K"]) -> None:
        self._R, self._residual, self.count = R, residual, len(R)

    def fold(
        self, kept: Int[Tensor, " columns"], total: QRAccumulator | GramAccumulator, room: int
    ) -> int:
        """Add the rows [R r]; start states, the last columns, have zeros."""
        total.fold(torch.cat([self._wide(len(kept)), self._residual.unsqueeze(1)], dim=1))
        return 0

    def tangent(
        self, d_theta: Float[Tensor, " P"], reduced: Float[Tensor, " columns"]
    ) -> Float[Tensor, " K"]:
        """R dθ."""
        return self._R @ d_theta[: self._R.shape[1]]

    def adjoint(
        self,
        residual: Float[Tensor, " K"],
        gradient: Float[Tensor, " P"],
        reduced: Float[Tensor, " columns"],
    ) -> None:
        """Add Rᵀ residual to the gradient."""
        gradient[: self._R.shape[1]] += self._R.mT @ residual

    def whole(self, parameters: int) -> Float[Tensor, "K P"]:
        """All rows."""
        return self._wide(parameters)

    def _wide(self, columns: int) -> Float[Tensor, "K columns"]:
        wide = self._R.new_zeros(len(self._R), columns)
        wide[:, : self._R.shape[1]] = self._R
        return wide
