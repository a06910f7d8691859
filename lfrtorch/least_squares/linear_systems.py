"""Damped least-squares systems (JᵀJ + λI) δ = -gradient from rows of J that come in blocks.

J is long and narrow. An accumulator adds its rows, block by block, to a square matrix: R with
RᵀR = JᵀJ (``QRAccumulator``, all digits), or JᵀJ itself (``GramAccumulator``, three times faster,
half the digits). Up to rounding neither matrix depends on the blocks or their order, so blocks of
time, threads and processes can share the work. A system then solves for the step δ at any damping
λ: ``SVDSystem`` uses R, ``CholeskySystem`` and ``ReducedSystem`` use JᵀJ.
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
"""Triangles are merged when together they have this many times the rows of one triangle."""

PIECES = 16
"""Largest number of pieces that the rows are cut into for the threads."""

TALL = 8
"""Smallest ratio of height to width of a piece: merging the triangles then takes at most an eighth
of the work."""

WIDE = 256
"""Number of columns above which JᵀJ of few rows is computed in panels that the threads share."""

PANELS = 16
"""Number of these panels."""

KRYLOV = 400
"""Number of parameters from which the largest eigenvalue is computed without the others."""


@runtime_checkable
class System(Protocol):
    """A decomposition of JᵀJ that solves for steps at several dampings."""

    @property
    def scale(self) -> float:
        """Largest eigenvalue of JᵀJ; NaN if an entry is not finite."""
        ...

    size: float
    """An upper bound on ``scale``, at most √P times as large, that costs nothing."""

    rank: int
    """Number of directions of θ that change the residual."""

    def solve(self, gradient: Float[Tensor, " P"], damping: float) -> Float[Tensor, " P"]:
        """-(JᵀJ + λI)⁻¹ gradient."""
        ...


class SVDSystem:
    """System from R with RᵀR = JᵀJ, by singular values: exact for any damping."""

    def __init__(self, R: Float[Tensor, "K P"], truncation: float) -> None:
        self.scale = self.size = float("nan")
        self.rank = 0
        if torch.isfinite(R).all():
            s, Vh = _singular(R)
            kept = s > truncation * s[:1]  # s is empty if there are no rows
            # A parameter whose column in R is zero does not change, to the last bit.
            self._squares, self._Vh = s[kept].square(), Vh[kept].masked_fill((R == 0).all(0), 0.0)
            self.scale = self.size = float(s[:1].square().sum())
            self.rank = len(self._squares)

    def solve(self, gradient: Float[Tensor, " P"], damping: float) -> Float[Tensor, " P"]:
        """-(JᵀJ + λI)⁻¹ gradient, without the part along truncated directions."""
        return -self._Vh.mT @ ((self._Vh @ gradient) / (self._squares + damping))

    @property
    def inverse(self) -> Float[Tensor, "P P"]:
        """Pseudo-inverse of JᵀJ."""
        return (self._Vh.mT / self._squares) @ self._Vh


def _singular(R: Float[Tensor, "K P"]) -> tuple[Tensor, Tensor]:
    """Singular values and right singular vectors, also if the fast method fails."""
    try:
        _, s, Vh = torch.linalg.svd(R, full_matrices=False)
    except RuntimeError:  # divide and conquer has failed; QR sweeps always converge
        _, s, Vh = scipy.linalg.svd(to_float64(R), full_matrices=False, lapack_driver="gesvd")
    return torch.as_tensor(s).to(R), torch.as_tensor(Vh).to(R)


class CholeskySystem:
    """System from G = JᵀJ, by Cholesky: three times faster, for λ well above G's rounding."""

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
    """System from G, JᵀJ in K kept columns, where all P columns are J = J[:, kept] E."""

    # With E Eᵀ = L Lᵀ the rows of L⁻¹ E are orthonormal, and span all directions that change the
    # residual. In these coordinates JᵀJ is Lᵀ G L, so no P × P matrix is formed. The ridge is added
    # to every eigenvalue of JᵀJ, including the zero eigenvalues of the other directions.

    def __init__(self, G: Float[Tensor, "K K"], expand: Float[Tensor, "K P"], ridge: float) -> None:
        self._expand, self._ridge, self.rank = expand, ridge, len(G)
        # The condition number of E Eᵀ is that of E squared: too large for single precision.
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
        """A vector in the reduced coordinates, transformed to those of θ."""
        kept = torch.linalg.solve_triangular(self._L.mT, own, upper=True)
        return self._expand.mT @ kept.squeeze(-1)


def largest_eigenvalue(G: Float[Tensor, "P P"]) -> float:
    """Largest eigenvalue of a symmetric matrix; a large matrix takes about thirty products."""
    if len(G) < KRYLOV or not has_kernels(G):
        return float(torch.linalg.eigvalsh(G)[-1])
    start = np.ones(len(G), G.numpy().dtype)  # ARPACK's default start is random
    try:
        return float(eigsh(G.numpy(), k=1, which="LA", v0=start, return_eigenvectors=False)[0])
    except ArpackError:  # ARPACK did not converge, or G is zero
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
        """Add the rows of another accumulator as columns ``place`` of ``width``; see ``tied``."""
        R = other.R if tie is None else tied(other.R, tie)
        wide = R.new_zeros(len(R), width)
        wide[:, place] = R
        self.fold(wide)

    def add_columns(self, other: Any, kept: Int[Tensor, " n"]) -> None:
        """Add the rows of another accumulator, in the columns ``kept`` alone."""
        self.fold(other.R[:, kept])

    def replace(self, R: Float[Tensor, "k n"]) -> None:
        """Replace the matrix."""
        self._parts = [R]

    @property
    def R(self) -> Float[Tensor, "k n"]:
        """R with k = n rows, or fewer if A has fewer rows; the signs of its rows are arbitrary."""
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
        """Add the rows of another accumulator as columns ``place`` of ``width``; see ``tied``."""
        if not self._parts:
            self._parts = [other.G.new_zeros(width, width)]
        G = other.G if tie is None else tied(tied(other.G, tie).mT, tie)
        self._parts[0][place.unsqueeze(1), place] += G

    def add_columns(self, other: Any, kept: Int[Tensor, " n"]) -> None:
        """Add the rows of another accumulator, in the columns ``kept`` alone."""
        self.add(other.G[kept.unsqueeze(1), kept])

    def replace(self, G: Float[Tensor, "n n"]) -> None:
        """Replace the matrix."""
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
    """Rows of n + 1 columns, from n + m + 1 of which m, before the last, depend on the first n."""
    m, n = tie.shape
    return torch.cat([rows[:, :n] + rows[:, n : n + m] @ tie, rows[:, -1:]], dim=1)


def _of_pieces(
    kernel: Callable[[int, Sequence[Tensor], list[Tensor]], None], rows: Tensor
) -> list[Tensor]:
    """The kernel's results for pieces of the rows, which the threads share."""
    # The pieces, and so the digits of their sum, do not depend on the number of threads.
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
    """Add a wide and a narrow panel of rowsᵀ rows to G, so that all jobs take equally long."""
    for panel in (job, PANELS - 1 - job):
        first, last = edges[panel], edges[panel + 1]
        own = rows[:, first:last]
        beside = own.T @ rows[:, :first]
        G[first:last, first:last] += own.T @ own
        G[first:last, :first] += beside
        G[:first, first:last] += beside.T


def product(left: Float[Tensor, "m k"], right: Float[Tensor, "k n"]) -> Float[Tensor, "m n"]:
    """left @ right; on the CPU by numpy, which is faster if k is large or the factors are equal."""
    if not has_kernels(left):
        return left @ right
    with np.errstate(over="ignore", invalid="ignore"):  # the scale of such a system is NaN
        return torch.from_numpy(left.numpy() @ right.numpy())
