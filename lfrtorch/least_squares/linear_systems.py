"""Damped least-squares systems (JᵀJ + λI) δ = -gradient from rows of J that come in blocks.

A ``Triangle`` or a ``Gram`` matrix takes in the rows; either is the same whatever the blocks and
their order, which is how blocks of time, threads and processes share the work. The systems
``Orthogonal`` and ``Normal`` are solved with them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import torch
from torch import Tensor

from lfrtorch._threads import spread
from lfrtorch.distributed import Ranks

MERGED = 16
"""Triangles that wait before they are made one."""

PIECES, TALL = 16, 8
"""Most pieces that rows are cut into for the threads, and least rows a column in each: the merge of
their triangles then takes at most an eighth of the work."""


class System(Protocol):
    """JᵀJ decomposed, for several dampings."""

    @property
    def scale(self) -> float:
        """Largest eigenvalue of JᵀJ; NaN where an entry is not finite."""
        ...

    @property
    def rank(self) -> int:
        """Directions that J sees."""
        ...

    def solve(self, gradient: Tensor, damping: float) -> Tensor:
        """-(JᵀJ + λI)⁻¹ gradient (P,)."""
        ...


class Orthogonal:
    """From R (K, P) with RᵀR = JᵀJ, by singular values: exact for any damping.

    Args:
        R: the factor.
        truncation: singular values below this part of the largest are left out.
    """

    def __init__(self, R: Tensor, truncation: float) -> None:
        self.scale, self.rank = float("nan"), 0
        if torch.isfinite(R).all():
            _, s, Vh = torch.linalg.svd(R, full_matrices=False)
            kept = s > truncation * s[0]
            # A parameter that R does not see stays as it is, to the last bit.
            self._squares, self._Vh = s[kept].square(), Vh[kept].masked_fill((R == 0).all(0), 0.0)
            self.scale, self.rank = float(s[0].square()), len(self._squares)

    def solve(self, gradient: Tensor, damping: float) -> Tensor:
        """-(JᵀJ + λI)⁻¹ gradient (P,), its part along the directions that are left out 0."""
        return -self._Vh.mT @ ((self._Vh @ gradient) / (self._squares + damping))

    @property
    def inverse(self) -> Tensor:
        """Pseudo-inverse (P, P) of JᵀJ."""
        return (self._Vh.mT / self._squares) @ self._Vh


class Normal:
    """From G = JᵀJ (P, P), by Cholesky: three times faster, for λ well above G's rounding error.

    Args:
        G: the matrix.
        rank: its rank, as far as it is known.
    """

    def __init__(self, G: Tensor, rank: int) -> None:
        finite = bool(torch.isfinite(G).all())
        self._G, self.rank = G, rank
        self._latest: tuple[float, Tensor] | None = None  # damping and Cholesky factor
        self.scale = float(torch.linalg.eigvalsh(G)[-1]) if finite else float("nan")

    def solve(self, gradient: Tensor, damping: float) -> Tensor:
        """-(JᵀJ + λI)⁻¹ gradient (P,); NaN where rounding errors make that no minimum."""
        if self._latest is None or self._latest[0] != damping:
            damped = self._G.clone()
            damped.diagonal().add_(damping)
            L, failed = torch.linalg.cholesky_ex(damped)
            self._latest = damping, torch.full_like(L, torch.nan) if failed else L
        return -torch.cholesky_solve(gradient.unsqueeze(-1), self._latest[1]).squeeze(-1)


class Agreed:
    """A system that all processes solve alike, by the first one's solution.

    Each process could solve its own, were it not for rounding errors: they differ between kinds of
    processors, and a search multiplies them.
    """

    def __init__(self, system: System, ranks: Ranks) -> None:
        self._system, self._ranks = system, ranks
        self.scale = float(ranks.first(torch.tensor(system.scale, dtype=torch.float64)))
        self.rank = int(ranks.first(torch.tensor(system.rank)))

    def solve(self, gradient: Tensor, damping: float) -> Tensor:
        """-(JᵀJ + λI)⁻¹ gradient (P,)."""
        return self._ranks.first(self._system.solve(gradient, damping))


class Triangle:
    """R factor of the rows (M, n) seen so far, by orthogonal transformations."""

    def __init__(self) -> None:
        self._parts: list[Tensor] = []

    def fold(self, rows: Tensor) -> None:
        """Add rows (m, n)."""
        self._parts += _of_pieces(_triangularise, rows)
        if sum(map(len, self._parts)) > MERGED * rows.shape[1]:
            self._parts = [self.R]

    def absorb(self, other: Any, place: Tensor, width: int, mix: Tensor | None = None) -> None:
        """Add the rows of another: its columns, first mixed by (m, n), are those at ``place`` (n,)
        among so many.
        """
        R = other.R if mix is None else other.R @ mix
        wide = R.new_zeros(len(R), width)
        wide[:, place] = R
        self.fold(wide)

    def combine(self, ranks: Ranks) -> None:
        """Take in the rows of all processes."""
        self._parts = [torch.linalg.qr(ranks.stack(self.R), mode="r").R]

    @property
    def R(self) -> Tensor:
        """R (min(M, n), n) with RᵀR = AᵀA, up to the signs of its rows."""
        if len(self._parts) == 1:
            return self._parts[0]
        return torch.linalg.qr(torch.cat(self._parts), mode="r").R


class Gram:
    """AᵀA (n, n) of the rows (M, n) seen so far: three times faster, and half the digits."""

    def __init__(self) -> None:
        self._parts: list[Tensor] = []

    def fold(self, rows: Tensor) -> None:
        """Add rows (m, n)."""
        self.add(*_of_pieces(_square, rows))

    def absorb(self, other: Any, place: Tensor, width: int, mix: Tensor | None = None) -> None:
        """Add the rows of another: its columns, first mixed by (m, n), are those at ``place`` (n,)
        among so many.
        """
        if not self._parts:
            self._parts = [other.G.new_zeros(width, width)]
        G = other.G if mix is None else mix.mT @ other.G @ mix
        self._parts[0][place.unsqueeze(1), place] += G

    def combine(self, ranks: Ranks) -> None:
        """Take in the rows of all processes."""
        self._parts = [ranks.sum(self.G)]

    @property
    def G(self) -> Tensor:
        """The matrix."""
        return self._parts[0]

    def add(self, *parts: Tensor) -> None:
        """Add squares (n, n) of rows."""
        self._parts = [torch.stack([*self._parts, *parts]).sum(0)]


def _of_pieces(
    kernel: Callable[[int, Sequence[Tensor], list[Tensor]], None], rows: Tensor
) -> list[Tensor]:
    """What the kernel makes of the rows, in pieces that the threads share.

    The pieces do not depend on the number of threads, and so neither do the digits of their sum.
    """
    most = PIECES if rows.device.type == "cpu" else 1
    pieces = rows.tensor_split(max(1, min(most, len(rows) // (TALL * rows.shape[1]))))
    parts: list[Tensor] = [rows[:0]] * len(pieces)
    spread(kernel, len(pieces), pieces, parts)
    return parts


def _triangularise(job: int, pieces: Sequence[Tensor], parts: list[Tensor]) -> None:
    parts[job] = torch.linalg.qr(pieces[job], mode="r").R


def _square(job: int, pieces: Sequence[Tensor], parts: list[Tensor]) -> None:
    parts[job] = pieces[job].mT @ pieces[job]
