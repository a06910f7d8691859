"""States online: predictions of a model in innovation form, one sample after another."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import ArrayLike
from torch import Tensor

from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.simulation import is_compiled, kernel_arguments
from lfrtorch.engine.simulation_kernel import simulate_record
from lfrtorch.records import Channel, Scaler


class StateObserver:
    """Follows the states of a running system: ``predict`` the output, then ``update`` by it.

    It works in float64, in machine code if the static map is the package's own. ``Model.observer``
    makes it.

    Args:
        cell, scaler, inputs, outputs: of the model.
        K: innovation gain, normalised.
        x0: where the states begin, in the model's coordinates.

    Shape:
        K: (nx, ny), x0: (nx,).

    Raises:
        ValueError: a state of another size.

    Example:
        >>> linear = lfrtorch.estimate_bla(record, nx=1, refine="prediction")
        >>> started = lfrtorch.initialise(linear, record, nz=1, nw=1, nn=4)
        >>> observer = started.observer(after=record[:100])
        >>> y_hat = observer.predict(record.u[100])
        >>> e = observer.update(record.y[100])
        >>> np.allclose(y_hat + e, record.y[100])
        True
    """

    def __init__(
        self,
        cell: LFRCell,
        K: Tensor,
        scaler: Scaler,
        inputs: tuple[Channel, ...],
        outputs: tuple[Channel, ...],
        x0: ArrayLike,
    ) -> None:
        cell = deepcopy(cell).double().cpu()
        self._cell, self._scaler, self._inputs, self._outputs = cell, scaler, inputs, outputs
        self._K = K.double().cpu().numpy()
        self._u, self._x = np.zeros((1, 1, cell.nu)), np.zeros((1, 2, cell.nx))
        z, w, self._y = (np.zeros((1, 1, size)) for size in (cell.nz, cell.nw, cell.ny))
        self._call: list[Any] | None = None
        if is_compiled(cell, cell.A.detach()):
            weights = kernel_arguments(cell)
            self._call = [0, self._u, *weights, 0.0, self._x, z, w, self._y]
        self._predicted = False
        x = np.asarray(x0, dtype=np.float64)
        if x.shape != (cell.nx,) or not np.isfinite(x).all():
            raise InputError(f"x0 has the shape {x.shape}; give {cell.nx} finite numbers.")
        self._x[0, 0] = x

    @property
    def state(self) -> Float[Array, " nx"]:
        """The states at the next sample to be predicted, in the model's coordinates."""
        return self._x[0, 0].copy()

    def predict(self, u: ArrayLike) -> Float[Array, " ny"]:
        """The output at this sample, from its input and all samples before it; physical units.

        It may be called several times, for several inputs; the last one counts.

        Args:
            u: the input now, (nu,) or a number.

        Raises:
            ValueError: another number of inputs, or one that is not finite.
        """
        scaler = self._scaler
        self._u[0, 0] = (_sample(u, self._inputs, "u") - scaler.u_offset) / scaler.u_scale
        if self._call is not None:
            self._x[0, 1] = np.nan  # no trajectory that this one could meet
            simulate_record(*self._call)
        else:
            with torch.no_grad():
                y, x = self._cell(torch.as_tensor(self._u[0]), torch.as_tensor(self._x[0, :1]))
            self._y[0, 0], self._x[0, 1] = y[0].numpy(), x[0].numpy()
        self._predicted = True
        return scaler.y_offset + scaler.y_scale * self._y[0, 0]

    def update(self, y: ArrayLike | None) -> Float[Array, " ny"]:
        """Go on to the next sample; returns the error of the prediction, y - y_hat.

        Args:
            y: the output that was measured, (ny,) or a number; None if it is missing: the states
                then go on as the model has them, and the error is NaN.

        Raises:
            ValueError: another number of outputs, one that is not finite, or nothing was predicted.
        """
        if not self._predicted:
            raise InputError("nothing was predicted at this sample: call predict(u) before.")
        scaler, x = self._scaler, self._x
        if y is None:
            e = np.full(len(scaler.y_scale), np.nan)
            x[0, 0] = x[0, 1]
        else:
            measured = (_sample(y, self._outputs, "y") - scaler.y_offset) / scaler.y_scale
            e = measured - self._y[0, 0]
            x[0, 0] = x[0, 1] + self._K @ e
        self._predicted = False
        return scaler.y_scale * e


def _sample(values: ArrayLike, channels: tuple[Channel, ...], name: str) -> Array:
    """One sample of some channels."""
    found = np.asarray(values, dtype=np.float64)
    if found.size != len(channels) or found.ndim > 1:
        names = ", ".join(channel.name for channel in channels)
        raise InputError(f"{name} has the shape {found.shape}; give a number for each of {names}.")
    if not np.isfinite(found).all():
        raise InputError(f"{name} is {found}; give finite numbers (None for a missing output).")
    return found
