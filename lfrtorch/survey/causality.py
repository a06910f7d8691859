"""Whether outputs follow inputs: the impulse response at negative and positive lags.

The response Syu / Suu of averaged cross spectra, back in the time domain, is two-sided. That of a
causal system has its energy at lags ≥ 0; that of exchanged signals at negative lags, or, where the
sampled system has feed-through or its signals are band-limited, at both, with the reverse response
all causal.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy

from lfrtorch._types import Array, Complex
from lfrtorch.metrics import rms

SEGMENTS = (4, 8)
"""Of a record: the response has lags up to T / 8 or T / 16. The one is taken in which more of the
output is explained: short segments miss long memories and delays, few ones average little."""

SHORTEST, LONGEST = 32, 16384
"""Samples of a segment."""

FLOOR = 1e-2
"""Added to the input's power, relative to its largest: where there is none, the response is 0."""

ONSET, CLEAR, UNCLEAR = 0.1, 4.0, 0.5
"""The response has begun where it is this much of its peak, and so many times its rms at negative
lags; where that is more than the last of the peak, one cannot tell."""


class Lags(NamedTuple):
    """What the two-sided response from an input to an output says.

    Args:
        coherence: share of the output's power that follows from the input, linearly.
        chance: of that, what unrelated signals would show.
        causality: (E₊ - E₋) / (E₊ + E₋) of the energies at positive and negative lags: 1 for a
            system with memory, 0 for one without, -1 for a response that comes first.
        reverse: the same from output to input.
        rise: gain of the reverse response at the upper third of the output's frequencies, relative
            to that at the lower third.
        delay: samples until the response begins; 0 where that is not clear.
        peak: lag of its largest value.
    """

    coherence: float
    chance: float
    causality: float
    reverse: float
    rise: float
    delay: int
    peak: int


def lags(u: Array, y: Array) -> Lags | None:
    """The lags between an input and an output, None where the signals are too short or constant.

    Shape:
        u, y: (T,).
    """
    if np.ptp(u) == 0 or np.ptp(y) == 0:
        return None
    lengths = {min(len(u) // n // 2 * 2, LONGEST) for n in SEGMENTS}
    found = [_lags(u, y, length) for length in sorted(lengths) if length >= SHORTEST]
    return max(found, key=lambda one: one.coherence - one.chance, default=None)


def _lags(u: Array, y: Array, length: int) -> Lags:
    _, Suu = scipy.signal.welch(u, nperseg=length)
    _, Syy = scipy.signal.welch(y, nperseg=length)
    _, Syu = scipy.signal.csd(u, y, nperseg=length)
    g = _response(Suu, Syu)
    size, half = np.abs(g), length // 2
    begun = max(ONSET, CLEAR * float(rms(g[half:]) / size.max()))
    excited = np.flatnonzero(Syy > FLOOR * Syy.max())
    gain = np.abs(Syu[excited]) / Syy[excited]
    third = max(len(gain) // 3, 1)
    tiny = np.finfo(float).tiny
    return Lags(
        coherence=float(np.sum(np.abs(Syu) ** 2 / np.maximum(Suu, tiny)) / np.sum(Syy)),
        chance=length / len(u),
        causality=_causality(g),
        reverse=_causality(_response(Syy, Syu.conj())),
        rise=float(np.median(gain[-third:]) / max(np.median(gain[:third]), tiny)),
        delay=int(np.argmax(size[:half] >= begun * size.max())) if begun < UNCLEAR else 0,
        peak=int(np.argmax(size[:half])),
    )


def _response(power: Array, cross: Complex) -> Array:
    """The two-sided impulse response (length,), negative lags in its second half."""
    return np.fft.irfft(cross / (power + FLOOR * power.max()))


def _causality(g: Array) -> float:
    half = len(g) // 2
    after, before = np.sum(g[1:half] ** 2), np.sum(g[half + 1 :] ** 2)
    return float((after - before) / max(after + before, np.finfo(float).tiny))
