"""Tests for noise of any distribution: is a signal white, and does it depend on another signal?

Each correlation is divided by its own standard deviation: for Σ a(t) b(t-k) that is
√Σ a(t)² b(t-k)² if a is white, whatever b is. This also holds if the variance of a changes with
time, as it does for a model's errors; the usual 1/√T is too small then.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int64
from scipy.special import chdtrc, ndtr, ndtri

from lfrtorch._support.checks import integer
from lfrtorch._support.powers import near_one
from lfrtorch._support.types import Array, Integers

_NO_POWER = 1e-24
"""Prediction errors with less than this part of the signal's power are rounding."""


@dataclass(frozen=True, eq=False)
class Correlation:
    """Correlations of two signals by lag, their bounds, and a test of independence.

    Args:
        lags: samples by which the second signal is earlier.
        values: -1 to 1.
        bounds: 99 % of the correlations of independent signals are within ± these.
        p: probability of correlations as large as these at lags from 0 on (of a signal with itself:
            from 1 on) if the signals are independent: below 0.01 they hardly are.
    """

    lags: Int64[Integers, " K"]
    values: Float[Array, " K"]
    bounds: Float[Array, " K"]
    p: float

    @property
    def outside(self) -> Integers:
        """Lags from 0 on whose correlation is beyond its bound."""
        return self.lags[(np.abs(self.values) > self.bounds) & (self.lags >= 0)]

    @property
    def largest(self) -> int:
        """Lag from 0 on with the largest correlation relative to its bound."""
        part = np.where(self.lags >= 0, np.abs(self.values) / np.maximum(self.bounds, 1e-300), -1.0)
        return int(self.lags[np.argmax(part)])

    def at(self, lag: int) -> tuple[float, float]:
        """Correlation and bound at a lag."""
        k = int(np.searchsorted(self.lags, lag))
        return float(self.values[k]), float(self.bounds[k])


def autocorrelation(e: Float[Array, " T"], lags: int | None = None) -> Correlation:
    """Correlation of a signal with its own past, and a portmanteau test of whiteness.

    The sum of the squared correlations, each over its standard deviation, is distributed as χ² with
    as many degrees of freedom as lags if the signal is white (Dalla, Giraitis and Phillips, "Robust
    tests for white noise and cross-correlation", Econometric Theory 38(5), 2022).
    """
    e = e - e.mean()
    K = lags_for(len(e), lags)
    values, bounds, scores = _correlated(e, e, range(1, K + 1))
    return Correlation(np.arange(1, K + 1), values, bounds, float(chdtrc(K, np.sum(scores**2))))


def cross_correlation(e: Float[Array, " S"], x: Float[Array, " T"], lags: int) -> Correlation:
    """Correlation of two ``whitened`` signals that end together, at lags from -lags to lags.

    Correlations of slow signals are large by chance, so both are white (Haugh, "Checking the
    independence of two covariance-stationary time series", Journal of the American Statistical
    Association 71(354), 1976). The test is on the largest score at lags from 0 on: by Šidák's
    inequality it holds for inputs of any kind, also for steps and multisines, which no model makes
    white. Correlations at negative lags mean that x follows e.
    """
    T = min(len(e), len(x))
    every = range(-lags, lags + 1)
    values, bounds, scores = _correlated(e[-T:], x[-T:], every)
    one = 2.0 * ndtr(-np.max(np.abs(scores[lags:])))
    p = -math.expm1((lags + 1) * math.log1p(-min(float(one), 1.0 - 1e-16)))
    return Correlation(np.arange(-lags, lags + 1), values, bounds, p)


def whitened(x: Float[Array, " T"]) -> Float[Array, " S"]:
    """Errors of predicting a signal from its past: white if an autoregressive model describes it.

    The model is fitted by Burg's method (PhD thesis, Stanford University, 1975). Akaike's criterion
    chooses its order, up to 10 log10 T; as many samples are missing at the beginning.
    """
    T = len(x)
    forward = backward = best = x - x.mean()
    power = _dot(best, best)
    least_power, order = _NO_POWER * power, 0
    criterion = 0.0  # T log(power) + 2 order, relative to order 0
    least = 0.0
    while order < min(10 * math.log10(T), T // 4):
        forward, backward = forward[1:], backward[:-1]
        both = _dot(forward, forward) + _dot(backward, backward)
        if both <= 2.0 * least_power:
            break
        reflection = -2.0 * _dot(forward, backward) / both
        forward, backward = forward + reflection * backward, backward + reflection * forward
        order += 1
        criterion += T * math.log(max(1.0 - reflection**2, 1e-300)) + 2.0
        if criterion < least:
            best, least = forward, criterion
    return best - best.mean()


def _correlated(
    a: Float[Array, " T"], b: Float[Array, " T"], lags: range
) -> tuple[Float[Array, " K"], Float[Array, " K"], Float[Array, " K"]]:
    """Correlations of a(t) and b(t-k), their bounds, and their ratios to a standard deviation."""
    a, b = near_one(a), near_one(b)
    T, a2, b2 = len(a), a**2, b**2
    sums, variances = np.zeros((2, len(lags)))
    for i, k in enumerate(lags):
        here, there = slice(max(k, 0), T + min(k, 0)), slice(max(-k, 0), T + min(-k, 0))
        sums[i], variances[i] = _dot(a[here], b[there]), _dot(a2[here], b2[there])
    size, deviations = math.sqrt(a2.sum() * b2.sum()), np.sqrt(variances)
    if not size > 0:
        return np.zeros(len(lags)), np.zeros(len(lags)), np.zeros(len(lags))
    scores = np.divide(sums, deviations, out=np.zeros(len(lags)), where=deviations > 0)
    z = -float(ndtri((1.0 - 0.99) / 2))  # bounds of 99 %
    return sums / size, z * deviations / size, scores


def _dot(a: Float[Array, " T"], b: Float[Array, " T"]) -> float:
    """Σ a b on one thread: BLAS threads wait long if other work has their processors."""
    return float(np.einsum("t,t->", a, b))


def lags_for(T: int, lags: int | None = None) -> int:
    """Number of lags in a test of T samples."""
    if lags is None:
        # 25 as in MATLAB's ``resid``. With 20 samples a lag, a 1 % test rejects whiteness in 1.5 %.
        return min(25, max(5, T // 40))
    integer("lags", lags, 1)
    return min(lags, T // 2)
