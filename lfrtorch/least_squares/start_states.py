"""Elimination of start states that are parameters, each from the rows of its own record.

In θ = (φ, x0 of record 1, x0 of record 2, ...) each record depends on φ and its own start state.
So JᵀJ + λI couples every start state with φ alone, and every x0 follows from φ. A system in φ is
left, whose size does not grow with the number of records; the time to solve for all of θ would grow
with the cube of that number.

Let A and B be the columns of φ and of x0 in the rows of a record, and B = U s Vᵀ. At λ = 0 the
rows for φ are A - U (Uᵀ A) after the elimination. A damping λ keeps the start states from following
φ completely, so the part λ / (s² + λ) of each row of Uᵀ A remains.

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
    """Equations of the start states of records, in the coordinates Vᵀ x0."""

    # With B = U s Vᵀ, the fields A and r are Uᵀ A and Uᵀ r; ``place`` has the places of each start
    # state in θ.

    place: Int[Tensor, "R nx"]
    s: Float[Tensor, "R nx"]
    Vh: Float[Tensor, "R nx nx"]
    A: Float[Tensor, "R nx P"]
    r: Float[Tensor, "R nx"]


class Eliminator:
    """Adds the rows [A r] that are left after the elimination to an accumulator."""

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
        """Add rows [A B r] of some records at some samples, one record after another."""
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
        """The equations of the start states of all records."""
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
        # The columns of B become zero, so they may stay among the others.
        part = type(self._total)()
        if isinstance(part, GramAccumulator):  # a difference of products loses no further digits
            part.fold(rows.flatten(0, 1))
            part.add(-product(seen.flatten(0, 1).mT, seen.flatten(0, 1)))
        else:
            part.fold((rows - _products(U, seen)).flatten(0, 1))
        place = torch.arange(columns, device=rows.device)
        kept = torch.cat([place[: columns - nx - 1], place[-1:]])
        self._total.add_columns(part, kept)
        self._found.append((s, Vh, seen[..., : columns - nx - 1], seen[..., -1]))


def _products(left: Float[Tensor, "R m k"], right: Float[Tensor, "R k n"]) -> Tensor:
    """Products of small matrices, on the CPU by numpy, which is three times faster for many."""
    if not has_kernels(left):
        return left @ right
    return torch.from_numpy(np.matmul(left.numpy(), right.numpy()))


class EliminatedSystem:
    """The system of φ and start states, from the system in φ that the elimination leaves."""

    # ``left`` is the matrix of a GramAccumulator (``gram``), or the factor of a QRAccumulator. The
    # ridge is the same for all start states.

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
        # The largest eigenvalue of JᵀJ is at most that of φ's block plus that of the states' block.
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
        """The part of the step in φ."""
        if self._latest is None or self._latest[0] != damping:
            self._latest = damping, self._decomposed(damping)
        found = self._latest[1]
        if isinstance(found, SVDSystem):
            return found.solve(gradient, damping)
        return -torch.cholesky_solve(gradient.unsqueeze(-1), found).squeeze(-1)

    def _decomposed(self, damping: float) -> SVDSystem | Tensor:
        """A decomposition of the system in φ at that damping."""
        squares, extra = self._states.s.square().flatten(), self._own + damping
        rest = (extra / (squares + extra)).sqrt().unsqueeze(1) * self._A
        if not self._gram:
            R = torch.cat([self._left, rest, self._ridge.sqrt().diag()])
            return SVDSystem(torch.linalg.qr(R, mode="r").R, self._truncation)
        G = self._left + rest.mT @ rest
        G.diagonal().add_(self._ridge + damping)
        L, failed = torch.linalg.cholesky_ex(G)
        return torch.full_like(L, torch.nan) if failed else L
