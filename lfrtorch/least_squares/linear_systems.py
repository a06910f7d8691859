"""Damped least-squares systems (JᵀJ + λI) δ = -gradient from rows of J that come in blocks.

J is long and narrow. An accumulator takes in its rows, block by block, and holds a square matrix:
R with RᵀR = JᵀJ (``QRAccumulator``, all digits) or JᵀJ itself (``GramAccumulator``, three times
faster, half the digits). Either is the same whatever the blocks and their order, which is how
blocks of time, threads and processes share the work. A system then solves for the step δ at any
damping λ: ``SVDSystem`` from R, ``CholeskySystem`` and ``ReducedSystem`` from JᵀJ.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
import scipy
import torch
from jaxtyping import Float, Int
from scipy.sparse.linalg import ArpackError, eigsh
from torch import Tensor

from lfrtorch._support.threads import has_kernels, spread, to_float64
from lfrtorch._support.types import Array

MERGED = 16
"""Triangles are merged into one when they have this many times the rows of one."""

PIECES = 16
"""Most pieces of the rows for the threads."""

TALL = 8
"""Least ratio of height to width of a piece: the merge of the triangles then takes at most an
eighth of the work."""

WIDE = 256
"""Columns above which JᵀJ of few rows is found in panels that the threads share."""

PANELS = 16
"""Number of these panels."""

KRYLOV = 400
"""Parameters from which the largest eigenvalue is found without the others."""


@runtime_checkable
class System(Protocol):
    """JᵀJ decomposed, for several dampings."""

    @property
    def scale(self) -> float:
        """Largest eigenvalue of JᵀJ; NaN if an entry is not finite."""
        ...

    size: float
    """The same or more, by a factor of √P at most, at no cost."""

    rank: int
    """Directions that J sees."""

    def solve(self, gradient: Float[Tensor, " P"], damping: float) -> Float[Tensor, " P"]:
        """-(JᵀJ + λI)⁻¹ gradient."""
        ...


class SVDSystem:
    """From R with RᵀR = JᵀJ, by singular values: exact for any damping."""

    def __init__(self, R: Float[Tensor, "K P"], truncation: float) -> None:
        self.scale = self.size = float("nan")
        self.rank = 0
        if torch.isfinite(R).all():
            s, Vh = _singular(R)
            kept = s > truncation * s[:1]  # of no rows there is none
            # A parameter that R does not see stays as it is, to the last bit.
            self._squares, self._Vh = s[kept].square(), Vh[kept].masked_fill((R == 0).all(0), 0.0)
            self.scale = self.size = float(s[:1].square().sum())
            self.rank = len(self._squares)

    def solve(self, gradient: Float[Tensor, " P"], damping: float) -> Float[Tensor, " P"]:
        """-(JᵀJ + λI)⁻¹ gradient, without its part along the directions that are left out."""
        return -self._Vh.mT @ ((self._Vh @ gradient) / (self._squares + damping))

    @property
    def inverse(self) -> Float[Tensor, "P P"]:
        """Pseudo-inverse of JᵀJ."""
        return (self._Vh.mT / self._squares) @ self._Vh


def _singular(R: Float[Tensor, "K P"]) -> tuple[Tensor, Tensor]:
    """Singular values and right singular vectors, also of a matrix on which the fast way ends."""
    try:
        _, s, Vh = torch.linalg.svd(R, full_matrices=False)
    except RuntimeError:  # divide and conquer; the sweeps of QR always converge
        _, s, Vh = scipy.linalg.svd(to_float64(R), full_matrices=False, lapack_driver="gesvd")
    return torch.as_tensor(s).to(R), torch.as_tensor(Vh).to(R)


class CholeskySystem:
    """From G = JᵀJ, by Cholesky: three times faster, for λ well above the rounding errors of G."""

    def __init__(self, G: Float[Tensor, "P P"], rank: int) -> None:
        self._G, self.rank = G, rank
        self._latest: tuple[float, Tensor] | None = None  # damping and Cholesky factor
        self.size = float(torch.linalg.matrix_norm(G))

    @property
    def scale(self) -> float:
        """Largest eigenvalue of JᵀJ; NaN if an entry is not finite."""
        return largest_eigenvalue(self._G) if math.isfinite(self.size) else float("nan")

    def solve(self, gradient: Float[Tensor, " P"], damping: float) -> Float[Tensor, " P"]:
        """-(JᵀJ + λI)⁻¹ gradient; NaN if rounding errors leave no positive definite matrix."""
        if self._latest is None or self._latest[0] != damping:
            damped = self._G.clone(memory_format=torch.contiguous_format)
            damped.diagonal().add_(damping)
            L, failed = torch.linalg.cholesky_ex(damped)
            self._latest = damping, L.fill_(torch.nan) if failed else L
        return torch.cholesky_solve(gradient.unsqueeze(-1), self._latest[1]).squeeze(-1).neg_()


class ReducedSystem:
    """From G = JᵀJ in K columns of which all P are combinations, J = J[:, kept] E."""

    # With E Eᵀ = L Lᵀ the rows of L⁻¹ E are orthonormal, and span all that J sees. In their
    # coordinates JᵀJ is Lᵀ G L, so nothing of size P × P is formed. The ridge is added to each
    # eigenvalue of JᵀJ, those of other directions included.

    def __init__(self, G: Float[Tensor, "K K"], expand: Float[Tensor, "K P"], ridge: float) -> None:
        self._expand, self._ridge, self.rank = expand, ridge, len(G)
        # E Eᵀ is as badly conditioned as E squared: too much for single precision.
        wide = expand.double()
        self._L = torch.linalg.cholesky(wide @ wide.mT).to(expand)
        own = self._L.mT @ G @ self._L
        own.diagonal().add_(ridge)
        self._own = CholeskySystem(own, self.rank)
        self.size = self._own.size

    @property
    def scale(self) -> float:
        """Largest eigenvalue of JᵀJ."""
        return self._own.scale

    def solve(self, gradient: Float[Tensor, " P"], damping: float) -> Float[Tensor, " P"]:
        """-(JᵀJ + (ridge + λ) I)⁻¹ gradient."""
        own = torch.linalg.solve_triangular(
            self._L, (self._expand @ gradient).unsqueeze(-1), upper=False
        )
        step = self._back(self._own.solve(own.squeeze(-1), damping).unsqueeze(-1))
        if self._ridge:
            step -= (gradient - self._back(own)) / (self._ridge + damping)
        return step

    def _back(self, own: Float[Tensor, "K 1"]) -> Float[Tensor, " P"]:
        """A vector in the coordinates of θ."""
        kept = torch.linalg.solve_triangular(self._L.mT, own, upper=True)
        return self._expand.mT @ kept.squeeze(-1)


def largest_eigenvalue(G: Float[Tensor, "P P"]) -> float:
    """Largest eigenvalue of a symmetric matrix; by some thirty products (Krylov) if it is large."""
    if len(G) < KRYLOV or not has_kernels(G):
        return float(torch.linalg.eigvalsh(G)[-1])
    start = np.ones(len(G), G.numpy().dtype)  # ARPACK's own would be random
    try:
        return float(eigsh(G.numpy(), k=1, which="LA", v0=start, return_eigenvectors=False)[0])
    except ArpackError:  # it did not converge, or G is zero
        return float(torch.linalg.eigvalsh(G)[-1])


class QRAccumulator:
    """The triangular R with RᵀR = AᵀA for the rows of A so far, by orthogonal transformations."""

    def __init__(self) -> None:
        self._parts: list[Tensor] = []

    def fold(self, rows: Float[Tensor, "m n"]) -> None:
        """Add rows."""
        self._parts += _of_pieces(_triangularise, rows)
        if sum(map(len, self._parts)) > MERGED * rows.shape[1]:
            self._parts = [self.R]

    def absorb(
        self,
        other: Any,
        place: Int[Tensor, " n"],
        width: int,
        tie: Float[Tensor, "m n-1"] | None = None,
    ) -> None:
        """Add the rows of another, ``tied`` if they shall be, as columns ``place`` of ``width``."""
        R = other.R if tie is None else tied(other.R, tie)
        wide = R.new_zeros(len(R), width)
        wide[:, place] = R
        self.fold(wide)

    def add_columns(self, other: Any, kept: Int[Tensor, " n"]) -> None:
        """Add some columns of the rows of another."""
        self.fold(other.R[:, kept])

    def replace(self, R: Float[Tensor, "k n"]) -> None:
        """Take another matrix in place of its own."""
        self._parts = [R]

    @property
    def R(self) -> Float[Tensor, "k n"]:
        """R with k = n rows, or fewer if there are fewer so far; their signs are arbitrary."""
        if len(self._parts) == 1:
            return self._parts[0]
        return torch.linalg.qr(torch.cat(self._parts), mode="r").R


class GramAccumulator:
    """AᵀA for the rows of A so far: three times faster, and half the digits."""

    def __init__(self) -> None:
        self._parts: list[Tensor] = []

    def fold(self, rows: Float[Tensor, "m n"]) -> None:
        """Add rows."""
        n = rows.shape[1]
        pieces = _pieces(rows)
        if not has_kernels(rows) or n < WIDE or pieces > 1:
            self.add(*(_of_pieces(_square, rows) if pieces > 1 else [product(rows.mT, rows)]))
            return
        if not self._parts:
            self._parts = [rows.new_zeros(n, n)]
        edges = np.linspace(0, n, PANELS + 1).astype(int)
        spread(_add_panels, PANELS // 2, edges, rows.numpy(), self._parts[0].numpy())

    def absorb(
        self,
        other: Any,
        place: Int[Tensor, " n"],
        width: int,
        tie: Float[Tensor, "m n-1"] | None = None,
    ) -> None:
        """Add the rows of another, ``tied`` if they shall be, as columns ``place`` of ``width``."""
        if not self._parts:
            self._parts = [other.G.new_zeros(width, width)]
        G = other.G if tie is None else tied(tied(other.G, tie).mT, tie)
        self._parts[0][place.unsqueeze(1), place] += G

    def add_columns(self, other: Any, kept: Int[Tensor, " n"]) -> None:
        """Add some columns of the rows of another."""
        self.add(other.G[kept.unsqueeze(1), kept])

    def replace(self, G: Float[Tensor, "n n"]) -> None:
        """Take another matrix in place of its own."""
        self._parts = [G]

    @property
    def G(self) -> Float[Tensor, "n n"]:
        """The matrix."""
        return self._parts[0]

    def add(self, *parts: Float[Tensor, "n n"]) -> None:
        """Add AᵀA of more rows."""
        every = [*self._parts, *parts]
        self._parts = every if len(every) == 1 else [torch.stack(every).sum(0)]


def tied(rows: Float[Tensor, "M columns"], tie: Float[Tensor, "m n"]) -> Float[Tensor, "M n+1"]:
    """Rows of n + 1 columns from n + m + 1: m, all before the last, follow from the first n."""
    m, n = tie.shape
    return torch.cat([rows[:, :n] + rows[:, n : n + m] @ tie, rows[:, -1:]], dim=1)


def _of_pieces(
    kernel: Callable[[int, Sequence[Tensor], list[Tensor]], None], rows: Tensor
) -> list[Tensor]:
    """The kernel's results for pieces of the rows, which the threads share."""
    # The pieces do not depend on the number of threads, and so neither do the digits of their sum.
    pieces = rows.tensor_split(_pieces(rows))
    parts: list[Tensor] = [rows[:0]] * len(pieces)
    spread(kernel, len(pieces), pieces, parts)
    return parts


def _pieces(rows: Tensor) -> int:
    most = PIECES if has_kernels(rows) else 1
    return max(1, min(most, len(rows) // (TALL * rows.shape[1])))


def _triangularise(job: int, pieces: Sequence[Tensor], parts: list[Tensor]) -> None:
    parts[job] = torch.linalg.qr(pieces[job], mode="r").R


def _square(job: int, pieces: Sequence[Tensor], parts: list[Tensor]) -> None:
    parts[job] = product(pieces[job].mT, pieces[job])


def _add_panels(job: int, edges: Array, rows: Array, G: Array) -> None:
    """Add two panels of rowsᵀ rows to G: one wide and one narrow, so that all jobs are alike."""
    for panel in (job, PANELS - 1 - job):
        first, last = edges[panel], edges[panel + 1]
        own = rows[:, first:last]
        beside = own.T @ rows[:, :first]
        G[first:last, first:last] += own.T @ own
        G[first:last, :first] += beside
        G[:first, first:last] += beside.T


def product(left: Float[Tensor, "m k"], right: Float[Tensor, "k n"]) -> Float[Tensor, "m n"]:
    """left @ right, by numpy on the CPU: faster if k is large, and one triangle of a square."""
    if not has_kernels(left):
        return left @ right
    with np.errstate(over="ignore", invalid="ignore"):  # such a system has no scale
        return torch.from_numpy(left.numpy() @ right.numpy())
