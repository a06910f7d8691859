"""Proven bounds of states and outputs for all inputs of an amplitude."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from torch.nn import Module

from lfrtorch._support.arguments import typed
from lfrtorch._support.checks import reals
from lfrtorch._support.errors import InputError
from lfrtorch._support.tables import engineering, number, table
from lfrtorch._support.types import Array
from lfrtorch.analysis.linearisation import levels_of, vector
from lfrtorch.analysis.reach import reach
from lfrtorch.engine.beyond_linear import Beyond, folded
from lfrtorch.engine.operating_point import double
from lfrtorch.engine.static_enclosure import Interval
from lfrtorch.model import Model
from lfrtorch.records import Channel


@dataclass(frozen=True, eq=False)
class Bound:
    """Proven bounds, up to rounding errors; ``print(bound)`` shows those of the outputs.

    Args:
        amplitude: of the inputs, (nu,), physical units: |u - offset| is at most so.
        y: lowest and highest value of each output, (ny, 2), physical units.
        x, z, w: the same of states and of the static map's signals, in the model's coordinates,
            as in ``model.signals(record)``.
        inputs, outputs: channel names and units.

    Example:
        >>> bound = lfrtorch.analysis.bound(model, 2.0)
        >>> low, high = bound.y[0]
        >>> u = np.random.default_rng(1).uniform(-2.0, 2.0, 1000)
        >>> bool(low <= model.simulate(u).min() and model.simulate(u).max() <= high)
        True
    """

    amplitude: Array
    y: Float[Array, "ny 2"]
    x: Float[Array, "nx 2"]
    z: Float[Array, "nz 2"]
    w: Float[Array, "nw 2"]
    inputs: tuple[Channel, ...]
    outputs: tuple[Channel, ...]

    def __str__(self) -> str:
        rows = []
        for channel, sides in zip(self.outputs, self.y, strict=True):
            factor, unit = engineering(sides.tolist(), channel.unit)
            rows.append([channel.name, *(number(factor * side) for side in sides), unit])
        return (
            f"Inputs within {levels_of(self.inputs, self.amplitude)} of their offsets\n\n"
            + table(["output", "at least", "at most", "unit"], rows)
        )


@typed()
def bound(model: Model, amplitude: ArrayLike, *, x0: ArrayLike | None = None) -> Bound:
    """What the states and outputs of a model stay within, whatever the input of an amplitude.

    It is reached by the worst input of a linear model, and may be far from that of a nonlinear one.
    The mathematics are in ``lfrtorch/analysis/reach.py``.

    Args:
        model: with a stable A, and a network of tanh, sigmoid or rbf; or linear.
        amplitude: largest |u - offset|, physical units; the offsets are those of the model.
        x0: initial state in the model's coordinates. Default: 0.

    Shape:
        amplitude: (nu,) or a number for all inputs, x0: (nx,).

    Raises:
        ValueError: A is not stable, or the static map not bounded: the bound would be infinite.

    Example:
        >>> bound = lfrtorch.analysis.bound(model, amplitude=0.5)
        >>> bound.y.shape, bound.x.shape
        ((1, 2), (1, 2))
        >>> louder = lfrtorch.analysis.bound(model, amplitude=1.0)
        >>> bool((louder.y[:, 1] > bound.y[:, 1]).all())
        True
    """
    cell, scaler = double(model.lfr.cell), model.scaler
    size = amplitudes(amplitude, len(model.inputs))
    start = (
        np.zeros(cell.nx) if x0 is None else vector("x0", x0, cell.nx, "the model has {} states")
    )
    reached = reach(folded(cell), size / scaler.u_scale, start)
    y = np.stack([scaler.restore_y(side) for side in reached.y], axis=-1)
    signals = reached.x, *_unfolded(cell.static, reached.z, reached.w)
    x, z, w = (np.stack(signal, axis=-1) for signal in signals)
    return Bound(size, y, x, z, w, model.inputs, model.outputs)


def _unfolded(static: Module | None, z: Interval, w: Interval) -> tuple[Interval, Interval]:
    """Bounds of z and w of a map from those of the f in it, see ``Beyond``."""
    if not isinstance(static, Beyond):
        return z, w
    z, w = _unfolded(static.base, z, w)
    L, Z, W = (M.double().cpu().numpy() for M in (static.slope, static.into, static.out))
    less = _mapped(-W @ L, z)
    w = _mapped(W, w)
    return _mapped(np.linalg.inv(Z), z), Interval(w.low + less.low, w.high + less.high)


def _mapped(M: Array, v: Interval) -> Interval:
    """Bounds of M v."""
    middle, radius = M @ v.middle, np.abs(M) @ v.radius
    return Interval(middle - radius, middle + radius).wider()


def amplitudes(given: ArrayLike, nu: int) -> Array:
    """An amplitude for each input."""
    found = np.atleast_1d(reals("amplitude", given))
    if found.shape not in ((1,), (nu,)) or not (np.isfinite(found) & (found >= 0)).all():
        raise InputError(
            f"amplitude is {given!r}; the model has {nu} input(s): give one finite number for all, "
            "or one for each, in physical units and not negative."
        )
    return np.broadcast_to(found, nu).copy()
