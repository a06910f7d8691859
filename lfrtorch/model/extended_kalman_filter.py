"""Extended Kalman filter of a model, and the noise covariances that it needs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import numpy as np
import scipy
import torch
from jaxtyping import Float
from numpy.typing import ArrayLike

from lfrtorch._support.checks import reals
from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array
from lfrtorch.data.records import Channel, Record, Scaler
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.kalman_kernel import (
    advance_sample,
    correct,
    correct_sample,
    filter_record,
    propagate,
)
from lfrtorch.engine.linearised import linearise
from lfrtorch.model.state_observer import StateObserver

_ROUNDING = 1e-9  # part of the largest eigenvalue below which a negative one is a rounding error


@dataclass(frozen=True, eq=False)
class NoiseCovariance:
    """Covariances of white noise w on the states and v on the outputs::

        x+ = f(x, u) + w        Q = E w wᵀ,  R = E v vᵀ,  S = E w vᵀ
        y  = h(x, u) + v

    A number is the variance of every channel, a vector has a variance for each.
    ``lfrtorch.estimate_noise`` estimates the covariances from records.

    Args:
        Q: covariance on the states, in the model's coordinates; 0 for undisturbed states.
        R: covariance on the outputs, in their units squared; positive definite.
        S: cross covariance of states and outputs. Default: 0.

    Shape:
        Q: (nx, nx), (nx,) or a number, R: (ny, ny), (ny,) or a number, S: (nx, ny).

    Example:
        >>> noise = lfrtorch.NoiseCovariance(Q=1e-4, R=1e-2)
        >>> observer = model.observer(noise=noise, after=record[:100])
        >>> y_hat = observer.predict(record.u[100])
        >>> e = observer.update(record.y[100])
        >>> observer.state.shape, observer.covariance.shape
        ((1,), (1, 1))
    """

    Q: ArrayLike
    R: ArrayLike
    S: ArrayLike | None = None

    def root(self, nx: int, ny: int) -> Float[Array, "n n"]:
        """G with G Gᵀ = [R Sᵀ; S Q] in the same units, lower triangular in blocks.

        Raises:
            ValueError: invalid covariances, or other sizes.
        """
        Q, R = _covariance("Q", self.Q, nx), _covariance("R", self.R, ny)
        S = np.zeros((nx, ny)) if self.S is None else reals("S", self.S)
        if S.shape != (nx, ny) or not np.isfinite(S).all():
            raise InputError(
                f"S has the shape {S.shape}; give ({nx}, {ny}) finite numbers, states by outputs."
            )
        try:
            Gy = np.linalg.cholesky(R)
        except np.linalg.LinAlgError:
            raise InputError(
                "R is not positive definite; give every output some noise of its own."
            ) from None
        across = np.linalg.solve(Gy, S.T).T
        own = _root(Q - across @ across.T, np.abs(Q).max())
        if own is None:
            raise InputError(
                "Q - S R⁻¹ Sᵀ has a negative eigenvalue; this S is not possible with Q and R."
            )
        return np.block([[Gy, np.zeros((ny, nx))], [across, own]])

    def extended(self, more: Float[Array, " m"], nx: int) -> NoiseCovariance:
        """The noise of nx states and of further states with these variances."""
        S = self.S
        if S is not None:
            S = reals("S", S)
            S = np.vstack([S, np.zeros((len(more), *S.shape[1:]))])
        return NoiseCovariance(with_variances("Q", self.Q, more, nx), self.R, S)


@final
class ExtendedKalmanFilter(StateObserver):
    """Extended Kalman filter: the gain follows from the noise and the model's Jacobians.

    ``update`` corrects the states by the output, with ∂y/∂x at the predicted states, and propagates
    them to the next sample, with ∂x+/∂x at the corrected states. Covariances are kept as square
    roots, and never subtracted. A missing output corrects nothing, so the covariance grows.

    Args:
        cell, scaler, inputs, outputs: parts of the model.
        x0: initial states, in the model's coordinates.
        noise: covariances of the noise on states and outputs.
        P0: covariance of the error of x0, its variances, or one number for all states. Default:
            covariance of the states over the training data.

    Shape:
        x0: (nx,), P0: (nx, nx), (nx,) or a number.

    Raises:
        ValueError: a state or a covariance of another size, or an invalid covariance.

    References:
        Anderson and Moore, "Optimal Filtering", 1979, section 8.2.
    """

    def __init__(
        self,
        cell: LFRCell,
        scaler: Scaler,
        inputs: tuple[Channel, ...],
        outputs: tuple[Channel, ...],
        x0: ArrayLike,
        noise: NoiseCovariance,
        P0: ArrayLike | None = None,
        disturbances: int = 0,
    ) -> None:
        super().__init__(cell, scaler, inputs, outputs, x0, disturbances)
        nx, ny = cell.nx, cell.ny
        self._G = noise.root(nx, ny)
        self._G[:ny] /= np.asarray(scaler.y_scale)[:, None]
        if P0 is None:
            self._U = data_root(self._cell)
        else:
            self._U = _covariance_root("P0", P0, nx)
        self._w_hat, self._log_p = np.zeros(nx), 0.0
        self._left: list[Any] = []
        if self._weights is not None:
            w, tail = self._weights, (self._G, self._x_now, self._U)
            self._filter = [*w, *tail]
            self._corrector = [self._u_now, self._y_now, *w, *tail, self._w_hat]
            after: list[Any] = [self._w_hat, self._x_now, self._U]
            self._advancer = [self._u_now, *w], after

    @property
    def covariance(self) -> Float[Array, "n n"]:
        """Covariance of the error of ``state``, then ``disturbance``; it may be set.

        Raises:
            ValueError: a covariance of another size, or an invalid one.
        """
        U = self._U
        if self._corrected:
            M, known = self._left
            U = M[known : known + len(U), known:]
        return U @ U.T

    @covariance.setter
    def covariance(self, P: ArrayLike) -> None:
        self._U[:] = _covariance_root("covariance", P, len(self._U))
        self._predicted = self._corrected = False

    def follow(self, u: Float[Array, "T nu"], y: Float[Array, "T ny"]) -> float:
        """Filter many samples at once, as ``predict`` and ``update`` would one by one.

        Args:
            u, y: inputs and outputs, physical units, NaN for missing outputs.

        Returns:
            The logarithm of the probability density of y, normalised by the scale of the outputs.
        """
        u = np.ascontiguousarray(self._scaler.normalise_u(u), dtype=np.float64)
        y = np.ascontiguousarray(self._scaler.normalise_y(y), dtype=np.float64)
        self._predicted = self._corrected = False
        return self._filtered(u, y)

    def _filtered(self, u: Float[Array, "T nu"], y: Float[Array, "T ny"]) -> float:
        if self._weights is not None:
            return filter_record(u, y, *self._filter)
        total = 0.0
        for u_k, y_k in zip(u, y, strict=True):
            self._u_now[:], self._y_now[:] = u_k, y_k
            self._correct()
            self._go_on()
            total += self._log_p
        return total

    def _correct(self) -> None:
        if self._weights is not None:
            *self._left, self._log_p = correct_sample(*self._corrector)
        else:
            y_hat, _, _, H = self._slopes()
            e = self._y_now - y_hat
            found = correct(e, H, self._G, self._x_now, self._U, self._w_hat)
            *self._left, self._log_p = found

    def _go_on(self) -> None:
        if self._weights is not None:
            before, after = self._advancer
            advance_sample(*before, *self._left, *after)
            return
        _, x_next, F, _ = self._slopes()
        propagate(F, self._left[0], self._left[1], self._U)
        self._x_now[:] = x_next + self._w_hat

    @torch.no_grad()
    def _slopes(self) -> tuple[Array, Array, Array, Array]:
        """Output y, next states x+, F = ∂x+/∂x and H = ∂y/∂x of a map that is not compiled."""
        u, state = torch.as_tensor(self._u_now), torch.as_tensor(self._x_now)
        y, x_next = self._cell(u, state)
        F, H = linearise(self._cell, self._cell.internal(u, state)[0][None, None])
        return y.numpy(), x_next.numpy(), F[0, 0].contiguous().numpy(), H[0, 0].contiguous().numpy()


def data_root(cell: LFRCell) -> Float[Array, "nx nx"]:
    """Return U with U Uᵀ = the covariance of the states over the training data."""
    U = _root(cell.state_covariance.detach().double().cpu().numpy(), np.inf)
    assert U is not None
    return U


def _covariance_root(name: str, given: ArrayLike, size: int) -> Float[Array, "n n"]:
    P = _covariance(name, given, size)
    U = _root(P, np.abs(P).max())
    if U is None:
        raise InputError(f"{name} has a negative eigenvalue; give a covariance of the states.")
    return U


def inside_limits(record: Record) -> Float[Array, "T ny"]:
    """Return the outputs of a record, NaN where they are at its limits or not valid."""
    y = np.where(record.beyond, np.nan, record.y)
    return y if record.valid is None else np.where(record.valid, y, np.nan)


def _covariance(name: str, given: ArrayLike, size: int) -> Float[Array, "n n"]:
    """Return a covariance matrix from a matrix, variances, or one variance."""
    value = reals(name, given)
    if value.ndim < 2 and value.size in (1, size):
        value = np.diag(np.broadcast_to(value, size))
    if value.shape != (size, size):
        raise InputError(
            f"{name} has the shape {value.shape}; give ({size}, {size}), {size} variances, or one."
        )
    rounding = _ROUNDING * np.abs(value).max()
    if not (np.isfinite(value).all() and (np.abs(value - value.T) <= rounding).all()):
        raise InputError(f"{name} is not symmetric, or not finite; give a covariance.")
    return (value + value.T) / 2.0


def with_variances(
    name: str, given: ArrayLike, more: Float[Array, " m"], size: int
) -> Float[Array, "n n"]:
    """Return a covariance of some states and of further states that are independent of them."""
    return scipy.linalg.block_diag(_covariance(name, given, size), np.diag(more))


def _root(P: Float[Array, "n n"], size: float) -> Float[Array, "n n"] | None:
    """Return U with U Uᵀ = P; None if P has a negative eigenvalue, relative to a size."""
    values, vectors = np.linalg.eigh(P)
    if values[0] < -_ROUNDING * size:
        return None
    return np.ascontiguousarray(vectors * np.sqrt(np.maximum(values, 0.0)))
