"""A problem whose records several processes share; each computes the residual of its own records.

All processes have the same θ, cost, gradient and steps: sums go over all processes, and where
rounding errors matter, the numbers of the first process are used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Float
from torch import Tensor

from lfrtorch._support.errors import InputError
from lfrtorch.data.records import Record
from lfrtorch.distributed import Ranks, current
from lfrtorch.least_squares.jacobian import Jacobian
from lfrtorch.least_squares.linear_systems import GramAccumulator, QRAccumulator, System
from lfrtorch.least_squares.problem import Problem
from lfrtorch.least_squares.ridge import Ridge

if TYPE_CHECKING:
    from lfrtorch.model.model import Model


def problem_of(model: Model, records: Record | Sequence[Record], **options: Any) -> Problem:
    """The problem of the processes that work together now; see ``Problem.of``."""
    kind = SharedProblem if current().world > 1 else Problem
    return kind.of(model, records, **options)


class SharedProblem(Problem):
    """One process's part of a problem."""

    shared = True

    def __init__(self, *parts: Any, **options: Any) -> None:
        self._ranks = current()
        super().__init__(*parts, **options)

    @classmethod
    def _share(cls, model: Model, records: Sequence[Record]) -> slice:
        """The records of this process; its model gets the weights of the first process's model."""
        ranks = current()
        if len(records) < ranks.world:
            raise InputError(
                f"{ranks.world} processes share {len(records)} record(s), but each needs one; "
                "start fewer processes, or cut the data into more records."
            )
        same_weights([model])
        return slice(ranks.rank, None, ranks.world)

    def total(self, part: Tensor) -> Tensor:
        """The sum of the parts of all processes."""
        return self._ranks.sum(part)

    def agreed(self, part: Tensor) -> Tensor:
        """The numbers of the first process."""
        return self._ranks.first(part)

    def of_own_records(self, state: Any) -> Any:
        """A search's state with the residual of this process's records."""
        point = self.evaluate(state.theta)
        return replace(state, residual=point.residual, seen=point.seen)

    def weigh(self, ridge: Ridge | Tensor) -> None:
        """Give the ridge another weight; only the first process has the rows of the ridge."""
        super().weigh(ridge if self._ranks.rank == 0 else 0.0)

    def _first_theta(self) -> Float[Tensor, " P"]:
        theta, own = self.errors.first_theta(), self.errors.parameters.own
        return torch.cat([theta[:own], self.total(theta[own:])])

    def _jacobian(self, *parts: Any) -> Jacobian:
        return _SharedJacobian(*parts, ranks=self._ranks)


class _SharedJacobian(Jacobian):
    """The Jacobian of all records; each process has the rows of its own records."""

    def __init__(self, *parts: Any, ranks: Ranks) -> None:
        super().__init__(*parts)
        self._ranks = ranks

    def system(self, damping: float, truncation: float) -> tuple[System, Float[Tensor, " P"]]:
        """The least-squares system of J and its gradient, as the first process computes them."""
        system, gradient = super().system(damping, truncation)
        return BroadcastSystem(system, self._ranks), self._ranks.first(gradient)

    def adjoint(self, residual: Float[Tensor, " M"]) -> Float[Tensor, " P"]:
        """Jᵀ residual."""
        return self._ranks.sum(super().adjoint(residual))

    def _complete(self, total: QRAccumulator | GramAccumulator) -> None:
        if isinstance(total, GramAccumulator):
            total.replace(self._ranks.sum(total.G))
        else:
            total.replace(torch.linalg.qr(self._ranks.stack(total.R), mode="r").R)


class BroadcastSystem:
    """A system that the first process solves for all, so that all have its rounding errors."""

    def __init__(self, system: System, ranks: Ranks) -> None:
        self._system, self._ranks = system, ranks
        self.size = self._shared(system.size)
        self.rank = int(ranks.first(torch.tensor(system.rank)))

    @property
    def scale(self) -> float:
        """Largest eigenvalue of JᵀJ."""
        return self._shared(self._system.scale)

    def _shared(self, number: float) -> float:
        return float(self._ranks.first(torch.tensor(number, dtype=torch.float64)))

    def solve(self, gradient: Float[Tensor, " P"], damping: float) -> Float[Tensor, " P"]:
        """-(JᵀJ + λI)⁻¹ gradient."""
        return self._ranks.first(self._system.solve(gradient, damping))


@torch.no_grad()
def same_weights(models: Sequence[Model]) -> None:
    """Give all processes that work together the weights of the first process's models."""
    for model in models if current().world > 1 else ():
        for p in model.lfr.parameters():
            p.copy_(current().first(p.detach()))
