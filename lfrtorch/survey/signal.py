"""Numbers of one measured signal: its level, range, gaps, band, and noise."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy

from lfrtorch._support.types import Array, Booleans, Integers
from lfrtorch.data.periods import find_transient
from lfrtorch.data.records import Channel

LEAST = 16
"""Smallest number of samples of a spectrum."""

_IN_BAND = 0.99  # share of the power about the mean in the band; half of the rest is below it
_QUIET = 0.2  # quantile of the spectrum that is taken for the level of white noise
_LOUD = 0.5  # largest rms of noise, over the signal's, that a spectrum can separate from the signal
_SEGMENTS, _LONGEST = 8, 4096  # least number of segments of a spectrum; their largest length

# A signal is clipped if SAMPLES samples are at an extreme, RUN of them in a row, and RATIO times as
# many as at any of the next NEIGHBOURS values. (A sine in coarse steps has a ratio of 2.4.)
_CLIPPED_SAMPLES, _CLIPPED_RUN, _CLIPPED_RATIO, _NEIGHBOURS = 5, 3, 5, 5

# It rests at the extreme, and is not clipped, where the record begins. It also rests if no input
# moves when it arrives there, by a last change of at most SMOOTH of its rms or two converter steps.
_SMOOTH = 0.01
_LEVELS = 16  # a signal of so few values consists of levels, like a binary one; it is not clipped
_REST = 0.05  # a signal that stays within this part of its rms does not move
# A slow clock holds a signal for more than LEAST_HOLD samples, always for as many. The signal then
# changes at TICKS or more, and at least at the share EACH of them: a binary signal changes at half.
_TICKS, _LEAST_HOLD, _EACH = 20, 2, 0.8
_SILENT = 1e-10  # power of a combination of inputs, relative to the largest, that counts as none


class Extreme(NamedTuple):
    """The smallest or largest value: how many samples have it, and how many in a row."""

    value: float
    samples: int
    run: int
    clipped: bool


class SignalSurvey(NamedTuple):
    """Statistics of a signal of T samples; numbers are NaN if the signal has no values.

    Args:
        channel: its name and unit.
        samples: T.
        missing: number of samples that are NaN.
        gap: largest number of NaN in a row.
        mean, rms: mean of the signal, and rms about it.
        minimum, maximum: its extremes.
        values: number of different values.
        step: smallest difference of two of them.
        band: frequencies in Hz between which 99 % of the power about the mean lies.
        period: samples of a period, ``None`` if it does not repeat.
        noise: its estimated rms, ``None`` if it cannot be told from the signal.
        method: estimate of the noise. ``"periods"``: the scatter of whole periods in steady state.
            ``"spectrum"``: a guess, the quietest part of the spectrum taken for white noise. For an
            output this is the part that does not follow the inputs. It is too large for other
            signals if they fill all of the band, and too small if a filter removed noise.
    """

    channel: Channel
    samples: int
    missing: int
    gap: int
    mean: float
    rms: float
    minimum: Extreme
    maximum: Extreme
    values: int
    step: float
    band: tuple[float, float] | None
    period: int | None
    noise: float | None
    method: str

    @property
    def clipped(self) -> tuple[Extreme, ...]:
        """The extremes at which the signal is clipped."""
        return tuple(end for end in (self.minimum, self.maximum) if end.clipped)


def survey_signal(
    signal: Array,
    whole: slice,
    channel: Channel,
    *,
    fs: float = 1.0,
    period: int | None = None,
    inputs: Array | None = None,
) -> SignalSurvey:
    """Return the numbers of a signal (T,), NaN where a sample is missing."""
    # ``whole`` is its longest part without gaps, for the spectrum. ``inputs`` (T, nu) are the
    # signals that it follows, if it is an output.
    missing = ~np.isfinite(signal)
    known = signal[~missing] if missing.any() else signal
    values, counts = np.unique(known, return_counts=True)
    some = len(values) > 0
    noise, method = None, ""
    if len(values) > 1:
        noise, method = _noise(signal[whole], period, None if inputs is None else inputs[whole])
    return SignalSurvey(
        channel,
        samples=len(signal),
        missing=int(missing.sum()),
        gap=longest_run(missing)[1],
        mean=float(known.mean()) if some else np.nan,
        rms=float(known.std()) if len(values) > 1 else 0.0 if some else np.nan,
        minimum=_extreme(signal, values, counts, inputs),
        maximum=_extreme(signal, values[::-1], counts[::-1], inputs),
        values=len(values),
        step=float(np.diff(values).min()) if len(values) > 1 else np.nan,
        band=band(signal[whole], fs),
        period=period,
        noise=noise,
        method=method,
    )


def runs(holds: Booleans) -> Integers:
    """First samples and lengths (n, 2) of the runs of samples for which a condition (T,) holds."""
    ends = np.flatnonzero(np.diff(holds.astype(np.int8), prepend=0, append=0)).reshape(-1, 2)
    return np.column_stack([ends[:, 0], ends[:, 1] - ends[:, 0]])


def longest_run(holds: Booleans) -> tuple[int, int]:
    """First sample and length of the longest run of samples for which a condition (T,) holds."""
    found = runs(holds)
    if not len(found):
        return 0, 0
    first, length = found[np.argmax(found[:, 1])]
    return int(first), int(length)


def moves(u: Array, parts: Integers) -> list[bool]:
    """Tell whether any of the signals u (T, nu) moves in parts (n, 2), from first to past end."""
    least = _REST * np.nanstd(u, axis=0)
    part = (u[first:end] for first, end in parts)
    return [bool(np.any(np.fmax.reduce(s) - np.fmin.reduce(s) > least)) for s in part]


def held(u: Array) -> tuple[int, int] | None:
    """Return for how many samples a slow clock holds u (T, nu), and its first change; else None."""
    at = np.flatnonzero((np.diff(u, axis=0) != 0).any(axis=1)) + 1
    if len(at) < _TICKS:
        return None
    between = np.diff(at)
    hold = int(np.gcd.reduce(between))
    clocked = hold > _LEAST_HOLD and np.mean(between == hold) > _EACH
    return (hold, int(at[0] % hold)) if clocked else None


def band(signal: Array, fs: float = 1.0) -> tuple[float, float] | None:
    """Frequencies in Hz between which 99 % of the power about the mean lies; else None."""
    if len(signal) < LEAST or np.ptp(signal) == 0:
        return None
    f, power = scipy.signal.periodogram(signal, fs, window="hann")
    share = np.cumsum(power[1:])
    outside = (1 - _IN_BAND) / 2
    low, high = np.searchsorted(share, share[-1] * np.array([outside, 1 - outside]))
    return float(f[1 + low]), float(f[1 + high])


def _extreme(signal: Array, values: Array, counts: Integers, inputs: Array | None) -> Extreme:
    """The first of the values, and whether the signal is clipped at it."""
    if not len(values):
        return Extreme(np.nan, 0, 0, False)
    found = runs(signal == values[0])
    samples, run = int(counts[0]), int(found[:, 1].max())
    clipped = (
        len(values) > _LEVELS
        and samples >= max(_CLIPPED_SAMPLES, _CLIPPED_RATIO * counts[1 : 1 + _NEIGHBOURS].max())
        and run >= _CLIPPED_RUN
    )
    if clipped and inputs is not None:
        first, length = found[(found[:, 0] > 0) & (found[:, 1] >= _CLIPPED_RUN)].T
        smooth = max(_SMOOTH * np.nanstd(signal), 2 * np.abs(np.diff(values)).min())
        arrives = np.abs(signal[first] - signal[first - 1]) > smooth
        driven = np.array(moves(inputs, np.column_stack([first - 1, first + length // 2])), bool)
        clipped = np.any(arrives | driven)
    return Extreme(float(values[0]), samples, run, bool(clipped))


def _noise(
    signal: Array, period: int | None, inputs: Array | None = None
) -> tuple[float | None, str]:
    """The rms of the noise in a signal, and the method by which it is estimated."""
    if period is not None:
        count = (len(signal) - find_transient(signal[:, None], period)) // period
        if count > 1:
            periods = signal[len(signal) - count * period :].reshape(count, period)
            return float(np.sqrt(np.mean(np.var(periods, axis=0, ddof=1)))), "periods"
    length = min(len(signal) // _SEGMENTS, _LONGEST)
    if length < LEAST or np.ptp(signal) == 0:
        return None, ""
    density = _unexplained(signal, inputs, length)
    noise = float(np.sqrt(np.quantile(density[1:-1], _QUIET) / 2))
    return (noise, "spectrum") if noise < _LOUD * signal.std() else (None, "")


def _unexplained(signal: Array, inputs: Array | None, length: int) -> Array:
    """One-sided spectral density over 0 .. 1/2 of what does not follow the inputs linearly."""
    _, density = scipy.signal.welch(signal, nperseg=length)
    moving = [] if inputs is None else [u for u in inputs.T if np.ptp(u) > 0]
    segments = len(signal) // length
    if not moving or len(moving) >= segments:
        return density
    u = np.stack(moving) / np.std(moving, axis=1, keepdims=True)
    _, Suu = scipy.signal.csd(u[:, None], u[None], nperseg=length)
    _, Suy = scipy.signal.csd(u, signal, nperseg=length)
    Suu, Suy = np.moveaxis(Suu, -1, 0), Suy.T[:, :, None]
    followed = (Suy.conj() * (np.linalg.pinv(Suu, rcond=_SILENT, hermitian=True) @ Suy)).real
    left = np.maximum(density - followed.sum(axis=(1, 2)), 0.0)
    return left * segments / (segments - len(moving))  # some of the noise follows by chance
