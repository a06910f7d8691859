"""Sampling frequency of time stamps, and the samples that are missing among them."""

from __future__ import annotations

import re
from typing import NamedTuple

import numpy as np

from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array, Integers
from lfrtorch.records import Channel

_JITTER = 0.1  # of a step: how far a stamp may be from its place in an even grid
_GAP = 1.5  # steps: from here on samples are missing
_OFTEN = 0.1  # of the samples: if more steps seem to be gaps, the stamps are rounded
_SHOWS = 5  # steps that the last digit makes unlike the others, before it is taken to round
_NAMES = re.compile(
    r"(t|time|zeit|uhrzeit|timestamps?|time[ _-]?stamps?|date[ _-]?time|date|sec|seconds?|x_value)",
    re.IGNORECASE,
)
_SECONDS = {"ms": 1e-3, "us": 1e-6, "µs": 1e-6, "μs": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}


class Sampling(NamedTuple):
    """An even grid of samples.

    Args:
        fs: sampling frequency in Hz.
        uncertainty: of ``fs``, relative, from the digits of the stamps.
        gaps: the samples that follow a gap.
        missing: how many samples each gap has.
    """

    fs: float
    uncertainty: float
    gaps: Integers
    missing: Integers


class UnevenError(InputError):
    """Stamps that are no even grid; ``sample`` is one at which that shows."""

    def __init__(self, message: str, sample: int) -> None:
        super().__init__(message)
        self.sample = sample


def is_time(channel: Channel) -> bool:
    """Whether a column is named as time is."""
    return _NAMES.fullmatch(channel.name) is not None


def in_seconds(t: Array, channel: Channel) -> Array:
    """Time stamps by the unit of their column; seconds if it has none."""
    return t * _SECONDS.get(channel.unit, 1.0)


def sampling(t: Array) -> Sampling:
    """The even grid that the time stamps are on, up to the rounding of their digits.

    Args:
        t: time stamps in seconds.

    Shape:
        t: (T,).

    Raises:
        UnevenError: stamps that do not rise, or are not evenly spaced between gaps.
    """
    if len(t) < 2:
        raise UnevenError("has one sample", 0)
    digit = _last_digit(t)
    if _rounded(t, digit):
        return _grid(t, digit, np.array([], np.int64))
    steps = np.diff(t)
    usual = float(np.median(steps))
    found = np.flatnonzero(steps > _GAP * usual) + 1
    if len(found) < _OFTEN * len(t):
        return _grid(t, 0.0, found)
    return _grid(t, digit, np.flatnonzero(steps > _GAP * usual + digit) + 1)


def _rounded(t: Array, digit: float) -> bool:
    """Whether all stamps are on one grid but for their last digit, which shows now and then."""
    steps = np.diff(t)
    away = t - np.linspace(t[0], t[-1], len(t))
    shows = np.count_nonzero(np.abs(steps - np.median(steps)) > 0.5 * digit)
    return bool(shows >= _SHOWS and np.ptp(away) <= 1.1 * digit)


def _grid(t: Array, digit: float, gaps: Integers) -> Sampling:
    """The grid of stamps between gaps, each within ``digit`` and the jitter of its place."""
    steps = np.diff(t)
    within = np.delete(steps, gaps - 1)
    mean = float(within.mean()) if within.size else 0.0
    falling = np.flatnonzero(steps < 0)
    if mean <= 0 or falling.size:
        k = int(falling[0]) + 1 if falling.size else 1
        raise UnevenError(f"does not rise: {t[k - 1]:.10g} s is followed by {t[k]:.10g} s", k)
    starts = np.concatenate([[0], gaps])
    lengths = np.diff(np.append(starts, len(t)))
    place = np.arange(len(t)) - np.repeat(starts, lengths)
    away = np.abs(t - np.repeat(t[starts], lengths) - place * mean)
    far = away > _JITTER * mean + 1.01 * digit
    if far.any():
        odd = np.abs(steps - np.median(steps))
        odd[gaps - 1] = 0.0
        raise UnevenError(
            f"is not evenly spaced: its steps go from {steps.min():.4g} s to {steps.max():.4g} s",
            int(np.argmax(odd)) + 1,
        )
    rounding = 4 * float(np.spacing(np.abs(t).max()))
    if np.ptp(within) > 2 * rounding:  # else the digits hold the step exactly
        rounding = max(rounding, _last_digit(t))
    uncertainty = rounding * len(starts) / float(within.sum())
    missing = np.maximum(np.rint(steps[gaps - 1] / mean).astype(np.int64) - 1, 1)
    return Sampling(_roundest(1 / mean, uncertainty), uncertainty, gaps, missing)


def _last_digit(t: Array) -> float:
    """What the last digit counts of stamps that were printed, or kept in single precision."""
    largest = float(np.abs(t).max())
    with np.errstate(over="ignore"):  # beyond single precision
        single = t.astype(np.float32)
    if np.array_equal(t, single) and not np.array_equal(t, np.rint(t)):
        return float(np.spacing(np.float32(largest)))
    for digits in range(10):
        scaled = t * 10.0**digits
        if np.abs(scaled - np.rint(scaled)).max() <= 4 * np.spacing(largest * 10.0**digits):
            return 10.0**-digits
    return 0.0


def _roundest(value: float, uncertainty: float) -> float:
    """The number of the fewest digits that is as good."""
    for digits in range(16):
        found = float(f"{value:.{digits}e}")
        if abs(found - value) <= uncertainty * value:
            return found
    return value
