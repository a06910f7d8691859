"""Parametric best linear approximation: subspace start, refined on the simulation error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import scipy.linalg
import torch
from numpy.typing import NDArray
from torch import Tensor

from lfrtorch.cell import LFRCell
from lfrtorch.checks import integer
from lfrtorch.levenberg_marquardt import DenseJacobian, LevenbergMarquardt
from lfrtorch.lfr import LFR
from lfrtorch.model import Model
from lfrtorch.records import Channel, Record, Scaler, as_records, rms_scale, without_coordinates
from lfrtorch.residual import SimulationError
from lfrtorch.slopes import spectral_radius
from lfrtorch.threads import spread_by_hand

Array = NDArray[np.float64]

HORIZONS = (2, 3, 5, 10)
"""Block rows of the subspace start in multiples of nx + 1; the best in simulation is kept."""

LARGEST_POLE = 1.0 - 1e-6
"""Radius that no pole reaches: the margin keeps a model stable when its coordinates change."""

MOVED_POLE = 0.999
"""Largest radius that an unstable pole of the subspace start is moved to."""


@dataclass(frozen=True, eq=False)
class LinearModel:
    """Linear state-space model in physical units, about an operating point::

        x+ = A x + B (u - u_offset)
        y  = C x + D (u - u_offset) + y_offset

    Args:
        A, B, C, D: system matrices.
        fs: sampling frequency in Hz.
        u_offset, y_offset: operating point.
        inputs, outputs: channel names and units.

    Shape:
        A: (nx, nx), B: (nx, nu), C: (ny, nx), D: (ny, nu), u_offset: (nu,), y_offset: (ny,).
    """

    A: Array
    B: Array
    C: Array
    D: Array
    fs: float
    u_offset: Array
    y_offset: Array
    inputs: tuple[Channel, ...]
    outputs: tuple[Channel, ...]

    @property
    def poles(self) -> NDArray[np.complex128]:
        """Poles (nx,), in the z plane."""
        return np.asarray(np.linalg.eigvals(self.A), dtype=np.complex128)

    def frf(self, frequencies: Array) -> NDArray[np.complex128]:
        """Frequency response C (zI - A)⁻¹ B + D.

        Shape:
            frequencies: (F,) in Hz -> (F, ny, nu).
        """
        z = np.exp(2j * np.pi * np.asarray(frequencies) / self.fs)
        shifted = z[:, None, None] * np.eye(len(self.A)) - self.A
        states = np.linalg.solve(shifted, np.broadcast_to(self.B, (len(z), *self.B.shape)))
        return np.asarray(self.C @ states + self.D, dtype=np.complex128)

    def simulate(self, record: Record) -> Array:
        """Simulated output (T, ny) in physical units, from the record's own start.

        A given start state is in other coordinates; the one that fits best takes its place.
        """
        record = without_coordinates(record)
        nu, ny = len(self.inputs), len(self.outputs)
        unit = Scaler(self.u_offset, np.ones(nu), self.y_offset, np.ones(ny))
        cell = _cell(self.A, self.B, self.C, self.D)
        return Model(LFR(cell), unit, self.fs, self.inputs, self.outputs).simulate(record)

    def transformed(self, T: Array) -> LinearModel:
        """The same system in the coordinates T x."""
        A = scipy.linalg.solve(T.T, (T @ self.A).T).T
        return replace(self, A=A, B=T @ self.B, C=scipy.linalg.solve(T.T, self.C.T).T)


@spread_by_hand()
def estimate_bla(
    records: Record | Sequence[Record],
    nx: int,
    *,
    offset: bool = True,
    coordinates: Literal["balanced", "given"] = "balanced",
    max_iter: int = 200,
) -> LinearModel:
    """Best linear approximation of order ``nx``, stable, least squares in the simulation error.

    A subspace estimate (PO-MOESP and its past-input variant, several horizons) gives A and C, a
    linear least-squares fit of the simulated output B and D; the best in simulation is refined by
    Levenberg-Marquardt. Unstable poles of the start are reflected into the unit circle, and the
    refinement rejects every step that leaves it.

    Args:
        records: data; periodic ones are fitted in exact steady state, and start states that are
            given (in another model's coordinates) or estimated are fitted.
        nx: order.
        offset: whether the means of input and output are removed and stored as operating point.
        coordinates: ``"balanced"`` states, or ``"given"`` by the subspace estimate.
        max_iter: iterations of the refinement.

    Returns:
        The model, with states of unit standard deviation over the data.

    Raises:
        ValueError: an order below 1, a constant channel, or fewer samples than the order needs.

    References:
        Verhaegen, "Identification of the deterministic part of MIMO state space models given in
        innovations form from input-output data", Automatica 30, 1994 (PO-MOESP).
    """
    data = [without_coordinates(record) for record in as_records(records)]
    integer("nx", nx, 1)
    integer("max_iter", max_iter, 0)
    if coordinates not in ("balanced", "given"):
        raise ValueError(f"coordinates is {coordinates!r}; use 'balanced' or 'given'.")
    _check_excitation(data, nx)
    scaler = data_scaler(data, offset=offset)

    starts = [
        _with_input_matrices(A, C, data, scaler, offset=offset)
        for A, C in _subspace_estimates(data, scaler, nx)
    ]
    cost, cell = min(starts, key=lambda start: start[0])
    if not np.isfinite(cost):
        raise ValueError(
            f"no stable linear model of order {nx} could be started from these data; "
            "try a lower nx or a longer record."
        )
    _to_unit_variance(cell, data, scaler, balanced=coordinates == "balanced")
    _refine(cell, data, scaler, max_iter, offset=offset)
    _to_unit_variance(cell, data, scaler, balanced=coordinates == "balanced")

    A, B, C, D = (m.detach().numpy() for m in (cell.A, cell.Bu, cell.Cy, cell.Dyu))
    model = LinearModel(
        A=A,
        B=B / scaler.u_scale,
        C=scaler.y_scale[:, None] * C,
        D=scaler.y_scale[:, None] * D / scaler.u_scale,
        fs=data[0].fs,
        u_offset=scaler.u_offset,
        y_offset=scaler.y_offset,
        inputs=data[0].inputs,
        outputs=data[0].outputs,
    )
    if not offset:
        return model
    # The constant that the fit took off.
    errors = [(r.y - model.simulate(r))[r.skip :] for r in data]
    return replace(model, y_offset=model.y_offset + np.concatenate(errors).mean(axis=0))


def data_scaler(records: list[Record], *, offset: bool) -> Scaler:
    """Means (or zeros) of the records' signals, and their rms about them."""
    us, ys = [r.u for r in records], [r.y for r in records]

    def centre(signals: list[Array]) -> Array:
        mean = np.concatenate(signals).mean(axis=0)
        return mean if offset else np.zeros_like(mean)

    u_offset, y_offset = centre(us), centre(ys)
    return Scaler(u_offset, rms_scale(us, u_offset), y_offset, rms_scale(ys, y_offset))


def _check_excitation(records: list[Record], nx: int) -> None:
    for signals, channels in (
        ([r.u for r in records], records[0].inputs),
        ([r.y for r in records], records[0].outputs),
    ):
        everything = np.concatenate(signals)
        for channel, span in zip(channels, np.ptp(everything, axis=0), strict=True):
            if span == 0:
                raise ValueError(
                    f"signal '{channel.name}' is constant in all records; "
                    "a model needs an input that excites and an output that responds: "
                    "check the columns."
                )
    nu, ny = len(records[0].inputs), len(records[0].outputs)
    needed = 2 * _rows(HORIZONS[0], nx) * (nu + ny + 1)
    longest = max(r.samples for r in records)
    if longest < needed:
        raise ValueError(
            f"the longest record has {longest} samples; order nx={nx} with {nu} input(s) and "
            f"{ny} output(s) needs at least {needed}: record more, or lower nx."
        )


def _rows(multiple: int, nx: int) -> int:
    return multiple * (nx + 1)


def _subspace_estimates(
    records: list[Record], scaler: Scaler, nx: int
) -> list[tuple[Array, Array]]:
    """(A, C) of MOESP with past inputs and outputs, or past inputs alone, as instruments."""
    us = [scaler.normalise_u(r.u) for r in records]
    ys = [scaler.normalise_y(r.y) for r in records]
    nu, ny = us[0].shape[1], ys[0].shape[1]
    estimates = []
    for multiple in HORIZONS:
        i = _rows(multiple, nx)
        pairs = [(u, y) for u, y in zip(us, ys, strict=True) if len(u) >= 2 * i]
        columns = sum(len(u) - 2 * i + 1 for u, _ in pairs)
        if columns < 2 * i * (nu + ny):
            break
        U = np.hstack([_hankel(u, 2 * i) for u, _ in pairs])
        Y = np.hstack([_hankel(y, 2 * i) for _, y in pairs])
        stacked = np.vstack([U[i * nu :], U[: i * nu], Y[: i * ny], Y[i * ny :]])
        (R,) = scipy.linalg.qr(stacked.T, mode="r", overwrite_a=True)
        L = R[: len(stacked)].T
        inputs, past_u, past = i * nu, 2 * i * nu, i * (2 * nu + ny)
        for instruments in (past, past_u):
            U1, s, _ = np.linalg.svd(L[past:, inputs:instruments])
            O = U1[:, :nx] * np.sqrt(s[:nx])  # noqa: E741 - extended observability matrix
            A = np.linalg.lstsq(O[:-ny], O[ny:], rcond=None)[0]
            estimates.append((_stabilised(A), O[:ny]))
    return estimates


def _hankel(signal: Array, rows: int) -> Array:
    """Block Hankel matrix (rows * n, T - rows + 1) of a signal (T, n)."""
    windows = np.lib.stride_tricks.sliding_window_view(signal, rows, axis=0)  # (columns, n, rows)
    return windows.transpose(2, 1, 0).reshape(-1, windows.shape[0])


def _stabilised(A: Array) -> Array:
    """A with its unstable eigenvalues reflected into the unit circle, at most to MOVED_POLE."""
    values, vectors = np.linalg.eig(A)
    radius = np.abs(values)
    unstable = radius > LARGEST_POLE
    if not unstable.any():
        return A
    factor = np.where(unstable, np.minimum(1.0 / np.maximum(radius, 1.0), MOVED_POLE), radius)
    values = values * np.where(unstable, factor / np.maximum(radius, 1e-300), 1.0)
    return np.real(vectors * values @ np.linalg.pinv(vectors))


def _cell(A: Array, B: Array, C: Array, D: Array) -> LFRCell:
    cell = LFRCell(B.shape[1], C.shape[0], len(A), dtype=torch.float64)
    with torch.no_grad():
        for parameter, value in ((cell.A, A), (cell.Bu, B), (cell.Cy, C), (cell.Dyu, D)):
            parameter.copy_(torch.as_tensor(np.ascontiguousarray(value)))
    return cell


def _model(cell: LFRCell, records: list[Record], scaler: Scaler) -> Model:
    first = records[0]
    return Model(LFR(cell), scaler, first.fs, first.inputs, first.outputs)


class _LinearProblem(SimulationError):
    """Simulation error of a linear model, undefined where a pole passes LARGEST_POLE.

    With ``offset`` the best constant output is taken off in closed form: residual and derivatives
    are orthogonal to what a constant makes (variable projection).
    """

    def __init__(
        self, cell: LFRCell, records: list[Record], scaler: Scaler, *, offset: bool
    ) -> None:
        super().__init__(_model(cell, records, scaler), records)
        self.offset = offset
        # The residuals (M, ny) that a constant in each output makes, at unit length.
        each = torch.eye(len(self.model.outputs), dtype=torch.float64)
        constants = torch.cat(
            [b.weigh(each.expand(*b.y.shape, -1)).flatten(0, 2) for b in self.batches]
        )
        self._constants = constants / constants.norm(dim=0)

    def residual(self, theta: Tensor) -> Tensor:
        r = super().residual(theta)
        self.write(theta)
        stable = spectral_radius(self.model.lfr.cell.A.detach()) < LARGEST_POLE
        return self._centred(r) if stable else torch.full_like(r, torch.inf)

    def jacobian(self, theta: Tensor) -> Tensor:
        return self._centred(super().jacobian(theta))

    def linearise(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, theta: Tensor
    ) -> DenseJacobian:
        return DenseJacobian(self.jacobian(theta), self.residual(theta))

    def _centred(self, rows: Tensor) -> Tensor:
        if not self.offset:
            return rows
        return rows - self._constants @ (self._constants.mT @ rows)


def _with_input_matrices(
    A: Array, C: Array, records: list[Record], scaler: Scaler, *, offset: bool
) -> tuple[float, LFRCell]:
    """Mean square error and cell with the best B and D for A and C: y is linear in them."""
    nu, ny = len(scaler.u_scale), len(scaler.y_scale)
    cell = _cell(A, np.zeros((len(A), nu)), C, np.zeros((ny, nu)))
    for fixed in (cell.A, cell.Cy):
        fixed.requires_grad_(False)
    problem = _LinearProblem(cell, records, scaler, offset=offset)
    theta = problem.theta
    J, r = problem.jacobian(theta).numpy(), problem.residual(theta).numpy()
    if np.isfinite(J).all():
        theta = theta + torch.as_tensor(np.linalg.lstsq(J, -r, rcond=None)[0])
    cost = float(problem.residual(theta).square().sum())
    for fixed in (cell.A, cell.Cy):
        fixed.requires_grad_(True)
    return (cost if np.isfinite(cost) else np.inf), cell


def _refine(
    cell: LFRCell, records: list[Record], scaler: Scaler, max_iter: int, *, offset: bool
) -> None:
    """Levenberg-Marquardt on A, Bu, Cy, Dyu until the cost no longer falls."""
    problem = _LinearProblem(cell, records, scaler, offset=offset)
    optimiser = LevenbergMarquardt(max_iter=max_iter, acceleration=False, tolerance=1e-9)
    state = optimiser.init(problem, problem.theta)
    while not state.reason and state.iteration < max_iter:
        state = optimiser.step(problem, state)
    problem.write(state.theta)


def _to_unit_variance(
    cell: LFRCell, records: list[Record], scaler: Scaler, *, balanced: bool
) -> None:
    """Write balanced coordinates into a linear cell, then scale each state to unit variance."""
    if balanced:
        T, T_inverse = _balancing(*(m.detach().numpy() for m in (cell.A, cell.Bu, cell.Cy)))
        _transform(cell, T, T_inverse)
    model = _model(cell, records, scaler)
    states = torch.cat([model.signals(record).x[0, :-1] for record in records])
    std = states.std(dim=0, correction=0).numpy()
    std = np.where(std > 0, std, 1.0)
    _transform(cell, np.diag(1.0 / std), np.diag(std))


def _transform(cell: LFRCell, T: Array, T_inverse: Array) -> None:
    forward, backward = torch.as_tensor(T), torch.as_tensor(T_inverse)
    with torch.no_grad():
        cell.A.copy_(forward @ cell.A @ backward)
        cell.Bu.copy_(forward @ cell.Bu)
        cell.Cy.copy_(cell.Cy @ backward)


def _balancing(A: Array, B: Array, C: Array) -> tuple[Array, Array]:
    """T and T⁻¹ to balanced coordinates by the square-root method (Laub et al. 1987)."""
    Lp, Lq = _square_root(_gramian(A, B @ B.T)), _square_root(_gramian(A.T, C.T @ C))
    U, s, Vh = np.linalg.svd(Lq.T @ Lp)
    # A state that is all but uncontrollable or unobservable would be scaled by its rounding error.
    root = np.sqrt(np.maximum(s, s[0] * np.finfo(float).eps))
    return (U / root).T @ Lq.T, Lp @ (Vh.T / root)


def _gramian(A: Array, Q: Array) -> Array:
    """P = A P Aᵀ + Q by Smith's doubling.

    scipy's solver forms I - A ⊗ A, which is singular to rounding where two poles are close to the
    unit circle; the sum of A^k Q A^kᵀ stays positive semidefinite there.
    """
    P = Q
    while np.abs(A).max() > np.finfo(float).eps:
        P = P + A @ P @ A.T
        A = A @ A
    return P


def _square_root(gramian: Array) -> Array:
    values, vectors = np.linalg.eigh((gramian + gramian.T) / 2)
    return vectors * np.sqrt(np.maximum(values, 0.0))
