"""Jacobian of the residual: its least-squares system and its products with vectors.

A step of the search solves a least-squares problem with J, which has a row for every sample and
output and a column for every parameter. For long records J is too large to hold, but a step only
needs a small matrix with the same JᵀJ. So the rows are computed block by block. Each block is added
to an accumulator (``linear_systems``) and then dropped. Columns that are combinations of others
(``gauge``) are not computed if that saves time. ``output_rows`` computes the rows of simulated
outputs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lfrtorch.least_squares.gauge import Reduction
from lfrtorch.least_squares.held_steps import ProjectedSystem, Projection
from lfrtorch.least_squares.linear_systems import (
    CholeskySystem,
    GramAccumulator,
    QRAccumulator,
    ReducedSystem,
    SVDSystem,
    System,
)
from lfrtorch.least_squares.start_states import EliminatedSystem, StartStates
from lfrtorch.least_squares.term import PenaltyRows, TermRows

EPS = torch.finfo(torch.float64).eps

NORMAL = 1e4
"""Relative damping, in units of rounding errors, above which normal equations are as good as QR."""

CACHED_BYTES = 1 << 27
"""Largest size of the cached rows of all groups together."""


class Jacobian:
    """J (M, P) of a residual at one θ."""

    # ``project`` makes the columns of held entries zero. The first ``shared`` columns are those of
    # parameters that all records share. The other columns are of start states, which the parts
    # eliminate.

    def __init__(
        self,
        parts: Sequence[TermRows | PenaltyRows],
        reduced: Reduction,
        project: Projection,
        shared: int,
        rank: int,
        bounded: Callable[[System], System] | None = None,
    ) -> None:
        self.parts, self._reduced, self._project = parts, reduced, project
        self._shared, self._rank, self._bounded = shared, rank, bounded

    def system(self, damping: float, truncation: float) -> tuple[System, Float[Tensor, " P"]]:
        """The least-squares system of J and its gradient Jᵀr; see the search's ``Jacobian``."""
        gram = damping > NORMAL * EPS
        total = GramAccumulator() if gram else QRAccumulator()
        # Rows [J r] of outputs are computed in the kept columns. Rows of a penalty are added to all
        # columns, as they are not combinations of kept columns.
        penalties = [part for part in self.parts if isinstance(part, PenaltyRows)]
        states, room = [], CACHED_BYTES
        for part in self.parts:
            if not isinstance(part, PenaltyRows):
                room -= part.fold(self._reduced.kept, total, room)
                states += [] if part.states is None else [part.states]
        self._complete(total)
        penalty = None
        if penalties:
            squares = torch.stack([part.diagonal.square() for part in penalties])
            penalty = squares.sum(0).masked_fill(self._project.entries, 0.0)
        if states:
            system, gradient = self._eliminated(total, states, penalty, truncation)
        elif isinstance(total, GramAccumulator):
            system, gradient = self._normal(total.G, penalty)
        else:
            system, gradient = self._orthogonal(total.R, penalty, truncation)
        for part in penalties:
            gradient = gradient + part.diagonal * part.residual
        gradient = self._project(gradient)
        if self._project.tied or (self._project.held and self._bounded is not None):
            system = ProjectedSystem(system, self._project)
        system = system if self._bounded is None else self._bounded(system)
        return system, gradient

    def _complete(self, total: QRAccumulator | GramAccumulator) -> None:
        """Add the rows of other processes; here there are none."""

    def _normal(
        self, G: Float[Tensor, "columns columns"], penalty: Float[Tensor, " P"] | None
    ) -> tuple[System, Float[Tensor, " P"]]:
        """The system and the gradient, by the normal equations."""
        expand = self._reduced.expand
        G, gradient = G[:-1, :-1], self._reduced.gradient(G[:-1, -1])
        if expand is not None and not self._project.held:
            ridge = 0.0 if penalty is None else float(penalty[0])
            if penalty is None or bool((penalty == ridge).all()):
                return ReducedSystem(G, expand, ridge), gradient
        # JᵀJ = expandᵀ G expand: expand the columns, transpose, and expand the columns again.
        if expand is not None:
            G = self._reduced.columns(self._reduced.columns(G).mT)
        G = self._project(self._project(G).mT)
        return CholeskySystem(
            G if penalty is None else G + torch.diag(penalty), self._rank
        ), gradient

    def _orthogonal(
        self, R: Float[Tensor, "k columns"], penalty: Float[Tensor, " P"] | None, truncation: float
    ) -> tuple[System, Float[Tensor, " P"]]:
        """The system and the gradient, by singular values."""
        R, r = self._project(self._reduced.columns(R[:, :-1])), R[:, -1]
        rows = R if penalty is None else torch.cat([R, penalty.sqrt().diag()])
        return SVDSystem(rows, truncation), R.mT @ r

    def _eliminated(
        self,
        total: QRAccumulator | GramAccumulator,
        found: Sequence[StartStates],
        penalty: Float[Tensor, " P"] | None,
        truncation: float,
    ) -> tuple[System, Float[Tensor, " P"]]:
        """The system and the gradient, with the start states eliminated."""
        states = StartStates(*map(torch.cat, zip(*found, strict=True)))
        states = states._replace(A=self._project(states.A))
        gram = isinstance(total, GramAccumulator)
        if gram:
            left = self._project(self._project(total.G[:-1, :-1]).mT)
            gradient = total.G[:-1, -1]
        else:
            left = self._project(total.R[:, :-1])
            gradient = left.mT @ total.R[:, -1]
        whole = gradient.new_zeros(len(self._project.entries))
        penalty = whole if penalty is None else penalty
        system = EliminatedSystem(left, states, penalty, gram=gram, truncation=truncation)
        whole = whole.clone()
        whole[: self._shared] = gradient + torch.einsum("rij,ri->j", states.A, states.r)
        whole[states.place] = torch.einsum("rij,ri->rj", states.Vh, states.s * states.r)
        return system, whole

    def triangle(self, columns: Int[Tensor, " K"]) -> Float[Tensor, "m K"]:
        """R with RᵀR = JᵀJ in some columns, in rising order, without penalties."""
        total = QRAccumulator()
        for part in self.parts:
            if not isinstance(part, PenaltyRows):
                part.fold(columns, total, 0)
        self._complete(total)
        return total.R[:, :-1]

    def tangent(self, d_theta: Float[Tensor, " P"]) -> Float[Tensor, " M"]:
        """J dθ."""
        d_theta = self._project(d_theta)
        reduced = self._reduced.reduced(d_theta[: self._shared])
        found = [part.tangent(d_theta, reduced) for part in self.parts]
        return found[0] if len(found) == 1 else torch.cat(found)

    def adjoint(self, residual: Float[Tensor, " M"]) -> Float[Tensor, " P"]:
        """Jᵀ residual."""
        gradient = residual.new_zeros(len(self._project.entries))
        reduced = residual.new_zeros(len(self._reduced.kept))
        several = len(self.parts) > 1
        each = residual.split([part.count for part in self.parts]) if several else [residual]
        for part, own in zip(self.parts, each, strict=True):
            part.adjoint(own, gradient, reduced)
        gradient[: self._shared] += self._reduced.gradient(reduced)
        return self._project(gradient)

    def whole(self) -> Float[Tensor, "M P"]:
        """J as one matrix, for small problems."""
        return self._project(
            torch.cat([part.whole(len(self._project.entries)) for part in self.parts])
        )
