"""Outliers: one or two samples that stick out of a signal as nothing else in it does.

The height of a sample is what opening and closing by three samples remove (white and black
top-hat): nothing at a step, in a drift or in a smooth signal, and the whole height of a lone
sample. Outliers are higher than the tail of these heights promises, a Weibull tail

    P(height > h) = exp(-(h / b)ᶜ),

or are separated from all others by a gap. They also lie beyond the range of all other samples, or
are higher than the jumps between these. So neither a pulse among pulses nor the peak of a random
signal is an outlier.

References:
    Serra (1982), Image Analysis and Mathematical Morphology, Academic Press: the top-hat.
    Coles (2001), An Introduction to Statistical Modeling of Extreme Values, Springer: the tails.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import black_tophat, maximum_filter1d, white_tophat

from lfrtorch._support.types import Array, Integers

_SHORTEST, _LEVELS = 100, 16  # samples of the shortest record; values of a signal of levels
_MOST, _FEW = 0.02, 3  # largest share of outliers, or number in a short record: more are by design

# Quantiles of the heights that fix the tail: the lightest of the tails from one of BODY to TAIL;
# and the probability that the largest height of a record exceeds what the tail promises.
_TAIL, _BODY, _CHANCE = 0.97, (0.5, 0.8), 0.01
_GAP = 3.0  # heights that are this many times the next lower one do not belong to the tail

# Outliers are farther from all other samples than BEYOND of these samples' range, or higher than
# ABOVE times the largest jump of these. They are also higher than STEPS steps of the converter.
_BEYOND, _ABOVE, _STEPS = 0.2, 1.5, 5.0
_END = 1.0  # in place of BEYOND for the first and last two samples, maybe of a rest or transient

# An input is active if it jumped in the last BEFORE samples by ACTIVE times its usual change.
# Samples of an output that stick out then are its response. They are outliers if the inputs are
# active for more than RARELY of the record, and other samples stick out at least ALIKE as often.
_BEFORE, _ACTIVE, _RARELY, _ALIKE = 20, 2.0, 0.1, 0.5

# Lone samples with more than DESIGN of the power are an experiment with impulses, if each output
# has RESPONDS times as much power in the next BEFORE samples as elsewhere.
_DESIGN, _RESPONDS = 0.5, 10.0


def input_outliers(u: Array, y: Array | None = None) -> Integers:
    """Return samples that stick out of any signal (T,); outputs (T, ny) respond to impulses."""
    u = _filled(u)
    k = _sticking_out(u)
    power = (u - np.median(u)) ** 2
    if not k.size or power[k].sum() <= _DESIGN * power.sum():
        return k
    after = np.zeros(len(u), bool)
    after[np.minimum(k[:, None] + np.arange(_BEFORE), len(u) - 1)] = True
    for output in () if y is None else y.T:
        power = (_filled(output) - np.nanmedian(output)) ** 2
        if power[after].mean() <= _RESPONDS * power[~after].mean():
            return k
    return k[:0]


def output_outliers(y: Array, u: Array) -> Integers:
    """Samples of an output (T,) that stick out of it, not because inputs (T, nu) jump."""
    k = _sticking_out(_filled(y))
    active = np.zeros(len(y), bool)
    for channel in u.T if k.size else ():
        jump = np.abs(np.diff(_filled(channel), append=channel[-1:]))  # to the next sample, too
        largest = maximum_filter1d(np.nan_to_num(jump), _BEFORE + 2, origin=_BEFORE // 2)
        active |= largest > _ACTIVE * np.median(largest)
    rest, share = k[~active[k]], float(active.mean())
    return k if share > _RARELY and len(rest) >= _ALIKE * (1 - share) * len(k) else rest


def _sticking_out(x: Array) -> Integers:
    T = len(x)
    values = np.unique(x) if T >= _SHORTEST else x[:0]
    if len(values) <= _LEVELS:
        return np.zeros(0, np.int64)
    tophats = (tophat(x, 3, mode="mirror") for tophat in (white_tophat, black_tophat))
    height = np.maximum(*tophats)
    found = height > max(_limit(height), _STEPS * float(np.diff(values).min()))
    if not 0 < np.count_nonzero(found) <= max(_FEW, _MOST * T):
        return np.zeros(0, np.int64)
    low, high = float(x[~found].min()), float(x[~found].max())
    jumps = np.abs(np.diff(x))[~found[1:] & ~found[:-1]]
    outside = np.maximum(x - high, low - x)
    inner = np.zeros(T, bool)
    inner[2:-2] = True
    found &= (outside > np.where(inner, _BEYOND, _END) * (high - low)) | (
        inner & (height > _ABOVE * jumps.max(initial=0.0))
    )
    between = np.zeros(T, bool)  # a good sample between two outliers sticks out on the other side
    between[1:-1] = found[:-2] & found[2:] & (outside[1:-1] <= 0)
    return np.flatnonzero(found & ~between)


def _limit(height: Array) -> float:
    """The height that only outliers exceed."""
    some = np.sort(height[height > 0])[::-1]
    if len(some) < _SHORTEST // 3:
        return 0.0
    tail = float(np.quantile(some, _TAIL))
    depth = np.log(1 / (1 - _TAIL))
    c = max(
        np.log(depth / np.log(1 / (1 - q))) / np.log(max(tail / np.quantile(some, q), 1.05))
        for q in _BODY
    )
    promised = tail * float(np.log(len(some) / _CHANCE) / depth) ** (1 / c)
    top = some[: max(_FEW, int(_MOST * len(height))) + 1]
    gaps = np.flatnonzero(top[:-1] > _GAP * top[1:])
    return min(promised, float(top[gaps[-1] + 1])) if gaps.size else promised


def _filled(x: Array) -> Array:
    """A signal with straight lines for missing samples, which therefore do not stick out."""
    known = np.isfinite(x)
    if known.all() or not known.any():
        return np.nan_to_num(x)
    return np.interp(np.arange(len(x)), np.flatnonzero(known), x[known])
