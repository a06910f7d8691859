"""Online observers, which estimate the states of a running system, sample by sample."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from copy import deepcopy
from typing import Any, final

import numpy as np
import torch
from jaxtyping import Float
from numba import njit
from numpy.typing import ArrayLike
from torch import Tensor

from lfrtorch._support.checks import reals
from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array
from lfrtorch.data.records import Channel, Scaler
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.simulation_kernel import simulate_records


class StateObserver(ABC):
    """Observer of the states of a running system: call ``predict``, measure, then call ``update``.

    A controller that measures y before it chooses u calls ``correct(y)``, which updates the states
    by this output, and then ``advance(u)``. ``update`` does both with the input of ``predict``.

    An observer computes in float64, and in machine code for the static maps of the package.
    ``Model.observer`` makes an observer with a constant gain K, or an extended Kalman filter.

    Args:
        cell, scaler, inputs, outputs: parts of the model.
        x0: initial states, in the model's coordinates.
        disturbances: number of disturbances in physical units, which are the last states.

    Shape:
        x0: (nx,).

    Raises:
        ValueError: a state of another size.
    """

    def __init__(
        self,
        cell: LFRCell,
        scaler: Scaler,
        inputs: tuple[Channel, ...],
        outputs: tuple[Channel, ...],
        x0: ArrayLike,
        disturbances: int = 0,
    ) -> None:
        cell = deepcopy(cell).double().cpu()
        self._own = cell.nx - disturbances
        self._cell, self._scaler, self._inputs, self._outputs = cell, scaler, inputs, outputs
        self._u, self._x = np.zeros((1, 1, cell.nu)), np.zeros((1, 2, cell.nx))
        z, w, self._y = (np.zeros((1, 1, size)) for size in (cell.nz, cell.nw, cell.ny))
        numbers = cell.weights()
        self._weights = numbers.arguments if numbers.layout.compiled else None
        self._call: list[Any] | None = None
        if self._weights is not None:
            self._call = [0, 1, 1, *self._weights, self._u, -1.0, self._x, z, w, self._y]
        self._predicted, self._corrected = False, False
        fed_back = bool(cell.Dyw.any()) and bool(cell.Dzu.any())
        self._feedthrough = bool(cell.Dyu.any()) or fed_back
        # Views are made once, as making a view takes longer than a product of small matrices.
        self._u_now, self._y_hat = self._u[0, 0], self._y[0, 0]
        self._y_now, self._e, self._zero = np.zeros((3, cell.ny))
        at = scaler.u_offset, scaler.u_scale, scaler.y_offset, scaler.y_scale
        floats = (np.ascontiguousarray(values, dtype=np.float64) for values in at)
        self._u_offset, self._u_scale, self._y_offset, self._y_scale = floats
        self._x_now, self._x_next = self._x[0]
        x = reals("x0", x0)
        if x.shape != (cell.nx,) or not np.isfinite(x).all():
            raise InputError(f"x0 has the shape {x.shape}; give {cell.nx} finite numbers.")
        self._x_now[:] = x

    @property
    def state(self) -> Float[Array, " nx"]:
        """States in the model's coordinates; they may be set, for example when the plant changes.

        They are predictions for the next sample. After ``correct`` they are estimates that include
        the output of this sample.

        Raises:
            ValueError: a wrong number of states, or states that are not finite.
        """
        return self._x_now[: self._own].copy()

    @state.setter
    def state(self, x: ArrayLike) -> None:
        self._set(slice(0, self._own), "state", x)

    @property
    def disturbance(self) -> Float[Array, " nd"]:
        """Disturbances in physical units; they may be set. None without a disturbance model.

        Raises:
            ValueError: a wrong number of disturbances, or disturbances that are not finite.
        """
        return self._x_now[self._own :].copy()

    @disturbance.setter
    def disturbance(self, d: ArrayLike) -> None:
        self._set(slice(self._own, None), "disturbance", d)

    def predict(self, u: ArrayLike) -> Float[Array, " ny"]:
        """Output at this sample, from its input and all samples before it; physical units.

        It may be called several times, for several inputs; only the last call counts.

        Args:
            u: the present input, (nu,) or a number.

        Raises:
            ValueError: a wrong number of inputs, an input that is not finite, or a call after this
                sample was corrected.
        """
        if self._corrected:
            raise InputError("this sample was corrected: call advance(u) before predict.")
        self._take(u)
        self._step()
        self._predicted = True
        return _restored(self._y_hat, self._y_offset, self._y_scale)

    def update(self, y: ArrayLike | None) -> Float[Array, " ny"]:
        """Update the states by y, go on to the next sample, and return the error y - y_hat.

        Args:
            y: measured output, (ny,) or a number, with NaN for a missing one; None if all are
                missing. The error of a missing output is NaN, and changes no state.

        Raises:
            ValueError: a wrong number of outputs, an infinite output, or no call of ``predict``.
        """
        if not self._predicted:
            raise InputError("nothing was predicted at this sample: call predict(u) before.")
        e = self._corrected_by(y)
        self._go_on()
        self._predicted = self._corrected = False
        return e

    def correct(self, y: ArrayLike | None, u: ArrayLike | None = None) -> Float[Array, " ny"]:
        """Correct the states by the output of this sample, and return y - y_hat.

        ``advance`` then goes on to the next sample. If the gain K is constant, the present states
        do not change: the innovation only changes the next states.

        Args:
            y: as in ``update``.
            u: the input at this sample, which only a model with feedthrough needs.

        Raises:
            ValueError: as in ``update``; no u for a model with feedthrough; or this sample was
                already corrected.

        Example:
            >>> observer = model.observer(noise=lfrtorch.NoiseCovariance(Q=1e-4, R=1e-2))
            >>> e = observer.correct(0.3, u=0.5)
            >>> filtered = observer.state
            >>> observer.advance(0.5)
        """
        if self._corrected:
            raise InputError("this sample was corrected: call advance(u) before the next one.")
        if u is None and self._feedthrough:
            raise InputError(
                "the output of this model depends on its input at the same sample: give "
                "correct(y, u), or fit it with feedthrough=false."
            )
        self._take(self._u_offset if u is None else u)
        self._step()
        return self._corrected_by(y)

    def advance(self, u: ArrayLike) -> None:
        """Go on to the next sample with the input of this one, (nu,) or a number.

        If the sample was not corrected, all its outputs count as missing.

        Raises:
            ValueError: a wrong number of inputs, or an input that is not finite.
        """
        self._take(u)
        if not self._corrected:
            self._corrected_by(None)
        self._step()
        self._go_on()
        self._predicted = self._corrected = False

    def _set(self, part: slice, name: str, given: ArrayLike) -> None:
        x = np.atleast_1d(reals(name, given))
        if x.shape != self._x_now[part].shape or not np.isfinite(x).all():
            size = len(self._x_now[part])
            raise InputError(f"{name} has the shape {x.shape}; give {size} finite numbers.")
        self._x_now[part] = x
        self._predicted = self._corrected = False

    def _take(self, u: ArrayLike) -> None:
        given = _sample(u, self._inputs, "u")
        if not _normalise(given, self._u_offset, self._u_scale, self._u_now):
            raise InputError(f"u is {given}; give finite numbers.")

    def _step(self) -> None:
        """Compute the output and the next states without noise."""
        if self._call is not None:
            self._x_next.fill(np.nan)  # so that the simulation does not stop at old states
            simulate_records(*self._call)
        else:
            with torch.no_grad():
                y, x = self._cell(torch.as_tensor(self._u[0]), torch.as_tensor(self._x[0, :1]))
            self._y_hat[:], self._x_next[:] = y[0].numpy(), x[0].numpy()

    def _corrected_by(self, y: ArrayLike | None) -> Float[Array, " ny"]:
        given = np.full(len(self._outputs), np.nan) if y is None else _sample(y, self._outputs, "y")
        if not _innovation(given, self._y_offset, self._y_scale, self._y_hat, self._y_now, self._e):
            raise InputError(f"y is {given}; give finite numbers, or NaN for a missing output.")
        self._correct()
        self._corrected = True
        return _restored(self._e, self._zero, self._y_scale)

    @abstractmethod
    def _correct(self) -> None:
        """Correct the states by the normalised y and e = y - y_hat."""

    @abstractmethod
    def _go_on(self) -> None:
        """Replace the states by those of the next sample."""


@final
class SteadyGainObserver(StateObserver):
    """The predictor of the innovation form: x+ = f(x, u) + K e.

    Args:
        cell, scaler, inputs, outputs: parts of the model.
        x0: initial states, in the model's coordinates.
        K: innovation gain, normalised.

    Shape:
        x0: (nx,), K: (nx, ny).

    Example:
        >>> linear = lfrtorch.estimate_bla(record, nx=1, refine="prediction")
        >>> started = lfrtorch.initialise(linear, record, nz=1, nw=1, nn=4)
        >>> observer = started.observer(after=record[:100])
        >>> y_hat = observer.predict(record.u[100])
        >>> e = observer.update(record.y[100])
    """

    def __init__(
        self,
        cell: LFRCell,
        scaler: Scaler,
        inputs: tuple[Channel, ...],
        outputs: tuple[Channel, ...],
        x0: ArrayLike,
        K: Tensor,
    ) -> None:
        super().__init__(cell, scaler, inputs, outputs, x0)
        self._K = K.double().cpu().numpy()

    def _correct(self) -> None:
        """Leave the states unchanged."""

    def _go_on(self) -> None:
        e = self._e
        missing = any(map(math.isnan, e.tolist()))
        np.matmul(self._K, np.nan_to_num(e) if missing else e, out=self._x_now)
        np.add(self._x_now, self._x_next, out=self._x_now)


def _sample(values: ArrayLike, channels: tuple[Channel, ...], name: str) -> Array:
    """Return one sample of some channels."""
    found = np.array(values, np.float64, ndmin=1)
    if found.size != len(channels) or found.ndim > 1:
        names = ", ".join(channel.name for channel in channels)
        raise InputError(f"{name} has the shape {found.shape}; give a number for each of {names}.")
    return found


# A call of NumPy takes as long as a step of a small model.
@njit(cache=True, nogil=True, error_model="numpy")
def _normalise(given, offset, scale, out):
    """Write (given - offset) / scale into out; return True if all given values are finite."""
    finite = True
    for i in range(len(out)):
        finite = finite and math.isfinite(given[i])
        out[i] = (given[i] - offset[i]) / scale[i]
    return finite


@njit(cache=True, nogil=True, error_model="numpy")
def _innovation(given, offset, scale, predicted, out, e):
    """Write the same and e = out - predicted; return False if a value is infinite."""
    _normalise(given, offset, scale, out)
    known = True
    for i in range(len(out)):
        known = known and not math.isinf(given[i])
        e[i] = out[i] - predicted[i]
    return known


@njit(cache=True, nogil=True, error_model="numpy")
def _restored(normalised, offset, scale):
    """Physical values from normalised values."""
    found = np.empty(len(scale))
    for i in range(len(scale)):
        found[i] = offset[i] + scale[i] * normalised[i]
    return found
