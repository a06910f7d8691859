"""Fit of a linear model to spectra Y = G(z) U: least squares in the frequency domain.

The error at each DFT line is the measured Y minus G(z) U, where G(z) = C (zI - A)⁻¹ B + D is the
response of the model. For given A and C it is linear in B and D, which one least-squares problem
yields; that completes a subspace estimate to a model. Levenberg-Marquardt then refines all four
matrices. A step that brings a pole out of the unit circle has an infinite cost, and is rejected;
``pole_limits`` limits poles that the lines do not determine.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy
import torch
from jaxtyping import Complex128, Float
from torch import Tensor

from lfrtorch._support.types import Array, Booleans, Complex
from lfrtorch.least_squares.gauge import Reduction, reduction
from lfrtorch.least_squares.levenberg_marquardt import LeastSquares, Point
from lfrtorch.least_squares.linear_systems import SVDSystem
from lfrtorch.least_squares.search import Search
from lfrtorch.linear.modal_jacobian import ModalJacobian, Modes, stacked, with_best_inputs
from lfrtorch.linear.model import linear_cell
from lfrtorch.linear.pole_limits import PART, Excess, PoleLimits
from lfrtorch.linear.refinement import TOLERANCE, TRUNCATION, Matrices, Refined, refining
from lfrtorch.linear.resolvent import (
    frequency_response,
    response_jacobian,
    solve_driven,
    solve_left,
    solve_resolvent,
)
from lfrtorch.linear.spectral_data import SpectralData
from lfrtorch.linear.subspace import LARGEST_POLE, SubspaceEstimate, from_spectra

MANY = 40
"""From this number of unknowns on, the derivatives are computed by modes."""


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
        J = _real(self.data.weighted(response_jacobian(rest, L, self.data.U, columns))).numpy()
        r = _real(self.data.weighted(self.data.Y)).numpy()
        if not np.isfinite(J).all():
            return np.inf, matrices
        size = np.linalg.norm(J, axis=0)
        # A state that no output sees has a column of 0, up to underflow: its input stays 0.
        size = np.maximum(size, max(1e-100 * size.max(), 1e-300))
        best = scipy.linalg.lstsq(J / size, r, check_finite=False)[0] / size
        _, B, _, D = matrices
        B[free_B], D[free] = np.split(best, [len(of_B)])
        return float(np.sum((r - J @ best) ** 2)), matrices

    def state_deviation(self, matrices: Matrices) -> Array:
        """Standard deviation (nx,) of the states."""
        states = solve_resolvent(*matrices[:2], self.data.z) @ self.data.U
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
        return Refined(
            *problem.matrices(state.theta),
            covariance=problem.covariance(state.theta, self.known) if state.iteration else None,
            rmse=float(np.linalg.norm(problem.errors(state.theta)) / math.sqrt(self.data.Y.size)),
            iterations=state.iteration,
            reason=search.reason,
        )


class ResponseProblem(LeastSquares):
    """Residual and Jacobian of a linear model over spectra; infinite if a pole passes a limit.

    θ holds A, B, C and D, row by row, one matrix after another. If U has few columns, it is less
    work to compute the states under all inputs ``together`` than under each input.
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
        self.data, self.largest_pole, self._together = data, largest_pole, together
        nu, ny = data.U.shape[1], data.Y.shape[1]
        self.shapes = (nx, nx), (nx, nu), (ny, nx), (ny, nu)
        free = [np.ones(shape, dtype=bool) for shape in self.shapes]
        for i, given in ((1, free_inputs), (3, free_feedthrough)):
            free[i] = free[i] if given is None else given
        self._free = free[3]
        fixed = torch.as_tensor(~np.concatenate([part.ravel() for part in free]))
        self._fixed = fixed if fixed.any() else None
        self._by_modes = by_modes
        self._limits = limits
        self._reduced: Reduction | None = None

    def matrices(self, theta: Tensor) -> list[Array]:
        """A, B, C, D of θ (P,)."""
        parts = theta.numpy()
        ends = np.cumsum([rows * columns for rows, columns in self.shapes])
        return [p.reshape(s) for p, s in zip(np.split(parts, ends[:-1]), self.shapes, strict=True)]

    def evaluate(self, theta: Tensor, near: Point | None = None) -> Point:
        """Weighted G U - Y, real parts then imaginary parts, then ρ e, (2 F ny m + nx,)."""
        at = self._at(theta)
        if at.errors is None:
            size = 2 * self.data.Y.size + len(at.poles)
            residual = torch.full((size,), torch.inf, dtype=torch.float64)
        elif self._limits is None:
            residual = stacked(at.errors, np.zeros(len(at.poles)))
        else:
            e, _ = self._limits.excess(at.poles)
            residual = stacked(at.errors, math.sqrt(PART) * np.linalg.norm(at.errors) * e)
        return Point(theta, residual, float(residual.square().sum()), (at,))

    def residual(self, theta: Tensor) -> Tensor:
        """Return the residual at θ alone."""
        return self.evaluate(theta).residual

    def linearise_at(self, point: Point) -> ResponseJacobian | ModalJacobian:
        """Return the Jacobian, without the columns of a change of state coordinates."""
        at: _At = point.seen[0]
        assert at.errors is not None
        excess = self._excess(at, len(point.theta))
        if at.modes is not None:
            return ModalJacobian(at.modes, self.data, at.errors, free=self._free, excess=excess)
        return ResponseJacobian(*self._jacobian(at), at.errors, excess)

    def linearise(self, theta: Tensor) -> ResponseJacobian | ModalJacobian:
        """Return the Jacobian at θ."""
        return self.linearise_at(self.evaluate(theta))

    def errors(self, theta: Tensor) -> Complex:
        """Weighted G U - Y (F, ny, m)."""
        return self._errors(self._at(theta))

    def covariance(self, theta: Tensor, known: bool) -> Array:
        """Return the covariance (P, P) of θ at the minimum.

        Unless the weights are ``known`` to be inverse variances, the error found at each line
        stands for its variance (White's estimate).
        """
        at, nx = self._at(theta), self.shapes[0][0]
        none = np.zeros(nx), np.zeros((nx, len(theta)))
        jacobian = ResponseJacobian(*self._jacobian(at), self._errors(at), none)
        return jacobian.covariance(self.data, known=known)

    def _at(self, theta: Tensor) -> _At:
        """The model at θ."""
        matrices = self.matrices(theta)
        modes = Modes.of(*matrices) if self._by_modes else None
        poles = np.linalg.eigvals(matrices[0]) if modes is None else modes.poles
        at = _At(matrices, np.asarray(poles, dtype=np.complex128), modes)
        if not np.abs(poles).max() < self.largest_pole:
            return at
        if modes is None:
            at = at._replace(states=self._states(matrices))
        return at._replace(errors=self._errors(at))

    def _errors(self, at: _At) -> Complex:
        if at.errors is not None:
            return at.errors
        U = self.data.U
        if at.modes is not None:
            return self.data.weighted(at.modes.response(self.data.z) @ U - self.data.Y)
        _, _, C, D = at.matrices
        X = self._states(at.matrices) if at.states is None else at.states
        response = C @ X + D @ U if self._together else (C @ X + D) @ U
        return self.data.weighted(response - self.data.Y)

    def _states(self, matrices: Sequence[Array]) -> Complex:
        """Return (zI - A)⁻¹ B, times U if ``together``."""
        A, B, _, _ = matrices
        z = self.data.z
        return solve_driven(A, B, z, self.data.U) if self._together else solve_resolvent(A, B, z)

    def _jacobian(self, at: _At) -> tuple[Complex, Reduction]:
        """Weighted derivative of G U in the kept columns, and the reduction to all columns."""
        A, _, C, _ = at.matrices
        initial_states = torch.zeros(0, len(A), dtype=torch.float64)
        cell = linear_cell(*at.matrices)
        self._reduced = reduction(cell, initial_states, before=self._reduced, fixed=self._fixed)
        X = self._states(at.matrices) if at.states is None else at.states
        U, L = self.data.U, solve_left(A, C, self.data.z)
        J = response_jacobian(X if self._together else X @ U, L, U, self._reduced.kept.numpy())
        return self.data.weighted(J), self._reduced

    def _excess(self, at: _At, parameters: int) -> tuple[Array, Array]:
        """Excess (nx,) of each pole over its limit, and its derivative (nx, P) with θ."""
        poles = at.poles
        e, slopes = np.zeros(len(poles)), np.zeros((len(poles), parameters))
        if self._limits is not None:
            e, _ = self._limits.excess(poles)
            if e.any():
                if at.modes is not None:
                    poles, V, W = at.modes[:3]
                else:
                    eigen = np.linalg.eig(at.matrices[0])
                    poles, V = (np.asarray(part, dtype=np.complex128) for part in eigen)
                    W = np.asarray(np.linalg.pinv(V), dtype=np.complex128)
                slopes[:, : V.size] = self._limits.slopes(poles, V, W)
        return e, slopes


class _At(NamedTuple):
    """A linear model at one θ."""

    matrices: list[Array]
    poles: Complex128[Complex, " nx"]
    modes: Modes | None  # if derivatives are computed by them
    states: Complex | None = None  # (zI - A)⁻¹ B, times U if the problem has them together
    errors: Complex128[Complex, "F ny m"] | None = None  # None if a pole passes the limit


class ResponseJacobian:
    """Jacobian of the residual with θ, from the columns of the errors that are kept."""

    def __init__(
        self,
        J: Complex128[Complex, "F ny m K"],
        reduced: Reduction,
        errors: Complex128[Complex, "F ny m"],
        excess: tuple[Float[Array, " nx"], Float[Array, "nx P"]],
    ) -> None:
        self._J, self._reduced, self._errors = J, reduced, errors
        self._rows, r, e = _real(J), _real(errors), excess[0]
        self._more: Excess | None = None
        self._residual, self._poles = r, len(e)
        if e.any():
            gradient = reduced.gradient(self._rows.mT @ r)
            self._more = Excess(*excess, float(torch.linalg.norm(r)), gradient.numpy())
            rows = torch.as_tensor(self._more.jacobian)[:, reduced.kept]
            self._rows = torch.cat([self._rows, rows])
            self._residual = torch.cat([r, torch.as_tensor(self._more.residual)])

    def system(self, damping: float, truncation: float) -> tuple[SVDSystem, Tensor]:
        """Return the system and the gradient, see ``levenberg_marquardt.Jacobian``."""
        R = torch.linalg.qr(self._rows, mode="r").R
        return SVDSystem(self._reduced.columns(R), truncation), self._adjoint(self._residual)

    def tangent(self, d_theta: Tensor) -> Tensor:
        """J d_theta."""
        found = self._rows @ self._reduced.reduced(d_theta)
        return found if self._more else torch.cat([found, found.new_zeros(self._poles)])

    def adjoint(self, residual: Tensor) -> Tensor:
        """Jᵀ residual (P,)."""
        return self._adjoint(residual if self._more else residual[: len(residual) - self._poles])

    def _adjoint(self, residual: Tensor) -> Tensor:
        return self._reduced.gradient(self._rows.mT @ residual)

    def covariance(self, data: SpectralData, *, known: bool) -> Array:
        """Covariance (P, P) of θ at the minimum, see ``ResponseProblem.covariance``."""
        inverse = self.system(0.0, TRUNCATION)[0].inverse.numpy()
        if known and data.errors is None:
            return inverse / 2  # a complex error of variance 1 has real parts of variance 1/2
        # Sandwich (JᴴJ)⁻¹ cov(Σ s) (JᴴJ)⁻¹ with the scores s = Re(Jᴴ r) of the lines.
        J = self._J.reshape(len(self._J), -1, self._J.shape[-1]).conj()
        expand = self._reduced.reduced(torch.from_numpy(inverse)).numpy()

        def scores(r: Complex) -> Complex:
            return np.einsum("fek,fe->fk", J, r.reshape(J.shape[:2])) @ expand

        if data.errors is not None:
            return data.errors.covariance(lambda e: scores(data.weighted(e)), len(inverse))
        root = scores(self._errors).real  # its squares are positive, whatever the rounding
        M, K = 2 * self._errors.size, self._rows.shape[1]
        return root.T @ root * (M / max(1, M - K))


def _real(errors: Complex) -> Tensor:
    """Real parts, then imaginary parts: (F, ny, m[, K]) -> (2 F ny m[, K])."""
    flat = errors.reshape(-1, *errors.shape[3:])
    return torch.as_tensor(np.concatenate([flat.real, flat.imag]))
