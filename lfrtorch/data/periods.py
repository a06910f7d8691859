"""Periods of a measured input, and the number of periods until the output has settled."""

from __future__ import annotations

import numpy as np
import scipy

from lfrtorch._support.powers import near_one
from lfrtorch._support.types import Array

_ALIKE = 0.02  # largest D(p) that counts as noise; parts of narrow-band noise reach 0.05 at times

# Largest D(k p) / (k D(p)): it grows as k² for a p that is slightly wrong, at most as k for the
# drift of an amplifier, and not at all for noise.
_GROWTH = 1.5
_BEGINNING = 1 / 3  # share of the record in which an input may differ from what it repeats later
_NEAR = 2.0  # the shortest period counts as good if its D is within this factor of the best
_EXACT = 1e-9  # D of a signal that repeats exactly is below this, which is far above rounding
_FASTER = 0.75  # largest shift that is tried, relative to the record

_SETTLED = 2.0  # largest mean square difference of settled periods, relative to noise
_SMALL = 1e-5  # an rms difference below this part of the output's is never a transient
_TAIL = 4  # the last 1 / TAIL of the difference of two periods is taken for noise


def find_period(u: Array) -> int | None:
    """Shortest period, in samples, that explains the signals; None if none repeats.

    Every shift p up to half the record has a relative difference,

        D(p) = sum (u(k + p) - u(k))^2 / sum (u(k + p)^2 + u(k)^2),  u about its mean,

    which is 0 for a period, 1 for unrelated signals and the noise-to-signal ratio for a period in
    noise. A period is a p whose D is a small minimum, and stays small for 2 p, 3 p, ... A transient
    in the first periods, which a measured input may have, does not lengthen it. Constant signals do
    not count. Shape of u: (T, nu) or (T,).
    """
    u = u.reshape(len(u), -1)
    u = near_one(u, axis=0)
    deviation = np.std(u, axis=0)
    moving = deviation > 1e-12 * np.max(np.abs(u), axis=0, initial=0)
    if not moving.any() or len(u) < 4:
        return None
    u = (u[:, moving] - u[:, moving].mean(axis=0)) / deviation[moving]
    D = _differences(u)
    period = _shortest(D, len(u))
    if period is None:
        return None
    settled = u[round(_BEGINNING * len(u)) :]
    D_settled = _differences(settled)
    shorter = _shortest(D_settled, len(settled))
    if (
        shorter is None
        or period % shorter
        or D_settled[shorter] > _NEAR * D[period] + _EXACT  # the signal has more than a transient
    ):
        return period
    return shorter


def _shortest(D: Array, T: int) -> int | None:
    """Shortest period of T samples with the differences D(p)."""
    p = np.arange(2, T // 2 + 1)
    D_next = np.append(D, np.inf)[p + 1]
    minima = p[(D[p] < D[p - 1]) & (D[p] <= D_next) & (D[p] < _ALIKE)]
    periods = [i for i in minima if _stays_small(D[i::i])]
    if not periods:
        return None
    best = D[periods].min()
    shortest = next(i for i in periods if D[i] <= _NEAR * best + _EXACT)
    # A slow signal in noise has several minima near the period; distant multiples decide.
    return int(min((i for i in periods if i < 2 * shortest - 1), key=lambda i: D[i::i].mean()))


def _stays_small(D: Array) -> bool:
    """Tell if D at 1, 2, ... periods is due to noise, a drift or a transient."""
    most = np.maximum(_GROWTH * np.arange(1, len(D) + 1), 3.0) * D[0] + _EXACT
    return bool((np.minimum(most, _ALIKE) > D).all())


def _differences(u: Array) -> Array:
    """Differences D(p), p = 0, 1, ... to 3/4 of the record, for the signal that repeats worst."""
    T = len(u)
    last = max(int(_FASTER * T), T // 2)
    worst = np.zeros(last + 1)
    for x in u.T:
        X = scipy.fft.rfft(x, scipy.fft.next_fast_len(T + last, real=True))
        products = scipy.fft.irfft(
            X.real**2 + X.imag**2, scipy.fft.next_fast_len(T + last, real=True)
        )
        energy = np.concatenate([[0.0], np.cumsum(x**2)])
        both = energy[T - last : T + 1][::-1] + energy[T] - energy[: last + 1]
        both = np.where(both > 0, both, np.inf)  # a signal that is zero does not repeat
        found = np.where(np.isinf(both), 1.0, 1 - 2 * products[: last + 1] / both)
        worst = np.maximum(worst, np.maximum(found, 0.0))
    return worst


def find_transient(y: Array, period: int) -> int:
    """Number of samples in the first whole periods in which the outputs have not settled.

    These are the periods, from the first on, that differ from the next period by more than the last
    two periods differ from each other. If there are only two periods, the end of their difference
    is taken for noise. The last whole period never counts. Shape of y: (T, ny) or (T,).
    """
    y = y.reshape(len(y), -1)
    count = len(y) // period
    if count < 2:
        return 0
    periods = y[: count * period].reshape(count, period, -1)
    # Difference from the next period, not from the last: a drift is not a transient.
    difference = np.diff(periods, axis=0) ** 2  # (count - 1, period, ny)
    size = difference.mean(axis=1)
    noise = size[-1] if count > 2 else difference[0, -(period // _TAIL) - 1 :].mean(axis=0)
    least = (_SMALL * np.std(y, axis=0)) ** 2
    unsettled = (size > np.maximum(_SETTLED * noise, least)).any(axis=1)
    return period * int(np.argmin(np.append(unsettled, False)))
