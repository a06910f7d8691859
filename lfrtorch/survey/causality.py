"""Causality test: whether outputs follow inputs, and after which delay.

The impulse response is estimated at negative and positive lags, as the inverse Fourier transform of
Syu / Suu with averaged cross spectra. A causal system has its energy at lags ≥ 0. If input and
output are exchanged, the energy is at negative lags; or at both, if the sampled system has
feedthrough or its signals are band-limited, and then the response from output to input is causal.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy

from lfrtorch._support.types import Array, Complex
from lfrtorch.metrics import rms

# Numbers of segments of a record, for lags up to T / 8 or T / 16. The one that explains more of the
# output is taken: short segments miss long memories and delays, few segments average little.
_SEGMENTS = (4, 8)
_SHORTEST, _LONGEST = 32, 16384  # samples of a segment
_FLOOR = 1e-2  # added to the input's power, relative: without power the response is 0

# The response begins when it exceeds ONSET of its peak and CLEAR times its rms at negative lags.
# If that limit is more than UNCLEAR of the peak, the delay is unknown.
_ONSET, _CLEAR, _UNCLEAR = 0.1, 4.0, 0.5


class TwoSidedResponse(NamedTuple):
    """What the two-sided impulse response says of an input and an output."""

    coherence: float  # share of the output's power that follows from the input, linearly
    chance: float  # coherence that unrelated signals would show
    # (E₊ - E₋) / (E₊ + E₋) of the energies at positive and negative lags: 1 for a system with
    # memory, 0 for one without, -1 for a response that comes first.
    causality: float
    reverse: float  # the same from output to input
    rise: float  # gain of the reverse response in the upper third of y's frequencies over the lower
    delay: int  # samples until the response begins; 0 if that is not clear
    peak: int  # lag of its largest value


def two_sided_response(u: Array, y: Array) -> TwoSidedResponse | None:
    """The causality test of an input (T,) and an output (T,); ``None`` if short or constant."""
    if np.ptp(u) == 0 or np.ptp(y) == 0:
        return None
    lengths = {min(len(u) // n // 2 * 2, _LONGEST) for n in _SEGMENTS}
    found = [_by_segments(u, y, length) for length in sorted(lengths) if length >= _SHORTEST]
    return max(found, key=lambda one: one.coherence - one.chance, default=None)


def _by_segments(u: Array, y: Array, length: int) -> TwoSidedResponse:
    _, Suu = scipy.signal.welch(u, nperseg=length)
    _, Syy = scipy.signal.welch(y, nperseg=length)
    _, Syu = scipy.signal.csd(u, y, nperseg=length)
    g = _response(Suu, Syu)
    size, half = np.abs(g), length // 2
    begun = max(_ONSET, _CLEAR * float(rms(g[half:]) / size.max()))
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
        delay=int(np.argmax(size[:half] >= begun * size.max())) if begun < _UNCLEAR else 0,
        peak=int(np.argmax(size[:half])),
    )


def _response(power: Array, cross: Complex) -> Array:
    """The two-sided impulse response (length,), negative lags in its second half."""
    return np.fft.irfft(cross / (power + _FLOOR * power.max()))


def _causality(g: Array) -> float:
    half = len(g) // 2
    after, before = np.sum(g[1:half] ** 2), np.sum(g[half + 1 :] ** 2)
    return float((after - before) / max(after + before, np.finfo(float).tiny))
