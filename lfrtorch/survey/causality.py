"""Causality test: whether outputs follow inputs, and after which delay.

The impulse response is estimated at negative and positive lags, as the inverse Fourier transform of
Syu / Suu with averaged cross spectra. A causal system has its energy at lags ≥ 0. If input and
output are exchanged, the energy is at negative lags; or at both, if the sampled system has
feedthrough or its signals are band-limited, and then the response from output to input is causal.

The dead time is the largest number of first lags that can be left out: without them, past inputs
explain the output as well. The output's own past is a regressor, too, for a response longer than
the lags and for coloured noise.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy

from lfrtorch._support.types import Array, Complex

# Numbers of segments of a record, for lags up to T / 8 or T / 16. The number that explains more of
# the output is taken: short segments miss long memories and delays, few segments average little.
_SEGMENTS = (4, 8)
_SHORTEST, _LONGEST = 32, 16384  # samples of a segment
_FLOOR = 1e-2  # added to the input's power, relative: where it has no power the response is 0

# Past samples of the output, lags after the response's peak, and samples that a dead time is from.
_PAST, _LATER, _MOST = 10, 30, 20_000

# If lags do nothing, they explain so much of the output with probability CHANCE. The lags after a
# dead time, over a quarter of it, explain CLEAR times as much; a slow response rises gradually. If
# past inputs predict the present one to within NEW of its power, as in a narrow band, they can
# stand for it.
_CHANCE, _CLEAR, _NEW = 1e-3, 4.0, 1e-3


class TwoSidedResponse(NamedTuple):
    """Relation of an input and an output by their two-sided impulse response."""

    coherence: float  # share of the output's power that follows from the input, linearly
    chance: float  # coherence that unrelated signals would show
    # (E₊ - E₋) / (E₊ + E₋) of the energies at positive and negative lags: 1 for a system with
    # memory, 0 for a system without, -1 for a response before its input.
    causality: float
    reverse: float  # the causality from output to input
    rise: float  # gain of the reverse response in the upper third of y's frequencies over the lower
    peak: int  # lag of the response's largest value


def two_sided_response(u: Array, y: Array) -> TwoSidedResponse | None:
    """The causality test of an input (T,) and an output (T,); ``None`` if short or constant."""
    if np.ptp(u) == 0 or np.ptp(y) == 0:
        return None
    lengths = {min(len(u) // n // 2 * 2, _LONGEST) for n in _SEGMENTS}
    found = [_by_segments(u, y, length) for length in sorted(lengths) if length >= _SHORTEST]
    return max(found, key=lambda one: one.coherence - one.chance, default=None)


def dead_time(u: Array, y: Array, peak: int) -> int:
    """Return the samples by which an output (T,) lags an input (T,), beyond the usual one.

    It is 0 if a dead time is not clear.

    Args:
        peak: lag of the largest value of the response.
    """
    u, y = u[:_MOST], y[:_MOST]
    lags = min(peak + _LATER, len(y) // 6)
    n = max(lags, _PAST)
    past = [y[n - i : len(y) - i] for i in range(1, _PAST + 1)]
    inputs = [u[n - i : len(u) - i] for i in range(lags, -1, -1)]
    columns = np.column_stack([np.ones(len(y) - n), *past, *inputs])
    Q, R = np.linalg.qr(columns)
    explained = Q.T @ y[n:]
    left = float(y[n:] @ y[n:] - explained @ explained)
    noise = max(left, np.finfo(float).eps * float(y[n:] @ y[n:])) / max(np.ptp(columns.shape), 1)
    by_first = np.cumsum(explained[: -lags - 2 : -1] ** 2) / noise  # lags 0, 0 to 1, 0 to 2, ...
    evidence = by_first / scipy.special.chdtri(np.arange(1, lags + 2), _CHANCE)
    first = int(np.argmax(evidence > 1))
    later = min(lags, first + max(1, first // 4))
    clear = evidence[later] > _CLEAR and R[-1, -1] ** 2 > _NEW * (len(u) - n) * np.var(u)
    return max(0, first - 1) if clear else 0


def _by_segments(u: Array, y: Array, length: int) -> TwoSidedResponse:
    _, Suu = scipy.signal.welch(u, nperseg=length)
    _, Syy = scipy.signal.welch(y, nperseg=length)
    _, Syu = scipy.signal.csd(u, y, nperseg=length)
    g = _response(Suu, Syu)
    excited = np.flatnonzero(Syy > _FLOOR * Syy.max())
    gain = np.abs(Syu[excited]) / Syy[excited]
    third = max(len(gain) // 3, 1)
    tiny = np.finfo(float).tiny
    return TwoSidedResponse(
        coherence=float(np.sum(np.abs(Syu) ** 2 / np.maximum(Suu, tiny)) / np.sum(Syy)),
        chance=length / len(u),
        causality=_causality(g),
        reverse=_causality(_response(Syy, Syu.conj())),
        rise=float(np.median(gain[-third:]) / max(np.median(gain[:third]), tiny)),
        peak=int(np.argmax(np.abs(g[: length // 2]))),
    )


def _response(power: Array, cross: Complex) -> Array:
    """The two-sided impulse response (length,), negative lags in its second half."""
    return np.fft.irfft(cross / (power + _FLOOR * power.max()))


def _causality(g: Array) -> float:
    half = len(g) // 2
    after, before = np.sum(g[1:half] ** 2), np.sum(g[half + 1 :] ** 2)
    return float((after - before) / max(after + before, np.finfo(float).tiny))
