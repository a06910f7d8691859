"""Start states that are parameters: each is eliminated from its own record.

In θ = (φ, x0 of record 1, x0 of record 2, ...) each record sees φ and its own start state. So
JᵀJ + λI has entries between φ and everything else alone, and with A and B, the columns of φ and of
x0 in the rows of a record, every x0 follows from φ: a system in φ is left, whose size does not
grow with the number of records. That of all of θ takes time with the cube of it.

Let B = U s Vᵀ: the start states leave A - U (Uᵀ A) of the rows for φ at λ = 0. A damping λ keeps
them from following φ all the way, and λ / (s² + λ) of each row of Uᵀ A remains.

References:
    Golub and Pereyra, "The differentiation of pseudo-inverses and nonlinear least squares problems
    whose variables separate", SIAM J. Numerical Analysis 10, 1973.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from lfrtorch._support.threads import has_kernels
from lfrtorch.least_squares.linear_systems import (
    GramAccumulator,
    QRAccumulator,
    SVDSystem,
    largest_eigenvalue,
    product,
)


class StartStates(NamedTuple):
    """Information of the rows of records on their start states, in the coordinates Vᵀ x0."""

    # B = U s Vᵀ; A and r are Uᵀ A and Uᵀ r; ``place`` is where each start state stands in θ.

    place: Int[Tensor, "R nx"]
    s: Float[Tensor, "R nx"]
    Vh: Float[Tensor, "R nx nx"]
    A: Float[Tensor, "R nx P"]
    r: Float[Tensor, "R nx"]


class Eliminator:
    """Folds the rows [A r] of φ that the start states leave into an accumulator."""

    def __init__(
        self,
        place: Int[Tensor, "R nx"],
        samples: int,
        total: QRAccumulator | GramAccumulator,
    ) -> None:
        self._place, self._samples, self._total = place, samples, total
        self._found: list[tuple[Tensor, ...]] = []
        self._begun: list[QRAccumulator] = []

    def fold(self, rows: Float[Tensor, "R m columns"], time: slice) -> None:
        """Add rows [A B r] of some records at some samples; records come one after another."""
        if time.start == 0 and time.stop == self._samples:
            self._eliminate(rows)
            return
        if time.start == 0:
            self._begun = [QRAccumulator() for _ in rows]
        for begun, own in zip(self._begun, rows, strict=True):
            begun.fold(own)
        if time.stop == self._samples:
            self._eliminate(torch.stack([begun.R for begun in self._begun]))

    def found(self) -> StartStates:
        """Those of all records."""
        s, Vh, A, r = (torch.cat(parts) for parts in zip(*self._found, strict=True))
        return StartStates(self._place.to(s.device), s, Vh, A, r)

    def _eliminate(self, rows: Float[Tensor, "R m columns"]) -> None:
        nx, columns = self._place.shape[1], rows.shape[2]
        if rows.shape[1] < nx:
            rows = torch.nn.functional.pad(rows, (0, 0, 0, nx - rows.shape[1]))
        B = rows[..., columns - nx - 1 : -1]
        if not torch.isfinite(B).all():
            rows, B = torch.full_like(rows, torch.nan), torch.zeros_like(B)
        U, s, Vh = torch.linalg.svd(B, full_matrices=False)
        seen = _products(U.mT, rows)
        # Of B nothing is left, so that its columns may stay among the others.
        part = type(self._total)()
        if isinstance(part, GramAccumulator):  # a difference loses no more digits than products do
            part.fold(rows.flatten(0, 1))
            part.add(-product(seen.flatten(0, 1).mT, seen.flatten(0, 1)))
        else:
            part.fold((rows - _products(U, seen)).flatten(0, 1))
        place = torch.arange(columns, device=rows.device)
        kept = torch.cat([place[: columns - nx - 1], place[-1:]])
        self._total.add_columns(part, kept)
        self._found.append((s, Vh, seen[..., : columns - nx - 1], seen[..., -1]))


def _products(left: Float[Tensor, "R m k"], right: Float[Tensor, "R k n"]) -> Tensor:
    """Products of small matrices, by numpy on the CPU: three times faster for many."""
    if not has_kernels(left):
        return left @ right
    return torch.from_numpy(np.matmul(left.numpy(), right.numpy()))


class EliminatedSystem:
    """The system of φ and start states, from what is left in φ."""

    # ``left`` is GramAccumulator's matrix (``gram``) or QRAccumulator's factor. The ridge is the
    # same for all start states.

    def __init__(
        self,
        left: Float[Tensor, "k P"],
        states: StartStates,
        ridge: Float[Tensor, " all"],
        *,
        gram: bool,
        truncation: float,
    ) -> None:
        self._left, self._states, self._gram = left, states, gram
        P = left.shape[1]
        self._ridge, self._own = ridge[:P], float(ridge[P])
        self._A = states.A.flatten(0, 1)
        self._truncation = truncation
        self._latest: tuple[float, SVDSystem | Tensor] | None = None
        whole = (left if gram else left.mT @ left) + self._A.mT @ self._A + self._ridge.diag()
        self._whole, self.rank = whole, P + states.s.numel()
        # JᵀJ's largest eigenvalue is at most that of φ's block plus that of the states'.
        self._largest = float(states.s.square().max()) + self._own
        self.size = max(float(torch.linalg.matrix_norm(whole)), self._largest)

    @property
    def scale(self) -> float:
        """Largest eigenvalue of JᵀJ, or at least half of it; NaN if an entry is not finite."""
        finite = math.isfinite(self.size)
        return max(largest_eigenvalue(self._whole), self._largest) if finite else float("nan")

    def solve(self, gradient: Float[Tensor, " all"], damping: float) -> Float[Tensor, " all"]:
        """-(JᵀJ + λI)⁻¹ gradient."""
        place, s, Vh, A, _ = self._states
        P = self._left.shape[1]
        own = (Vh @ gradient[place].unsqueeze(-1)).squeeze(-1)
        damped = s.square() + self._own + damping
        shared = gradient[:P] - (A.mT @ (s / damped * own).unsqueeze(-1)).sum(0).squeeze(-1)
        step = self._shared_step(shared, damping)
        moved = (own + s * (A @ step)) / damped
        found = torch.zeros_like(gradient)
        found[:P] = step
        found[place] = -(Vh.mT @ moved.unsqueeze(-1)).squeeze(-1)
        return found

    def _shared_step(self, gradient: Float[Tensor, " P"], damping: float) -> Float[Tensor, " P"]:
        """That of φ."""
        if self._latest is None or self._latest[0] != damping:
            self._latest = damping, self._decomposed(damping)
        found = self._latest[1]
        if isinstance(found, SVDSystem):
            return found.solve(gradient, damping)
        return -torch.cholesky_solve(gradient.unsqueeze(-1), found).squeeze(-1)

    def _decomposed(self, damping: float) -> SVDSystem | Tensor:
        """A decomposition of what is left for φ at that damping."""
        squares, extra = self._states.s.square().flatten(), self._own + damping
        rest = (extra / (squares + extra)).sqrt().unsqueeze(1) * self._A
        if not self._gram:
            R = torch.cat([self._left, rest, self._ridge.sqrt().diag()])
            return SVDSystem(torch.linalg.qr(R, mode="r").R, self._truncation)
        G = self._left + rest.mT @ rest
        G.diagonal().add_(self._ridge + damping)
        L, failed = torch.linalg.cholesky_ex(G)
        return torch.full_like(L, torch.nan) if failed else L
