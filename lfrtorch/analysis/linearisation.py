"""Linear models of a nonlinear one: its linear part, and its linearisation about a point."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from lfrtorch._support.arguments import typed
from lfrtorch._support.checks import reals
from lfrtorch._support.errors import InputError
from lfrtorch._support.tables import quantity
from lfrtorch._support.types import Array, Complex
from lfrtorch.analysis.trim import Trim
from lfrtorch.data.records import Channel
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.held import integrating_states
from lfrtorch.engine.operating_point import double, equilibrium, linearised_at, resting_input
from lfrtorch.linear.model import LinearModel
from lfrtorch.model.model import Model


@typed()
def linearise(
    model: Model, u: ArrayLike | Trim | None = None, *, x: ArrayLike | None = None
) -> LinearModel:
    """The model linearised about an operating point, in physical units.

    Let the input u0 hold the model in the state x0: x0 = f(x0, u0). The deviations obey::

        x+ = A x + B (u - u0) + K e
        y  = C x + D (u - u0) + y0 + e

    to first order: the error is quadratic in the deviations. u0, y0 and x0 are ``u_offset``,
    ``y_offset`` and ``x_offset`` of the result, and K is the gain of a model in innovation form. So
    a state feedback is u = u0 - F (observer.state - x0). ``to_scipy`` and ``to_control`` of the
    result convert it. The equilibrium may be unstable: a controller may stabilise it.

    Args:
        model: nonlinear.
        u: constant input u0, physical units, or the result of ``trim``. Default: the offsets of the
            inputs in the data; for an integrating model, the nearest inputs that hold it at rest.
        x: state x0 in the model's coordinates, as ``model.signals(record).x[0, k]``. If u0 does not
            hold the model there, the deviations are from the trajectory through x0. Default: the
            state at rest, by Newton's method; if there are several, the one that is reached from
            x = 0.

    Shape:
        u: (nu,) or a number for one input, x: (nx,).

    Raises:
        ValueError: no state is at rest under u, or wrong shapes.

    Example:
        >>> local = lfrtorch.analysis.linearise(model, 0.5)
        >>> local.u_offset.tolist(), bool(np.abs(local.poles).max() < 1)
        ([0.5], True)
        >>> system = local.to_scipy()
    """
    scaler = model.scaler
    if isinstance(u, Trim):
        u, x = u.u, u.x if x is None else x
    cell, u0, v, found = about(model, u, x)
    if found is None:
        found = equilibrium(cell, v)
        integrates = found is None and bool(integrating_states(cell).any())
        still = resting_input(cell, v) if integrates else None
        if u is None and still is not None:
            v, found = still, equilibrium(cell, still)
            u0 = scaler.u_offset + scaler.u_scale * still.numpy()
        if found is None:
            raise InputError(_no_rest(model, u0, still))
    with torch.no_grad():
        y0 = scaler.restore_y(cell(v, found)[0].numpy())
    outside, at = model.outside(np.asarray(u0), found.numpy()), linearised_at(cell, v, found)
    known = {"u_offset": np.array(u0), "y_offset": y0, "x_offset": found.numpy()}
    return LinearModel.of(model, at, outside=outside, **known)


def about(
    model: Model, u: ArrayLike | None, x: ArrayLike | None
) -> tuple[LFRCell, Array, Tensor, Tensor | None]:
    """Return the cell, the input u0 (given, or the offsets), the same normalised, and a given x."""
    cell, s = double(model.lfr.cell), model.scaler
    u0 = s.u_offset if u is None else vector("u", u, cell.nu, "the model has {} input(s)")
    given = None if x is None else vector("x", x, cell.nx, "the model has {} states")
    v = torch.as_tensor((u0 - s.u_offset) / s.u_scale)
    return cell, u0, v, None if given is None else torch.as_tensor(given)


def linear_part(model: Model) -> LinearModel:
    """A, Bu, Cy and Dyu of a model, in physical units: the model without its static map."""
    return LinearModel.of(model, K=None)


def poles_at_rest(model: Model) -> Complex:
    """Poles (nx,) of the model linearised at rest at the inputs' offsets, or at x = 0."""
    cell = double(model.lfr.cell)
    u = cell.A.new_zeros(cell.nu)
    x = equilibrium(cell, u)
    at = linearised_at(cell, u, u.new_zeros(cell.nx) if x is None else x)
    return np.asarray(np.linalg.eigvals(at.A), complex)


def vector(name: str, given: ArrayLike, size: int, expected: str) -> Array:
    """The numbers of an argument; refuse another shape and numbers that are not finite."""
    found = np.atleast_1d(reals(name, given))
    if found.shape != (size,) or not np.isfinite(found).all():
        raise InputError(
            f"{name} is {given!r}; {expected.format(size)}: give as many finite numbers."
        )
    return found


def _no_rest(model: Model, u0: Array, still: Tensor | None) -> str:
    scaler, inputs = model.scaler, model.inputs
    missing = f"no state at rest was found under {levels_of(inputs, u0, ' = ')}"
    if still is None:
        offsets = levels_of(inputs, scaler.u_offset, " = ")
        near = f"; the offsets are {offsets}.\nGive an input nearer to these"
    else:
        at = levels_of(inputs, scaler.u_offset + scaler.u_scale * still.numpy(), " = ")
        near = f": the model integrates.\nGive no input to linearise at rest, at {at}"
    return f"{missing}{near}, or a state: linearise(model, u, x=...)."


def levels_of(channels: tuple[Channel, ...], values: Array, sign: str = " ") -> str:
    """Values with the names and units of their channels."""
    pairs = zip(channels, values, strict=True)
    return ", ".join(f"{c.name}{sign}{quantity(float(v), c.unit)}" for c, v in pairs)
