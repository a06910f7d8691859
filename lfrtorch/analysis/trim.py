"""Where a model can rest with given inputs and outputs: the target of a controller."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
import torch
from jaxtyping import Float
from numpy.typing import ArrayLike

from lfrtorch._support.arguments import typed
from lfrtorch._support.checks import reals
from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.operating_point import double, equilibrium, linearised_at, resting_near
from lfrtorch.model.model import Model

_REST = 1e3  # weight of x = f(x, u) beside the outputs in a first solution; Newton then solves it

_UNIT = 1e-6
"""Weight of the distance to the inputs' offsets, which selects one of several solutions."""


@dataclass(frozen=True, eq=False)
class Trim:
    """A state and an input at rest.

    Args:
        x: state in the model's coordinates.
        u, y: input and output, physical units.
        residual: y minus the wanted output; 0 for outputs that were free.
        outside: parts of this point that the data of the fit did not reach, in words; or empty.

    Example:
        >>> found = lfrtorch.analysis.trim(model, u=0.5)
        >>> found.x.shape, found.u.tolist()
        ((1,), [0.5])
    """

    x: Float[Array, " nx"]
    u: Float[Array, " nu"]
    y: Float[Array, " ny"]
    residual: Float[Array, " ny"]
    outside: str = ""


@typed()
def trim(
    model: Model,
    *,
    y: ArrayLike | None = None,
    u: ArrayLike | None = None,
    bounds: tuple[ArrayLike, ArrayLike] | None = None,
) -> Trim:
    """Find the state and the input at which a model rests with given outputs and inputs.

    The solution is by least squares: if no rest has the given outputs, it is the rest whose
    outputs, over their scales, are nearest to them, and ``residual`` holds the differences. If
    several inputs do as well, it is the one nearest to the data's offsets. Integrators rest, too.

    Args:
        y: outputs, physical units; NaN for free outputs. Default: all are free.
        u: inputs, likewise. Default: all are free.
        bounds: the smallest and the largest input, physical units; infinite or NaN for no bound.

    Shape:
        y: (ny,) or a number for one output, u and both bounds: (nu,) or a number.

    Raises:
        ValueError: wrong shapes, a lower bound above the upper one, a given input outside of the
            bounds, or no rest that was found.

    Example:
        >>> found = lfrtorch.analysis.trim(model, y=0.2)
        >>> bool(abs(found.y[0] - 0.2) < 1e-6), bool(np.abs(found.residual).max() < 1e-6)
        (True, True)
        >>> local = lfrtorch.analysis.linearise(model, found)
    """
    cell, s = double(model.lfr.cell), model.scaler
    nx, nu, ny = cell.nx, cell.nu, cell.ny
    wanted = (_numbers("y", np.full(ny, np.nan) if y is None else y, ny) - s.y_offset) / s.y_scale
    given = (_numbers("u", np.full(nu, np.nan) if u is None else u, nu) - s.u_offset) / s.u_scale
    low, high = _bounds(bounds, s.u_offset, s.u_scale)
    asked, free = np.isfinite(wanted), ~np.isfinite(given)
    if (given[~free] < low[~free]).any() or (given[~free] > high[~free]).any():
        raise InputError(f"u is {u!r}, outside of the bounds {bounds!r}; give it inside of them.")

    def inputs(v: Array) -> torch.Tensor:
        whole = given.copy()
        whole[free] = v
        return torch.as_tensor(whole)

    def errors(values: Array) -> Array:
        x, v = torch.as_tensor(values[:nx]), values[nx:]
        with torch.no_grad():
            y_hat, x_next = cell(inputs(v), x)
        gap = _REST * (x_next - x).numpy()
        return np.concatenate([gap, (y_hat.numpy() - wanted)[asked], _UNIT * v])

    def slopes(values: Array) -> Array:
        at = linearised_at(cell, inputs(values[nx:]), torch.as_tensor(values[:nx]))
        return np.block([
            [_REST * (at.A - np.eye(nx)), _REST * at.B[:, free]],
            [at.C[asked], at.D[asked][:, free]],
            [np.zeros((free.sum(), nx)), _UNIT * np.eye(free.sum())],
        ])  # fmt: skip

    v = np.clip(0.0, low[free], high[free])
    rest = equilibrium(cell, inputs(v))
    begin = np.concatenate([np.zeros(nx) if rest is None else rest.numpy(), v])
    limits = [np.full(nx, -np.inf), np.full(nx, np.inf)]
    found = scipy.optimize.least_squares(
        errors, begin, slopes, x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-14,
        bounds=[np.append(x, own) for x, own in zip(limits, (low[free], high[free]), strict=True)],
    ).x  # fmt: skip
    v = inputs(np.clip(found[nx:], low[free], high[free]))
    x = resting_near(cell, v, torch.as_tensor(found[:nx]))
    if x is None:
        raise InputError(
            "no rest was found with these inputs and outputs; give values nearer to the data, or "
            "leave more of them free (NaN)."
        )
    return _trim(model, cell, x, v, wanted, asked)


def _trim(
    model: Model, cell: LFRCell, x: torch.Tensor, v: torch.Tensor, wanted: Array, asked: Array
) -> Trim:
    s = model.scaler
    with torch.no_grad():
        y = cell(v, x)[0].numpy()
    residual = np.where(asked, s.y_scale * (y - wanted), 0.0)
    u = s.u_offset + s.u_scale * v.numpy()
    return Trim(x.numpy(), u, s.restore_y(y), residual, model.outside(u, x.numpy()))


def _numbers(name: str, given: ArrayLike, size: int) -> Array:
    found = np.atleast_1d(reals(name, given))
    if found.shape != (size,) or np.isinf(found).any():
        raise InputError(
            f"{name} is {given!r}; give {size} number(s), NaN for those that are free."
        )
    return found


def _bounds(
    given: tuple[ArrayLike, ArrayLike] | None, offset: Array, scale: Array
) -> tuple[Array, Array]:
    """Return the smallest and the largest input, normalised."""
    found = []
    for side, none in zip((None, None) if given is None else given, (-np.inf, np.inf), strict=True):
        value = reals("bounds", none if side is None else side)
        if value.shape not in ((), (1,), offset.shape):
            raise InputError(f"bounds is {given!r}; give two bounds of {len(offset)} number(s).")
        value = np.broadcast_to(value, offset.shape)
        found.append((np.where(np.isnan(value), none, value) - offset) / scale)
    if not (found[0] < found[1]).all():
        raise InputError(f"bounds is {given!r}; give the smallest input, then the largest.")
    return found[0], found[1]
