"""Changes within a record: of the gain from inputs to an output, and of the output's delay.

A linear model of the first third of the record is simulated over all of it. The simulation is
scaled to fit the output up to each sample k, and after k with a second gain, also shifted by one
sample. The gain changes at k, or a sample is lost there, if this explains both parts, and the
second part far better than without the change. A model of the last third must find the same in
reverse time.

A nonlinear system has another gain at another level, so a gain counts only if the inputs have
the same levels in both parts.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy

from lfrtorch._support.types import Array

# A model of a third of the record has PAST outputs and up to LAGS inputs, at most one for each
# SHARE samples. It is fitted to LEAST to MOST samples.
_PAST, _LAGS, _SHARE, _LEAST, _MOST = 10, 100, 10, 100, 20_000
_RIDGE = 1e-10  # added to the power 1 of a regressor: the past may tell the present

# A change leaves at most LEFT of the variance of each part unexplained, and in the second part at
# most CLEAR of what is left without the change. Either part has more than EDGE of the record, as
# the simulation may miss its start.
_LEFT, _CLEAR, _EDGE = 0.1, 0.3, 0.1
_NEAR = 0.02  # largest difference of the samples that the two models find, over all samples
_RATIO = 1.5  # smallest ratio of two gains that counts as a change
_LEVELS, _ALIKE = (0.05, 0.5, 0.95), 0.5  # quantiles of an input; their largest change, over rms


class Change(NamedTuple):
    """Sample of a change, the gain after it over the gain before, and the shift after it."""

    sample: int
    ratio: float
    shift: int  # 1 if the output lost a sample, -1 if the inputs did


def change(u: Array, y: Array) -> Change | None:
    """Return the change between inputs (T, nu) and an output (T,), if there is a clear one."""
    T, third, u = len(y), len(y) // 3, u[:, np.ptp(u, axis=0) > 0]
    if third < _LEAST or np.ptp(y) == 0 or not u.size:
        return None
    u, y = u / u.std(axis=0), y / y.std()
    parts = slice(third), slice(T - third, T)
    x, z = (_simulated(u, y, part) for part in parts)
    if x is None or z is None or (found := _change(u, x, y)) is None:
        return None
    other = _change(u[::-1], z[::-1], y[::-1])
    agree = (
        other is not None
        and other.shift == found.shift
        and abs(T - other.sample - found.sample) < _NEAR * T
    )
    return found if agree else None


def _change(u: Array, x: Array, y: Array) -> Change | None:
    """Return the change of an output (T,), whose response to the inputs is x (T,) at first."""
    edge = int(_EDGE * len(y))
    before, same = _fits(x, y), _fits(x[::-1], y[::-1])[:, ::-1]
    best, found = np.inf, None
    for shift in (0, 1, -1):
        after = _fits(np.roll(x, -shift)[::-1], y[::-1])[:, ::-1] if shift else same
        k = edge + int(np.argmin((before[0, :-1] + after[0, 1:])[edge:-edge]))
        (left, all_, gain, _), (rest, others, scaled, power) = before[:, k], after[:, k + 1]
        if gain * scaled <= 0 or left > _LEFT * all_ or rest > _LEFT * others or left + rest > best:
            continue
        ratio = scaled / gain
        if shift:
            clear = rest < _CLEAR * same[0, k + 1]
        else:
            clear = rest < _CLEAR * (rest + (scaled - gain) ** 2 * power)
            clear &= max(ratio, 1 / ratio) > _RATIO and _same_levels(u[: k + 1], u[k + 1 :])
        best, found = left + rest, Change(k + 1, float(ratio), shift) if clear else None
    return found


def _simulated(u: Array, y: Array, part: slice) -> Array | None:
    """Response (T,) to inputs (T, nu) of a linear model of one part; None if it is unstable."""
    v, x = u[part][:_MOST], y[part][:_MOST]
    mean, level = v.mean(axis=0), x.mean()
    lags = min(_LAGS, max(1, len(x) // (_SHARE * u.shape[1])))
    n = max(lags, _PAST)
    past = [(x - level)[n - i : len(x) - i] for i in range(1, _PAST + 1)]
    inputs = [(v - mean)[n - i : len(x) - i].T for i in range(lags)]
    columns = np.vstack([*past, *inputs]).T
    products = columns.T @ columns
    ridge = _RIDGE * len(x) * np.eye(len(products))
    theta = np.linalg.solve(products + ridge, columns.T @ (x[n:] - level))
    a, taps = np.r_[1.0, -theta[:_PAST]], theta[_PAST:].reshape(lags, -1)
    if np.abs(np.roots(a)).max() >= 1:
        return None
    each = zip(taps.T, (u - mean).T, strict=True)
    return np.sum([scipy.signal.lfilter(b, a, signal) for b, signal in each], axis=0)


def _fits(x: Array, y: Array) -> Array:
    """Fit g x + c to the first samples of y (T,): squares left, squares of y, g, squares of x."""
    n, x, y = np.arange(1, len(x) + 1), x - x.mean(), y - y.mean()
    xx, xy, yy = (
        np.cumsum(p * q) - np.cumsum(p) * np.cumsum(q) / n for p, q in ((x, x), (x, y), (y, y))
    )
    gain = xy / np.maximum(xx, 1e-12 * max(xx[-1], 1e-300))
    return np.stack([np.maximum(yy - gain * xy, 0.0), yy, gain, xx])


def _same_levels(u: Array, v: Array) -> bool:
    """Tell whether inputs (n, nu) and (m, nu) have the same levels."""
    before, after = (np.quantile(s, _LEVELS, axis=0) for s in (u, v))
    return bool(np.all(np.abs(before - after) < _ALIKE * np.std(np.vstack([u, v]), axis=0)))
