"""Fit of a linear model to spectral lines Y = G(z) U: least squares in the response."""

from __future__ import annotations

import math

import numpy as np
import scipy.linalg
import torch
from torch import Tensor

from lfrtorch._types import Array, Complex
from lfrtorch.least_squares.gauge import Reduction, reduction
from lfrtorch.least_squares.linear_systems import Orthogonal
from lfrtorch.linear.model import linear_cell
from lfrtorch.linear.refinement import TRUNCATION, Matrices, Refined, Search
from lfrtorch.linear.resolvent import resolvent, resolvents, slopes
from lfrtorch.linear.spectral_data import Lines
from lfrtorch.linear.subspace import LARGEST_POLE, Start, from_spectra

MOST_STARTS, LARGE = 12, 250_000
"""Starts that are refined, up to so many errors times unknowns."""


class ResponseFit:
    """Linear fits to lines.

    Args:
        lines: what is fitted.
        known: whether the weights are the inverse variances of the lines.
        feedthrough: whether D is a parameter; it is 0 otherwise.
    """

    def __init__(self, lines: Lines, *, known: bool, feedthrough: bool = True) -> None:
        self.lines, self.known, self.feedthrough = lines, known, feedthrough

    def contenders(self, nx: int) -> int:
        """Starts that are worth a refinement: one where there are many equations and unknowns."""
        nu, ny = self.lines.U.shape[1], self.lines.Y.shape[1]
        return MOST_STARTS if self.lines.Y.size * nx * (nu + ny) < LARGE else 1

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
        columns = np.concatenate([of_B, of_D]) if self.feedthrough else of_B
        J = _real(self.lines.weighted(slopes(X, L, self.lines.U, columns))).numpy()
        r = _real(self.lines.weighted(self.lines.Y)).numpy()
        if not np.isfinite(J).all():
            return np.inf, matrices
        size = np.maximum(np.linalg.norm(J, axis=0), 1e-300)
        best = scipy.linalg.lstsq(J / size, r, check_finite=False)[0] / size
        D = best[nx * nu :].reshape(ny, nu) if self.feedthrough else matrices[3]
        matrices = A, best[: nx * nu].reshape(nx, nu), C, D
        return float(np.sum((r - J @ best) ** 2)), matrices

    def state_deviation(self, matrices: Matrices) -> Array:
        """Standard deviation (nx,) of the states over the lines."""
        X = resolvent(*matrices[:2], self.lines.z)
        return np.sqrt((np.abs(X @ self.lines.U) ** 2).sum(axis=(0, 2)))

    def search(self, matrices: Matrices) -> Search:
        """A search over A, B, C, D from the given ones."""
        problem = ResponseError(
            self.lines, len(matrices[0]), LARGEST_POLE, feedthrough=self.feedthrough
        )
        return Search(problem, torch.as_tensor(np.concatenate([m.ravel() for m in matrices])))

    def improbability(self, search: Search) -> float:
        """The cost: lines have no start states."""
        return search.state.cost

    def refined(self, search: Search) -> Refined:
        """Where a search stands, with the covariance there."""
        problem, state = search.problem, search.state
        jacobian = problem.linearise(state.theta)
        return Refined(
            *problem.matrices(state.theta),
            covariance=jacobian.covariance(known=self.known) if state.iteration else None,
            rmse=math.sqrt(state.cost / self.lines.Y.size),
            iterations=state.iteration,
            reason=search.reason,
        )


class ResponseError:
    """Residual and slope of a linear model over lines, undefined where a pole passes a limit.

    θ holds A, B, C and D, each by rows, one after another.

    Args:
        lines: what is fitted.
        nx: order.
        largest_pole: radius that no pole may reach; none where left out.
        feedthrough: whether the entries of D may change.
    """

    def __init__(
        self, lines: Lines, nx: int, largest_pole: float = np.inf, *, feedthrough: bool = True
    ) -> None:
        self.lines, self.largest_pole = lines, largest_pole
        nu, ny = lines.U.shape[1], lines.Y.shape[1]
        self.shapes = (nx, nx), (nx, nu), (ny, nx), (ny, nu)
        self._fixed: Tensor | None = None
        if not feedthrough:
            self._fixed = torch.zeros(nx * (nx + nu + ny) + ny * nu, dtype=torch.bool)
            self._fixed[nx * (nx + nu + ny) :] = True
        self._latest: tuple[Tensor, Complex] | None = None
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
        X = self._states(theta)
        return _real(self.lines.weighted((C @ X + D) @ self.lines.U - self.lines.Y))

    def cost(self, residual: Tensor) -> float:
        """|r|²."""
        return float(residual.square().sum())

    def linearise(self, theta: Tensor) -> LinesJacobian:
        """The slope of the residual without the columns that the coordinates of x make."""
        cell = linear_cell(*self.matrices(theta))
        start = torch.zeros(0, len(cell.A), dtype=torch.float64)
        self._reduced = reduction(cell, start, before=self._reduced, fixed=self._fixed)
        A, _, C, _ = self.matrices(theta)
        X, L = self._states(theta), resolvent(A.T, C.T, self.lines.z).swapaxes(1, 2)
        J = slopes(X, L, self.lines.U, self._reduced.kept.numpy())
        return LinesJacobian(self.lines.weighted(J), self._reduced, self.residual(theta))

    def _states(self, theta: Tensor) -> Complex:
        """(zI - A)⁻¹ B (F, nx, nu), that of the latest θ kept."""
        if self._latest is None or not torch.equal(self._latest[0], theta):
            A, B, _, _ = self.matrices(theta)
            self._latest = theta.clone(), resolvent(A, B, self.lines.z)
        return self._latest[1]


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
