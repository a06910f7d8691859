"""Fit of a linear model to spectra Y = G(z) U: least squares in the frequency domain.

The error at each DFT line is the measured Y minus G(z) U, where G(z) = C (zI - A)⁻¹ B + D is the
response of the model. For given A and C it is linear in B and D, which one least-squares problem
yields; that completes a subspace estimate to a model. Levenberg-Marquardt then refines all four
matrices. A step that brings a pole out of the unit circle has an infinite cost, and is rejected;
poles that the lines do not tell are limited by ``pole_limits``.
"""

from __future__ import annotations

import math
from functools import cached_property

import numpy as np
import scipy
import torch
from jaxtyping import Complex128, Float
from torch import Tensor

from lfrtorch._support.types import Array, Booleans, Complex
from lfrtorch.least_squares.gauge import Reduction, reduction
from lfrtorch.least_squares.linear_systems import SVDSystem, System
from lfrtorch.least_squares.residual import LeastSquares, Point
from lfrtorch.least_squares.search import Search
from lfrtorch.linear.modal_jacobian import ModalColumns, Modes, stacked, with_best_inputs
from lfrtorch.linear.model import linear_cell
from lfrtorch.linear.pole_limits import RHO, PoleLimits
from lfrtorch.linear.refinement import TOLERANCE, TRUNCATION, Matrices, Refined, refining
from lfrtorch.linear.resolvent import (
    frequency_response,
    response_jacobian,
    solve_left,
    solve_resolvent,
)
from lfrtorch.linear.spectral_data import SpectralData
from lfrtorch.linear.subspace import LARGEST_POLE, SubspaceEstimate, from_spectra

MANY = 40
"""Unknowns from which on the derivatives are computed by modes."""


class ResponseFit:
    """Least-squares problem between spectra and linear models of any order.

    The last ``starts`` inputs make initial states and have no D; the last ``direct`` ones act on
    the output alone. If ``known``, the weights are the inverse variances of the errors.
    """

    def __init__(
        self,
        data: SpectralData,
        *,
        known: bool,
        feedthrough: bool = True,
        starts: int = 0,
        direct: int = 0,
    ) -> None:
        self.data, self.known, self.feedthrough, self.starts = data, known, feedthrough, starts
        self._driving = data.U.shape[1] - direct

    def most_candidates(self, nx: int) -> int:
        """Return how many subspace estimates are refined: one if an iteration takes long."""
        nu, ny = self.data.U.shape[1], self.data.Y.shape[1]
        return 12 if self.data.Y.size * nx * (nu + ny) < 250_000 else 1

    def many(self, nx: int) -> bool:
        """Tell if a model of the order has so many unknowns that its modes save work."""
        nu, free = self.data.U.shape[1], int(self._free_feedthrough.sum())
        unknowns = nx * (nu + self.data.Y.shape[1]) + free
        return unknowns >= MANY and not self.starts and self._driving == nu

    def subspace_estimates(self, nx: int) -> list[SubspaceEstimate]:
        """Subspace estimates of A and C."""
        z, U, Y = self.equal_noise(self.data.Y)
        return from_spectra(z, U[:, : self._driving], Y, nx)

    def equal_noise(self, Y: Complex) -> tuple[Complex, Complex, Complex]:
        """z, U and Y (F, ny, m) with lines whose errors are of about the same size."""
        root = np.ones(len(self.data.z))
        if self.data.weight is not None:
            root = np.sqrt(self.data.weight.mean(axis=(1, 2)))
        root = root[:, None, None]
        return self.data.z, root * self.data.U, root * Y

    def errors(self, matrices: Matrices) -> Complex:
        """Y - G U, (F, ny, m)."""
        return self.data.Y - frequency_response(*matrices, self.data.z) @ self.data.U

    def with_input_matrices(self, A: Array, C: Array) -> tuple[float, Matrices]:
        """Cost and system with the best B and D for A and C: G is linear in them."""
        nx, nu, ny = len(A), self.data.U.shape[1], len(C)
        if self.many(nx):
            inputs = with_best_inputs(A, C, self.data, self._free_feedthrough)
            if inputs is not None:
                matrices = A, inputs[0], C, inputs[1]
                errors = self.data.weighted(self.errors(matrices))
                return float(np.sum(np.abs(errors) ** 2)), matrices
        matrices = A, np.zeros((nx, nu)), C, np.zeros((ny, nu))
        free_B = self._free_inputs(nx)
        of_B = nx * nx + np.flatnonzero(free_B)
        free = self._free_feedthrough
        of_D = nx * (nx + nu + ny) + np.flatnonzero(free)
        columns = np.concatenate([of_B, of_D])
        F, _, m = self.data.U.shape
        L, rest = solve_left(A, C, self.data.z), np.zeros((F, nx, m), dtype=complex)
        J = self.data.weighted(response_jacobian(rest, L, self.data.U, columns))
        J, r = (stacked(part).numpy() for part in (J, self.data.weighted(self.data.Y)))
        J = J.reshape(len(r), -1)
        if not np.isfinite(J).all():
            return np.inf, matrices
        size = np.linalg.norm(J, axis=0)
        # A state that nothing sees has a column that is 0 but for underflow: its input stays 0.
        size = np.maximum(size, max(1e-100 * size.max(), 1e-300))
        best = scipy.linalg.lstsq(J / size, r, check_finite=False)[0] / size
        _, B, _, D = matrices
        B[free_B], D[free] = np.split(best, [len(of_B)])
        return float(np.sum((r - J @ best) ** 2)), matrices

    def state_deviation(self, matrices: Matrices) -> Array:
        """Standard deviation (nx,) of the states under the inputs, the first ones, that B has."""
        A, B, _, _ = matrices
        states = solve_resolvent(A, B, self.data.z) @ self.data.U[:, : B.shape[1]]
        return np.sqrt((np.abs(states) ** 2).sum(axis=(0, 2)))

    def search(self, matrices: Matrices) -> Search:
        """Begin a search over A, B, C, D from the given ones."""
        problem = ResponseProblem(
            self.data,
            len(matrices[0]),
            LARGEST_POLE,
            free_inputs=self._free_inputs(len(matrices[0])),
            free_feedthrough=self._free_feedthrough,
            together=self.starts > 0,
            by_modes=self.many(len(matrices[0])),
            limits=None if self.starts else PoleLimits(self.data.z),
        )
        theta = torch.as_tensor(np.concatenate([m.ravel() for m in matrices]))
        return refining(problem, theta, 1e-7 if self.many(len(matrices[0])) else TOLERANCE)

    def _free_inputs(self, nx: int) -> Booleans:
        """Mask of the entries of B (nx, nu) that are parameters."""
        return np.tile(np.arange(self.data.U.shape[1]) < self._driving, (nx, 1))

    @property
    def _free_feedthrough(self) -> Booleans:
        """Mask of the entries of D (ny, nu) that are parameters."""
        nu, ny = self.data.U.shape[1], self.data.Y.shape[1]
        free = np.full((ny, nu), self.feedthrough)
        free[:, nu - self.starts :] = False
        return free

    def improbability(self, search: Search) -> float:
        """Return the cost: spectra have no initial states."""
        return search.state.cost

    def refined(self, search: Search) -> Refined:
        """Return the present result of a search, with its covariance."""
        problem, state = search.problem, search.state
        at = problem.at(state.theta)
        return Refined(
            *at.matrices,
            covariance=problem.covariance(state.theta, self.known) if state.iteration else None,
            rmse=float(np.linalg.norm(at.errors) / math.sqrt(self.data.Y.size)),
            iterations=state.iteration,
            reason=search.reason,
        )


class ResponseProblem(LeastSquares):
    """Residual and Jacobian of a linear model over spectra; infinite if a pole passes a limit.

    θ holds A, B, C and D, row by row, one matrix after another. States under all inputs
    ``together`` are less work than under each one for inputs of few columns.
    """

    def __init__(
        self,
        data: SpectralData,
        nx: int,
        largest_pole: float = np.inf,
        *,
        free_inputs: Booleans | None = None,
        free_feedthrough: Booleans | None = None,
        together: bool = False,
        by_modes: bool = False,
        limits: PoleLimits | None = None,
    ) -> None:
        self.data, self.largest_pole = data, largest_pole
        nu, ny = data.U.shape[1], data.Y.shape[1]
        self.shapes = (nx, nx), (nx, nu), (ny, nx), (ny, nu)
        free = [np.ones(shape, dtype=bool) for shape in self.shapes]
        for i, given in ((1, free_inputs), (3, free_feedthrough)):
            free[i] = free[i] if given is None else given
        self._free = free[3]
        fixed = torch.as_tensor(~np.concatenate([part.ravel() for part in free]))
        self._fixed = fixed if fixed.any() else None
        self._together, self._by_modes, self._limits = together, by_modes, limits
        self._reduced: Reduction | None = None

    def at(self, theta: Tensor) -> LinearPoint:
        """The model at θ (P,)."""
        ends = np.cumsum([rows * columns for rows, columns in self.shapes])
        parts = zip(np.split(theta.numpy(), ends[:-1]), self.shapes, strict=True)
        matrices = [part.reshape(shape) for part, shape in parts]
        return LinearPoint(self.data, matrices, together=self._together, by_modes=self._by_modes)

    def evaluate(self, theta: Tensor, near: Point | None = None) -> Point:
        """Weighted G U - Y, real parts then imaginary parts, then ρ e, (2 F ny m + nx,)."""
        at = self.at(theta)
        if not np.abs(at.poles).max() < self.largest_pole:
            size = 2 * self.data.Y.size + len(at.poles)
            residual = torch.full((size,), torch.inf, dtype=torch.float64)
        else:
            e = (
                np.zeros(len(at.poles))
                if self._limits is None
                else self._limits.excess(at.poles)[0]
            )
            residual = stacked(at.errors, RHO * np.linalg.norm(at.errors) * e)
        return Point(theta, residual, float(residual.square().sum()), (at,))

    def residual(self, theta: Tensor) -> Tensor:
        """The same, of a θ alone."""
        return self.evaluate(theta).residual

    def linearise_at(self, point: Point) -> ResponseJacobian:
        """Return the Jacobian, without the columns of a change of state coordinates."""
        at: LinearPoint = point.seen[0]
        columns = (
            self._kept(at) if at.modes is None else ModalColumns(at.modes, self.data, self._free)
        )
        return ResponseJacobian(columns, at.errors, *self._excess(at, len(point.theta)))

    def linearise(self, theta: Tensor) -> ResponseJacobian:
        """The same, of a θ alone."""
        return self.linearise_at(self.evaluate(theta))

    def covariance(self, theta: Tensor, known: bool) -> Array:
        """Return the covariance (P, P) of θ at the minimum.

        Unless the weights are ``known`` to be inverse variances, the error found at each line
        stands for its variance (White's estimate).
        """
        at = self.at(theta)
        return self._kept(at).covariance(self.data, at.errors, known=known)

    def _kept(self, at: LinearPoint) -> KeptColumns:
        """Weighted derivative of G U in the columns that are kept, and how these give all."""
        A, _, C, _ = at.matrices
        initial_states = torch.zeros(0, len(A), dtype=torch.float64)
        cell = linear_cell(*at.matrices)
        self._reduced = reduction(cell, initial_states, before=self._reduced, fixed=self._fixed)
        U, L = self.data.U, solve_left(A, C, self.data.z)
        driven = at.states if self._together else at.states @ U
        J = response_jacobian(driven, L, U, self._reduced.kept.numpy())
        return KeptColumns(self.data.weighted(J), self._reduced)

    def _excess(self, at: LinearPoint, parameters: int) -> tuple[Array, Array]:
        """Excess (nx,) of each pole over its limit, and its derivative (nx, P) with θ."""
        nx = len(at.poles)
        slopes = np.zeros((nx, parameters))
        if self._limits is None:
            return np.zeros(nx), slopes
        e, _ = self._limits.excess(at.poles)
        if e.any():
            slopes[:, : nx * nx] = self._limits.slopes(*at.eigen)
        return e, slopes


class LinearPoint:
    """A linear model at one θ: what its residual and its derivatives share."""

    def __init__(
        self, data: SpectralData, matrices: list[Array], *, together: bool, by_modes: bool
    ) -> None:
        self.matrices, self._data, self._together = matrices, data, together
        self.modes = Modes.of(*matrices) if by_modes else None  # that derivatives are computed by

    @cached_property
    def poles(self) -> Complex128[Complex, " nx"]:
        """Poles."""
        if self.modes is not None:
            return self.modes.poles
        return np.asarray(np.linalg.eigvals(self.matrices[0]), dtype=np.complex128)

    @property
    def eigen(self) -> tuple[Complex, Complex, Complex]:
        """Poles, eigenvectors V of A and V⁻¹."""
        if self.modes is not None:
            return self.modes[:3]
        poles, V = (np.asarray(m, dtype=np.complex128) for m in np.linalg.eig(self.matrices[0]))
        return poles, V, np.asarray(np.linalg.pinv(V), dtype=np.complex128)

    @cached_property
    def states(self) -> Complex:
        """(zI - A)⁻¹ B, times U if the problem has all inputs together."""
        A, B, _, _ = self.matrices
        return solve_resolvent(A, B, self._data.z, self._data.U if self._together else None)

    @cached_property
    def errors(self) -> Complex128[Complex, "F ny m"]:
        """Weighted G U - Y."""
        (_, _, C, D), U = self.matrices, self._data.U
        if self.modes is not None:
            response = self.modes.response(self._data.z) @ U
        else:
            response = C @ self.states + D @ U if self._together else (C @ self.states + D) @ U
        return self._data.weighted(response - self._data.Y)


class ResponseJacobian:
    """Jacobian of the residual with θ: columns of the errors, and rows of poles beyond limits."""

    def __init__(
        self,
        columns: KeptColumns | ModalColumns,
        errors: Complex128[Complex, "F ny m"],
        e: Float[Array, " nx"],
        slopes: Float[Array, "nx P"],
    ) -> None:
        self.columns, self._gradient = columns, columns.gradient(stacked(errors)).numpy()
        size = float(np.linalg.norm(errors))
        self._excess = RHO * size * e
        self._rows = RHO * (size * slopes + np.outer(e, self._gradient / max(size, 1e-300)))

    def system(self, damping: float, truncation: float) -> tuple[System, Tensor]:
        """Return the system and the gradient, see ``residual.Jacobian``."""
        gradient = torch.as_tensor(self._gradient + self._rows.T @ self._excess)
        more = self._rows if self._excess.any() else None
        return self.columns.system(truncation, more), gradient

    def tangent(self, d_theta: Tensor) -> Tensor:
        """J d_theta."""
        of_poles = torch.as_tensor(self._rows @ d_theta.numpy())
        return torch.cat([self.columns.tangent(d_theta), of_poles])

    def adjoint(self, residual: Tensor) -> Tensor:
        """Jᵀ residual (P,)."""
        of_poles = residual[len(residual) - len(self._excess) :]
        gradient = self.columns.gradient(residual[: len(residual) - len(of_poles)])
        return gradient + torch.as_tensor(self._rows.T @ of_poles.numpy())


class KeptColumns:
    """Derivative of the errors in the columns that gauge directions leave."""

    def __init__(self, J: Complex128[Complex, "F ny m K"], reduced: Reduction) -> None:
        self._J, self._reduced = J, reduced
        self._rows = stacked(J).view(-1, J.shape[-1])

    def system(self, truncation: float, more: Float[Array, "n P"] | None = None) -> SVDSystem:
        """The system of these columns, and of more rows."""
        rows = self._rows
        if more is not None:
            rows = torch.cat([rows, torch.as_tensor(more)[:, self._reduced.kept]])
        R = torch.linalg.qr(rows, mode="r").R
        return SVDSystem(self._reduced.columns(R), truncation)

    def tangent(self, d_theta: Tensor) -> Tensor:
        """J d_theta."""
        return self._rows @ self._reduced.reduced(d_theta)

    def gradient(self, r: Tensor) -> Tensor:
        """Jᵀ r (P,)."""
        return self._reduced.gradient(self._rows.mT @ r)

    def covariance(self, data: SpectralData, errors: Complex, *, known: bool) -> Array:
        """Covariance (P, P) of θ at the minimum, see ``ResponseProblem.covariance``."""
        inverse = self.system(TRUNCATION).inverse.numpy()
        if known and data.errors is None:
            return inverse / 2  # a complex error of variance 1 has real parts of variance 1/2
        # Sandwich (JᴴJ)⁻¹ cov(Σ s) (JᴴJ)⁻¹ with the scores s = Re(Jᴴ r) of the lines.
        J = self._J.reshape(len(self._J), -1, self._J.shape[-1]).conj()
        expand = self._reduced.reduced(torch.from_numpy(inverse)).numpy()

        def scores(r: Complex) -> Complex:
            return np.einsum("fek,fe->fk", J, r.reshape(J.shape[:2])) @ expand

        if data.errors is not None:
            return data.errors.covariance(lambda e: scores(data.weighted(e)), len(inverse))
        root = scores(errors).real  # whose squares are positive, whatever the rounding
        M, K = 2 * errors.size, self._J.shape[-1]
        return root.T @ root * (M / max(1, M - K))
