"""Fit of a linear model to spectral lines: the frequency-domain side of the linear fits.

Lines Y = G(z) U are all that a linear model is asked for: a frequency response (U = I, weighted by
its variance), or periodic records, whose mean squared simulation error is the sum over their lines.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg
import torch
from numpy.typing import NDArray
from torch import Tensor

from lfrtorch.factors import Orthogonal
from lfrtorch.frequency_response import resolvents, slopes
from lfrtorch.gauge import Reduction, reduction
from lfrtorch.linear_model import linear_cell
from lfrtorch.linear_search import TRUNCATION, Matrices, Refined, search
from lfrtorch.records import Record
from lfrtorch.subspace import LARGEST_POLE, Start, from_spectra

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

SILENT = 1e-10
"""Relative amplitude below which a line of the input is not excited."""


@dataclass(frozen=True, eq=False)
class Lines:
    """What is fitted: Y = G(z) U, and the weight of each error.

    Args:
        z: points on the unit circle.
        U, Y: spectra, scaled so that the sum of squared errors is their mean square.
        weight: of the errors Y - G U, where they do not count alike.

    Shape:
        z: (F,), U: (F, nu, m), Y: (F, ny, m), weight: (F, ny, m).
    """

    z: Complex
    U: Complex
    Y: Complex
    weight: Array | None = None

    def weighted(self, errors: Complex) -> Complex:
        """√weight times errors (F, ny, m), or rows (F, ny, m, K) of them."""
        if self.weight is None:
            return errors
        root = np.sqrt(self.weight)
        return errors * root.reshape(*root.shape, *[1] * (errors.ndim - 3))

    @property
    def equations(self) -> int:
        """Real equations: two a line, one at 0 and fs / 2, for each output and excited column."""
        real = np.abs(self.z.imag) < 1e-12
        excited = (np.abs(self.U) ** 2).sum(axis=1) > 0
        return int(self.Y.shape[1] * (excited.sum(1) * np.where(real, 1, 2)).sum())


def lines_of(
    us: Sequence[Array], ys: Sequence[Array], records: Sequence[Record], *, offset: bool
) -> Lines | None:
    """The lines of periodic records, or None where their simulation error is no sum over lines.

    As many columns as inputs carry all that matters of any number of records: what is left of the
    outputs no linear model changes.

    Args:
        us, ys: normalised signals of each record.
        records: how they are weighted.
        offset: whether a constant in the output is free, which takes it out of line 0.

    Shape:
        us: of (T, nu), ys: of (T, ny).
    """
    ny = ys[0].shape[1]
    if any(r.start != "periodic" or r.skip for r in records):
        return None
    if ny > 1 and any(np.ptp(r.weight) > 0 or r.line_weight is not None for r in records):
        return None
    groups: dict[int, list[tuple[Complex, Complex]]] = {}
    means: list[tuple[Complex, Complex, float]] = []
    total = sum(map(len, us))
    for u, y, record in zip(us, ys, records, strict=True):
        N = record.period or len(u)
        U, Y = (np.fft.rfft(s.reshape(-1, N, s.shape[1]).mean(0), axis=0) / N for s in (u, y))
        twice = np.full((len(U), 1), 2.0)
        twice[0] = 1.0
        if N % 2 == 0:
            twice[-1] = 1.0
        weight = np.max(record.weight) * twice * len(u) / total
        if record.line_weight is not None:
            weight = weight * record.line_weight[:: len(u) // N]
        root = np.sqrt(weight)
        means.append((root[0] * U[0], root[0] * Y[0], float(root[0, 0])))
        groups.setdefault(N, []).append((root[1:] * U[1:], root[1:] * Y[1:]))
    parts = [_line_0(means, offset=offset)]
    for N, group in groups.items():
        U, Y = (np.stack([pair[side] for pair in group], axis=-1) for side in (0, 1))
        z = np.exp(2j * np.pi * np.arange(1, len(U) + 1) / N)
        parts.append((z, *_compressed(U, Y)))
    m = max(U.shape[2] for _, U, _ in parts)

    def together(which: int) -> Complex:
        wide = [np.pad(p[which], ((0, 0), (0, 0), (0, m - p[which].shape[2]))) for p in parts]
        return np.concatenate(wide)

    z, U, Y = np.concatenate([z for z, _, _ in parts]), together(1), together(2)
    size = np.abs(U).max(axis=(1, 2))
    excited = size > SILENT * size.max(initial=0.0)
    return Lines(z[excited], U[excited], Y[excited])


def _line_0(
    means: list[tuple[Complex, Complex, float]], *, offset: bool
) -> tuple[Complex, Complex, Complex]:
    """Line 0 of all records, less what a constant common to them makes."""
    U, Y = (np.stack([mean[side] for mean in means], axis=-1) for side in (0, 1))
    if offset:
        one = np.array([weight for _, _, weight in means])
        one /= max(float(np.linalg.norm(one)), np.finfo(float).tiny)
        U, Y = (S - np.outer(S @ one, one) for S in (U, Y))
    return np.ones(1, dtype=complex), *_compressed(U[None], Y[None])


def _compressed(U: Complex, Y: Complex) -> tuple[Complex, Complex]:
    """As many columns as inputs with the same normal equations, where there are more."""
    nu = U.shape[1]
    if U.shape[2] <= nu:
        return U, Y
    stacked = np.concatenate([U, Y], axis=1).swapaxes(1, 2).conj()
    R = np.asarray(np.linalg.qr(stacked, mode="r"))[:, :nu].conj().swapaxes(1, 2)
    return R[:, :nu], R[:, nu:]


class ResponseFit:
    """Linear fits to lines.

    Args:
        lines: what is fitted.
        known: whether the weights are the inverse variances of the lines.
    """

    def __init__(self, lines: Lines, *, known: bool) -> None:
        self.lines, self.known = lines, known

    def starts(self, nx: int) -> list[Start]:
        """Subspace estimates of A and C."""
        root = np.ones(len(self.lines.z))
        if self.lines.weight is not None:
            root = np.sqrt(self.lines.weight.mean(axis=(1, 2)))
        root = root[:, None, None]
        return from_spectra(self.lines.z, root * self.lines.U, root * self.lines.Y, nx)

    def with_input_matrices(self, A: Array, C: Array) -> tuple[float, Matrices]:
        """Cost and system with the best B and D for A and C: G is linear in them."""
        nx, nu, ny = len(A), self.lines.U.shape[1], len(C)
        matrices = A, np.zeros((nx, nu)), C, np.zeros((ny, nu))
        X, L = resolvents(*matrices[:3], self.lines.z)
        of_B = nx * nx + np.arange(nx * nu)
        of_D = nx * (nx + nu + ny) + np.arange(ny * nu)
        columns = np.concatenate([of_B, of_D])
        J = _real(self.lines.weighted(slopes(X, L, self.lines.U, columns))).numpy()
        r = _real(self.lines.weighted(self.lines.Y)).numpy()
        if not np.isfinite(J).all():
            return np.inf, matrices
        size = np.maximum(np.linalg.norm(J, axis=0), 1e-300)
        best = scipy.linalg.lstsq(J / size, r, check_finite=False)[0] / size
        matrices = A, best[: nx * nu].reshape(nx, nu), C, best[nx * nu :].reshape(ny, nu)
        return float(np.sum((r - J @ best) ** 2)), matrices

    def state_deviation(self, matrices: Matrices) -> Array:
        """Standard deviation (nx,) of the states over the lines."""
        X, _ = resolvents(*matrices[:3], self.lines.z)
        return np.sqrt((np.abs(X @ self.lines.U) ** 2).sum(axis=(0, 2)))

    def refined(self, matrices: Matrices, max_iter: int) -> Refined:
        """Levenberg-Marquardt on A, B, C, D, with the covariance at its end."""
        problem = ResponseError(self.lines, len(matrices[0]), LARGEST_POLE)
        theta = torch.as_tensor(np.concatenate([m.ravel() for m in matrices]))
        state = search(problem, theta, max_iter)
        jacobian = problem.linearise(state.theta)
        return Refined(
            *problem.matrices(state.theta),
            covariance=jacobian.covariance(known=self.known),
            rmse=math.sqrt(state.cost / self.lines.Y.size),
            iterations=state.iteration,
            reason=state.reason,
        )


class ResponseError:
    """Residual and slope of a linear model over lines, undefined where a pole passes a limit.

    θ holds A, B, C and D, each by rows, one after another.

    Args:
        lines: what is fitted.
        nx: order.
        largest_pole: radius that no pole may reach; none where left out.
    """

    def __init__(self, lines: Lines, nx: int, largest_pole: float = np.inf) -> None:
        self.lines, self.largest_pole = lines, largest_pole
        nu, ny = lines.U.shape[1], lines.Y.shape[1]
        self.shapes = (nx, nx), (nx, nu), (ny, nx), (ny, nu)
        self._latest: tuple[Tensor, Complex, Complex] | None = None
        self._reduced: Reduction | None = None

    def matrices(self, theta: Tensor) -> list[Array]:
        """A, B, C, D of θ (P,)."""
        parts = theta.numpy()
        ends = np.cumsum([rows * columns for rows, columns in self.shapes])
        return [p.reshape(s) for p, s in zip(np.split(parts, ends[:-1]), self.shapes, strict=True)]

    def residual(self, theta: Tensor) -> Tensor:
        """Weighted G U - Y, real parts then imaginary parts, (2 F ny m,)."""
        A, _, C, D = self.matrices(theta)
        if not np.abs(np.linalg.eigvals(A)).max() < self.largest_pole:
            return torch.full((2 * self.lines.Y.size,), torch.inf, dtype=torch.float64)
        X, _ = self._resolvents(theta)
        return _real(self.lines.weighted((C @ X + D) @ self.lines.U - self.lines.Y))

    def cost(self, residual: Tensor) -> float:
        """|r|²."""
        return float(residual.square().sum())

    def linearise(self, theta: Tensor) -> LinesJacobian:
        """The slope of the residual without the columns that the coordinates of x make."""
        cell = linear_cell(*self.matrices(theta))
        start = torch.zeros(0, len(cell.A), dtype=torch.float64)
        self._reduced = reduction(cell, start, before=self._reduced)
        X, L = self._resolvents(theta)
        J = slopes(X, L, self.lines.U, self._reduced.kept.numpy())
        return LinesJacobian(self.lines.weighted(J), self._reduced, self.residual(theta))

    def _resolvents(self, theta: Tensor) -> tuple[Complex, Complex]:
        if self._latest is None or not torch.equal(self._latest[0], theta):
            A, B, C, _ = self.matrices(theta)
            self._latest = theta.clone(), *resolvents(A, B, C, self.lines.z)
        return self._latest[1:]


class LinesJacobian:
    """Slope of the residual with θ.

    Shape:
        J: (F, ny, m, K) in the columns kept, residual: (2 F ny m,).
    """

    def __init__(self, J: Complex, reduced: Reduction, residual: Tensor) -> None:
        self._J, self._reduced, self._residual = J, reduced, residual
        self._rows = _real(J)

    def system(self, damping: float, truncation: float) -> tuple[Orthogonal, Tensor]:
        """The system and the gradient, see ``levenberg_marquardt.Jacobian``."""
        R = torch.linalg.qr(self._rows, mode="r").R
        return Orthogonal(self._reduced.columns(R), truncation), self.adjoint(self._residual)

    def tangent(self, d_theta: Tensor) -> Tensor:
        """J d_theta."""
        return self._rows @ (self._reduced.expand @ d_theta)

    def adjoint(self, residual: Tensor) -> Tensor:
        """Jᵀ residual (P,)."""
        return self._reduced.expand.mT @ (self._rows.mT @ residual)

    def covariance(self, *, known: bool) -> Array:
        """Covariance (P, P) of θ at the minimum.

        Args:
            known: whether the weights are the inverse variances of the lines. Otherwise every line
                counts with its own error (White's estimate), whatever the variances.
        """
        inverse = self.system(0.0, TRUNCATION)[0].inverse.numpy()
        if known:
            return inverse / 2  # a complex error of variance 1 has real parts of variance 1/2
        J = self._J.reshape(len(self._J), -1, self._J.shape[-1])
        r = torch.complex(*self._residual.chunk(2)).numpy().reshape(J.shape[:2])
        scores = np.einsum("fek,fe->fk", J.conj(), r).real @ self._reduced.expand.numpy()
        M, K = self._rows.shape
        return inverse @ (scores.T @ scores) @ inverse * (M / max(1, M - K))


def _real(errors: Complex) -> Tensor:
    """Real parts, then imaginary parts: (F, ny, m[, K]) -> (2 F ny m[, K])."""
    flat = errors.reshape(-1, *errors.shape[3:])
    return torch.as_tensor(np.concatenate([flat.real, flat.imag]))
