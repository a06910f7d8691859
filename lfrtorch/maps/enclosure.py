"""Interval bounds of the values and slopes of neurons, for inputs in a box.

Intervals are propagated through the map: over an interval, σ lies between the least and the largest
of its values at the ends and at the extremes inside, and so does σ'. These bounds treat neurons as
independent, and are too wide where large neurons cancel. So the box is cut into cells; the hull of
the bounds of all cells holds in the box. In a cell about c the mean value theorem gives
w ∈ f(c) + J (z - c) for some J within the slopes. These bounds are tighter for smaller cells.

References:
    Moore, Kearfott and Cloud, "Introduction to Interval Analysis", SIAM 2009, chapters 5 and 6.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from torch import Tensor

from lfrtorch._support.threads import to_float64
from lfrtorch._support.types import Array
from lfrtorch.maps.activations import FAR, Activation

_CELLS = 2**12
"""Largest number of cells of a box."""

_ACTIVE = np.linspace(-4.0, 4.0, 17)
"""Values of v at which cells are cut, where neurons bend."""

ROUNDING = 1e-12
"""Widening of intervals, relative to the size of their ends."""


class Interval(NamedTuple):
    """Intervals of numbers, entry by entry."""

    low: Array
    high: Array

    @property
    def middle(self) -> Array:
        """Middle (low + high) / 2."""
        return (self.low + self.high) / 2

    def parts(self) -> Interval:
        """Halves along each axis: 2ⁿ cells of each of the cells (C, n)."""
        n = self.low.shape[1]
        upper = np.array(list(itertools.product((False, True), repeat=n)))[:, None]
        low = np.where(upper, self.middle, self.low).reshape(-1, n)
        return Interval(low, np.where(upper, self.high, self.middle).reshape(-1, n))

    @property
    def radius(self) -> Array:
        """Radius (high - low) / 2."""
        return (self.high - self.low) / 2

    def within(self, other: Interval) -> Interval:
        """Intersection of two intervals."""
        return Interval(np.maximum(self.low, other.low), np.minimum(self.high, other.high))

    def wider(self) -> Interval:
        """Interval widened by more than rounding errors."""
        more = ROUNDING * (np.abs(self.low) + np.abs(self.high))
        return Interval(self.low - more, self.high + more)


class Enclosure(NamedTuple):
    """Interval bounds of a static map over a box.

    Args:
        w: bounds of w (nw,), or of w - K z.
        J: bounds of ∂w/∂z (nw, nz).
        centres: middles of cells of the box, (C, nz).
        neurons: s (nn,), left (nw, nn) and right (nn, nz) of J = left diag(s) right, for a network.
    """

    w: Interval
    J: Interval
    centres: Array
    neurons: tuple[Interval, Tensor, Tensor] | None = None


def everywhere(size: int) -> Interval:
    """Interval of all numbers."""
    return Interval(np.full(size, -FAR), np.full(size, FAR))


class Layer(NamedTuple):
    """The map w = Ww σ(Wz z + bz) + bw."""

    sigma: Activation
    Wz: Tensor
    bz: Tensor
    Ww: Tensor
    bw: Tensor

    def enclosure(
        self, z: Interval, a: Interval | None = None, K: Float[Array, "nw nz"] | None = None
    ) -> Enclosure:
        """Bounds over a box z (nz,), see ``StaticMap.enclosure``."""
        sigma = self.sigma
        Wz, bz, Ww, bw = map(to_float64, self[1:])
        K = np.zeros((len(Ww), Wz.shape[1])) if K is None else K
        cells = _cells(z, Wz, bz)
        inside = _product(Wz, cells)
        if a is not None:
            inside = inside.within(a)
            reached = (inside.low <= inside.high).all(axis=-1)
            cells, inside = (Interval(i.low[reached], i.high[reached]) for i in (cells, inside))
        centres = cells.middle
        v = Interval(inside.low + bz, inside.high + bz)
        slopes = _range(sigma.slopes, sigma.slope_extremes, v)
        J = _jacobians(Wz, Ww, slopes)
        w = _product(Ww, _range(sigma.values, sigma.extremes, v))
        linear = _product(K, cells)
        w = Interval(w.low + bw - linear.high, w.high + bw - linear.low)
        # Bounds by the mean value theorem about the centre of each cell.
        steepest = np.maximum(np.abs(J.low - K), np.abs(J.high - K))
        reach = (steepest @ cells.radius[..., None])[..., 0]
        at = sigma.values(centres @ Wz.T + bz) @ Ww.T + bw - centres @ K.T
        w = w.within(Interval(at - reach, at + reach))
        neurons = _hull(slopes).wider(), self.Ww, self.Wz
        return Enclosure(_hull(w).wider(), _hull(J).wider(), centres, neurons)

    def slopes_in(
        self, v: Interval, into: Float[Array, "nz nz"], middle: Float[Array, " nz"]
    ) -> Interval:
        """Bounds of ∂w/∂v over cells of v (C, nz), see ``StaticMap.slopes_in``."""
        Wz, bz, Ww, _ = map(to_float64, self[1:])
        bz, Wz = bz + Wz @ middle, Wz @ into
        inside = _product(Wz, v)
        inside = Interval(inside.low + bz, inside.high + bz)
        slopes = _range(self.sigma.slopes, self.sigma.slope_extremes, inside)
        return _jacobians(Wz, Ww, slopes).wider()


def _jacobians(Wz: Float[Array, "nn nz"], Ww: Float[Array, "nw nn"], slopes: Interval) -> Interval:
    """Bounds of the Jacobian Ww diag(slopes) Wz, whose entries are sums over the neurons."""
    return _transposed(_product(Ww, _transposed(_scaled(Wz, slopes))))


def _product(M: Float[Array, "m k"], x: Interval) -> Interval:
    """Product M x for x (.., k)."""
    up, down = np.maximum(M, 0.0).T, np.minimum(M, 0.0).T
    return Interval(x.low @ up + x.high @ down, x.high @ up + x.low @ down)


def _scaled(W: Float[Array, "nn nz"], slope: Interval) -> Interval:
    """Rows of W times the slopes (C, nn)."""
    ends = [s[..., None] * W for s in slope]
    return Interval(np.minimum(*ends), np.maximum(*ends))


def _transposed(M: Interval) -> Interval:
    return Interval(M.low.swapaxes(-1, -2), M.high.swapaxes(-1, -2))


def _range(
    function: Callable[[Array], Array], extremes: tuple[float, ...], v: Interval
) -> Interval:
    """Range of a function over intervals: its values at the ends and at the extremes inside."""
    ends = [function(v.low), function(v.high)]
    low, high = np.minimum(*ends), np.maximum(*ends)
    for place in extremes:
        inside = (v.low < place) & (place < v.high)
        value = function(np.asarray(place))
        low = np.where(inside, np.minimum(low, value), low)
        high = np.where(inside, np.maximum(high, value), high)
    return Interval(low, high)


def _hull(each: Interval) -> Interval:
    """Hull of the intervals of all cells."""
    return Interval(each.low.min(axis=0), each.high.max(axis=0))


def _cells(z: Interval, Wz: Float[Array, "nn nz"], bz: Float[Array, " nn"]) -> Interval:
    """Cells (C, nz) that cover a box: half of the cuts are even, half are where neurons bend."""
    nz = len(z.low)
    each = math.floor(_CELLS ** (1.0 / nz) + 1e-9)
    edges = []
    for j, (low, high) in enumerate(zip(*z, strict=True)):
        steep = np.abs(Wz[:, j]) > 1.0 / FAR
        bends = (np.subtract.outer(_ACTIVE, bz[steep]) / Wz[steep, j]).ravel()
        bends = bends[(bends > low) & (bends < high)]
        inner = [np.empty(0)]
        if each > 1 and len(bends):
            inner.append(np.quantile(bends, np.linspace(0.0, 1.0, each // 2)))
        if high - low < FAR:
            inner.append(np.linspace(low, high, each - each // 2 + 1)[1:-1])
        edges.append(np.concatenate([[low], np.unique(np.concatenate(inner)), [high]]))
    low, high = (np.meshgrid(*(e[part] for e in edges)) for part in (slice(-1), slice(1, None)))
    return Interval(*(np.stack([g.ravel() for g in side], axis=-1) for side in (low, high)))
