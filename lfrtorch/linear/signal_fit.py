"""Fit of a linear model to signals: simulation error, or one-step-ahead prediction error.

The simulation error compares the measured output to the output that the model computes from the
input alone. The prediction error lets the model see the outputs before each sample, which helps if
disturbances act on the states: the innovation model is x+ = A x + B u + K e, y = C x + D u + e.

Its predictor is a linear model as well, with the inputs u and y: x+ = (A - K C) x + (B - K D) u +
K y. So both errors are simulation errors of a linear cell, and the machinery of the nonlinear fit
minimises them. A constant among the inputs of the cell gives the offset of the output.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy
import torch
from torch import Tensor

from lfrtorch._support.types import Array
from lfrtorch.data.records import PAST_OUTPUTS, NormalisedRecord
from lfrtorch.engine.lfr import LFR
from lfrtorch.engine.linearised import spectral_radius
from lfrtorch.least_squares.linear_systems import SVDSystem
from lfrtorch.least_squares.problem import Problem
from lfrtorch.least_squares.search import Search
from lfrtorch.least_squares.simulation_errors import SimulationErrors
from lfrtorch.least_squares.term import Seen, Term, TermRows
from lfrtorch.linear.model import linear_cell
from lfrtorch.linear.refinement import TRUNCATION, Matrices, Refined, refining
from lfrtorch.linear.subspace import LARGEST_POLE, SubspaceEstimate, from_signals
from lfrtorch.model.model import simulate_record

OBSERVERS = (1e-4, 1e-2, 1.0)
"""Variances of the state noise in the initial innovation models of a prediction-error fit, besides
0: relative to the variances of the states, for output noise of variance 1."""

UNSTABLE = 20.0
"""An unstable system must lower -2 log likelihood by this."""


class SignalFit:
    """Least-squares problem between records and linear models of any order.

    The last ``direct`` inputs act on the output alone: their part of B is 0.
    """

    def __init__(
        self,
        records: Sequence[NormalisedRecord],
        *,
        offset: bool,
        prediction: bool,
        feedthrough: bool = True,
        direct: int = 0,
    ) -> None:
        self._us, self._ys = [each.u for each in records], [each.y for each in records]
        self.nu, self.ny = self._us[0].shape[1], self._ys[0].shape[1]
        self._offset, self._prediction, self._feedthrough = offset, prediction, feedthrough
        self._driving = self.nu - direct
        self._driven = [self._with_all_inputs(each) for each in records]

    def most_candidates(self, nx: int) -> int:
        """Return how many subspace estimates are refined: one for long records, as it is good."""
        return 8 if sum(map(len, self._us)) * nx**2 <= 200_000 else 1

    def many(self, nx: int) -> bool:
        """Return False: all searches go to the end."""
        return False

    def subspace_estimates(self, nx: int) -> list[SubspaceEstimate]:
        """Subspace estimates of A and C."""
        return from_signals([u[:, : self._driving] for u in self._us], self._ys, nx)

    def with_input_matrices(self, A: Array, C: Array) -> tuple[float, Matrices]:
        """Cost and system with the best B and D for A and C: y is linear in them."""
        nu, ny, nx = self.nu, self.ny, len(A)
        matrices = A, np.zeros((nx, nu)), C, np.zeros((ny, nu))
        problem = self._problem(matrices, np.zeros((nx, ny)), observed=False)
        cell = problem.lfr.cell
        at = problem.evaluate(problem.theta)
        cost = at.cost
        if np.isfinite(cost):
            system, gradient = problem.linearise_at(at, eliminate=False).system(0.0, TRUNCATION)
            if np.isfinite(system.scale):
                theta = problem.theta + system.solve(gradient, 0.0)
                cost = problem.evaluate(theta).cost
                problem.write(theta)
        B, D = (m.detach().numpy()[:, :nu].copy() for m in (cell.Bu, cell.Dyu))
        return (cost if np.isfinite(cost) else np.inf), (A, B, C, D)

    def state_deviation(self, matrices: Matrices) -> Array:
        """Standard deviation (nx,) of the states over the records."""
        lfr = LFR(linear_cell(*matrices))
        states = [
            simulate_record(lfr, replace(each, u=u), each.record.start).x[0, :-1].numpy()
            for u, each in zip(self._us, self._driven, strict=True)
        ]
        return np.concatenate(states).std(axis=0)

    def search(self, matrices: Matrices) -> Search:
        """Begin a search over A, B, C, D and K from the given ones and the best of some K."""
        gains = [np.zeros((len(matrices[0]), self.ny))]
        if self._prediction:
            variances = self.state_deviation(matrices) ** 2
            gains += [self._observer(matrices, part * variances) for part in OBSERVERS]
        problems = [self._problem(matrices, K) for K in gains]
        problem = min(problems, key=lambda p: p.evaluate(p.theta).cost)
        return refining(problem, problem.theta)

    def unstable(self, found: Refined, max_iter: int) -> Refined:
        """Return an unstable system if it predicts clearly better, or else ``found``.

        In a loop the system need not be stable, but its predictor must be.
        """
        if found.K is None or np.abs(np.linalg.eigvals(found.A)).max() < 0.99:
            return found
        problem = self._problem(found.matrices, found.K, stable=False)
        more = self.refined(refining(problem, problem.theta).advance(max_iter))
        gain = 2 * problem.size * math.log(found.rmse / max(more.rmse, 1e-300))
        clear = np.abs(np.linalg.eigvals(more.A)).max() >= 1.0 and gain > UNSTABLE
        return more if clear else found

    def improbability(self, search: Search) -> float:
        """Return the cost, plus x0ᵀ P⁻¹ x0 of each estimated start times the error's variance.

        P is the covariance of the states when the inputs drive the model from rest.
        """
        problem, state = search.problem, search.state
        x0 = problem.errors.parameters.initial_states(state.theta)
        if self._prediction or not len(x0):
            return state.cost
        problem.write(state.theta)
        driven = torch.cat(
            [problem.lfr.trajectory(group.u).x.flatten(0, 1) for group in problem.errors.groups]
        )
        spread, axes = torch.linalg.eigh(driven.mT @ driven / len(driven))
        variances = spread.clamp_min(1e-12 * float(spread[-1]))  # if inputs do not move a state
        unlikely = float(((x0 @ axes).square() / variances).sum())
        return state.cost * (1.0 + unlikely / problem.size)

    def refined(self, search: Search) -> Refined:
        """Return the present result of a search, with its covariance."""
        problem, state = search.problem, search.state
        problem.write(state.theta)
        cell = problem.lfr.cell
        A, Bu, C, Dyu = (m.detach().numpy() for m in (cell.A, cell.Bu, cell.Cy, cell.Dyu))
        nu, ny = self.nu, self.ny
        B, D, K = Bu[:, :nu].copy(), Dyu[:, :nu].copy(), np.zeros((len(A), ny))
        constant = Dyu[:, -1].copy() if self._offset else None
        if self._prediction:
            K = Bu[:, nu : nu + ny].copy()
            if constant is not None:  # at rest, where the predictor sees this same output
                driven = K @ constant + Bu[:, -1]
                at_rest = np.linalg.solve(np.eye(len(A)) - A - K @ C, driven)
                constant = np.asarray(constant + C @ at_rest, dtype=np.float64)
        system, _ = problem.linearise_at(state.point, eliminate=False).system(0.0, TRUNCATION)
        assert isinstance(system, SVDSystem)
        covariance = None
        if state.iteration:
            spread = self._spread(problem, state.theta, state.cost, system)
            covariance = self._of_system(spread, C, D, K)
        found = Refined(
            A + K @ C,
            B + K @ D,
            C.copy(),
            D,
            covariance=covariance,
            rmse=math.sqrt(state.cost / problem.size),
            iterations=state.iteration,
            reason=search.reason,
            constant=constant,
        )
        if not self._prediction:
            return found
        pairs = zip(problem.errors.groups, state.seen[0], strict=True)
        errors = torch.cat([(b.y - t.y)[b.scored[..., 0].bool()] for b, t in pairs])
        innovations = np.atleast_2d(np.cov(errors.numpy().T, bias=True))
        return replace(found, K=K, innovation_covariance=innovations)

    def _spread(self, problem: Problem, theta: Tensor, cost: float, system: SVDSystem) -> Array:
        """Covariance of θ, for white innovations or for simulation errors of any spectrum.

        The DFT lines of a stationary error are almost independent, whatever its spectrum. So the
        error found at each line stands for its variance (White's estimate), unless the Jacobian
        takes too much memory.
        """
        inverse, spare = system.inverse.numpy(), max(1, problem.size - system.rank)
        if self._prediction or problem.size * len(theta) > 50_000_000:  # 400 MB
            return inverse * (cost / spare)
        rows, errors = problem.jacobian(theta).numpy(), problem.residual(theta).numpy()
        found, first = np.zeros_like(inverse), 0
        for group in problem.errors.groups:
            shape = group.y.shape
            last = first + shape.numel()
            if group.spectral:  # its errors are DFT lines already
                scores = (rows[first:last] * errors[first:last, None]).reshape(*shape, -1).sum(2)
            else:
                J = np.fft.rfft(rows[first:last].reshape(*shape, -1), axis=1)
                r = np.fft.rfft(errors[first:last].reshape(shape), axis=1)
                scores = np.einsum("rfop,rfo->rfp", J.conj(), r).real * (2.0 / shape[1])
                scores[:, 0] /= 2.0
                if shape[1] % 2 == 0:
                    scores[:, -1] /= 2.0
            root = scores.reshape(-1, scores.shape[-1]) @ inverse
            found += root.T @ root
            first = last
        return found * (problem.size / spare)

    def _with_all_inputs(self, each: NormalisedRecord) -> NormalisedRecord:
        """Return the record with the cell's inputs: u, for a prediction y, and a constant."""
        inputs, record = [each.u], each.record
        if self._prediction:
            record.require_all_valid(PAST_OUTPUTS)
            inputs.append(each.y)
            if record.start == "periodic":
                record = replace(record, start="estimated", line_weight=None)
        if self._offset:
            inputs.append(np.ones((len(each.u), 1)))
        return NormalisedRecord(np.hstack(inputs), each.y, record)

    def _problem(
        self, matrices: Matrices, K: Array, *, observed: bool = True, stable: bool = True
    ) -> Problem:
        """Return the problem of the cell; unless ``observed``, B, D and the constant alone vary."""
        A, B, C, D = matrices
        nu, ny = self.nu, self.ny
        width = self._driven[0].u.shape[1]
        Bu, Dyu = np.zeros((len(A), width)), np.zeros((ny, width))
        Bu[:, :nu], Dyu[:, :nu] = B - K @ D, D
        free_B, free_D = np.zeros_like(Bu, dtype=bool), np.zeros_like(Dyu, dtype=bool)
        free_B[:, : self._driving], free_D[:, :nu] = True, self._feedthrough
        if self._prediction:
            Bu[:, nu : nu + ny] = K
            free_B[:, nu : nu + ny] = observed
        if self._offset:
            free_D[:, -1] = True
            free_B[:, -1] = observed and self._prediction  # y0 reaches the states through K
        cell = linear_cell(A - K @ C, Bu, C, Dyu)
        for parameter in (cell.A, cell.Cy):
            parameter.requires_grad_(observed)
        for name, free in (("Bu", free_B), ("Dyu", free_D)):
            cell.hold({name: (torch.as_tensor(~free), cell.get_parameter(name).detach())})
        errors = SimulationErrors(cell, self._driven)
        measured = slice(nu, nu + ny) if self._prediction and stable else None
        walls = [_PoleWall(errors, measured)] if observed else []
        return Problem(LFR(cell), errors, walls)

    def _observer(self, matrices: Matrices, variances: Array) -> Array:
        """Kalman gain (nx, ny) for state noise of these variances."""
        A, _, C, _ = matrices
        P = scipy.linalg.solve_discrete_are(A.T, C.T, np.diag(variances), np.eye(self.ny))
        return np.linalg.solve(C @ P @ C.T + np.eye(self.ny), C @ P @ A.T).T

    def _of_system(self, covariance: Array, C: Array, D: Array, K: Array) -> Array:
        """Covariance of A, B, C, D from that of the cell's parameters and initial states."""
        nx, nu, ny, width = len(K), self.nu, self.ny, self._driven[0].u.shape[1]
        sizes = [nx * nx, nx * width, ny * nx, ny * width]
        ends = np.cumsum(sizes)
        cells = np.split(np.eye(ends[-1], len(covariance)), ends[:-1])
        Bu = cells[1].reshape(nx, width, -1)
        Dyu = cells[3].reshape(ny, width, -1)[:, :nu].reshape(ny * nu, -1)
        dB = Bu[:, :nu].reshape(nx * nu, -1)
        dA, dC = cells[0], cells[2]
        if self._prediction:
            dK = Bu[:, nu : nu + ny].reshape(nx * ny, -1)
            eye = np.eye(nx)
            dA = dA + np.kron(eye, C.T) @ dK + np.kron(K, eye) @ dC
            dB = dB + np.kron(eye, D.T) @ dK + np.kron(K, np.eye(nu)) @ Dyu
        change = np.vstack([dA, dB, dC, Dyu])
        return change @ covariance @ change.T


class _PoleWall(Term):
    """A term without rows: infinite if a pole of a linear cell passes LARGEST_POLE.

    If the cell is a predictor with ``outputs`` among its inputs, the system has the same limit.
    """

    def __init__(self, errors: SimulationErrors, outputs: slice | None) -> None:
        self._errors, self._outputs = errors, outputs

    def evaluate(self, theta: Tensor, near: Seen | None = None) -> tuple[Tensor, Seen]:
        W = self._errors.parameters.weights(theta)
        matrices = [W.A]
        if self._outputs is not None:
            matrices.append(W.A + W.Bu[:, self._outputs] @ W.Cy)
        stable = all(spectral_radius(A) < LARGEST_POLE for A in matrices)
        return theta[:0] if stable else theta.new_full((1,), torch.inf), ()

    def linearise(self, theta: Tensor, seen: Seen, *, eliminate: bool) -> list[TermRows]:
        return []
