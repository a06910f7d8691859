"""Sampling frequency of time stamps, and the samples that are missing among them."""

from __future__ import annotations

import re
from typing import NamedTuple

import numpy as np

from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array, Integers
from lfrtorch.records import Channel

_GAP = 1.5  # steps: from here on samples are missing
_OFTEN = 0.1  # of the samples: if more steps seem to be gaps, the stamps are rounded
_ROUNDED = 1.01  # digits: how far a stamp may be from there if the last digit rounds
_NAMES = re.compile(
    r"(t|time|zeit|uhrzeit|timestamps?|time[ _-]?stamps?|date[ _-]?time|date|sec|seconds?|x_value)",
    re.IGNORECASE,
)
_SUFFIX = re.compile(r"(.+)[ _.-]([a-zµμ]+)", re.IGNORECASE)  # a unit behind a name, as in time_ms
_SECONDS = {
    unit: seconds
    for seconds, units in (
        (1e-9, "ns nsec nanosecond nanosekunde"),
        (1e-6, "us µs μs usec µsec μsec microsecond mikrosekunde"),
        (1e-3, "ms msec millisecond millisekunde"),
        (1.0, "s sec second sek sekunde"),
        (60.0, "min minute"),
        (3600.0, "h hr hour std stunde"),
        (86400.0, "d day tag tage"),
        (1e3, "ks kilosecond"),
    )
    for unit in units.split()
}
_KNOWN = "s, ms, us, ns, min, h or d"
_SINCE_1970 = (1e9, 4e9)  # seconds: the years 2001 to 2096


class Sampling(NamedTuple):
    """An even grid of samples."""

    fs: float  # Hz
    uncertainty: float  # of fs, relative, from the digits of the stamps
    gaps: Integers  # samples that follow a gap
    missing: Integers  # how many samples each gap has
    unit: str = ""  # what the stamps are taken to be in, if their column does not say it

    def __str__(self) -> str:
        """What a column is taken for: the unit, the frequency and how far it may be off."""
        unit = f" in {self.unit}" if self.unit else ""
        # A frequency that is known as well needs no word on that.
        off = f" ± {100 * self.uncertainty:.1g} %" if self.uncertainty > 1e-3 else ""
        return f"the time{unit}, {self.fs:.6g} Hz{off}"


class UnevenError(InputError):
    """A column that is no even grid of time: what it does, at which sample, and a remedy."""

    fs = 0.0
    """The usual sampling frequency in Hz, if there is one."""

    def __init__(
        self, message: str, sample: int, remedy: str = "resample the signals to an even grid"
    ) -> None:
        super().__init__(message)
        self.sample, self.remedy = sample, remedy


class TwiceError(UnevenError):
    """Time stamps that would be an even grid if some did not stand twice."""


class TimeUnit(NamedTuple):
    """A unit of time in seconds, and what it is if the file does not say it."""

    seconds: float
    assumed: str = ""


def is_time(channel: Channel) -> bool:
    """Whether a column is named as time is, as ``Time`` or ``time_ms``."""
    return _NAMES.fullmatch(_named(channel)[0]) is not None


def time_unit(t: Array, channel: Channel) -> TimeUnit:
    """Return the unit of time stamps, which header or size tells; refuse what may be several."""
    written = _named(channel)[1]
    if written:
        seconds = _seconds(written)
        if seconds is None:
            raise UnevenError(
                f"has the unit {written!r}, which is none of time ({_KNOWN})", 0, "correct it"
            )
        return TimeUnit(seconds)
    known = t[np.isfinite(t)]
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 0.0)
    for seconds, name in ((1e-3, "milliseconds"), (1e-6, "microseconds"), (1e-9, "nanoseconds")):
        if _SINCE_1970[0] <= seconds * low and seconds * high <= _SINCE_1970[1]:
            return TimeUnit(seconds, f"{name} since 1970")
    remedy = f"write the unit behind the name, {_KNOWN} in brackets"
    # Three hundred years, in seconds.
    if high > 1e10:
        raise UnevenError(f"goes up to {high:.6g} and has no unit", int(np.nanargmax(t)), remedy)
    # Days of 2000 to 2100 in spreadsheets and in MATLAB.
    if known.size > 1 and any(
        first <= low and high <= last for first, last in ((36526, 73051), (730486, 767011))
    ):
        step = 86400 * float(np.median(np.diff(known)))
        if 0 < step < 1:
            return TimeUnit(86400.0, "days of a calendar")
        # Steps of loggers in s.
        if np.isclose(
            step,
            (1, 2, 5, 10, 15, 20, 30, 60, 120, 180, 300, 600, 900, 1200, 1800, 3600),
            rtol=2e-3,
        ).any():
            raise UnevenError(
                f"begins at {low:.10g}, which may be seconds or the days of a calendar", 0, remedy
            )
    return TimeUnit(1.0)


def column_sampling(t: Array, channel: Channel) -> Sampling:
    """The grid of a column of time stamps (T,), NaN where one is missing; see :func:`sampling`."""
    unit, known = time_unit(t, channel), np.flatnonzero(np.isfinite(t))
    if not known.size:
        raise UnevenError("has no values", 0)
    t, first = np.interp(np.arange(known[-1] + 1), known, t[known]), known[0]
    t[:first] -= float(np.median(np.diff(t[first:]))) * np.arange(first, 0, -1) if first else 0.0
    t *= unit.seconds
    try:
        return sampling(t)._replace(unit=unit.assumed)
    except UnevenError as error:
        step = float(np.median(np.diff(t))) if len(t) > 1 else 0.0
        error.fs = 1 / step if step > 0 else 0.0
        raise


def _named(channel: Channel) -> tuple[str, str]:
    """Name and unit of a column; a unit may stand behind the name, as in ``time_ms``."""
    found = None if channel.unit else _SUFFIX.fullmatch(channel.name)
    seconds = _seconds(found[2]) if found else None
    if found and seconds and (seconds < 1 or (_NAMES.fullmatch(found[1]) and len(found[0]) > 3)):
        return found[1], found[2]
    return channel.name, channel.unit


def _seconds(unit: str) -> float | None:
    """Seconds of a unit; M is mega or a milli in capitals, so it is neither."""
    unit = unit.strip().partition(" since ")[0].rstrip(".")
    word = unit if unit in ("Ms", "MS") else unit.lower()
    spellings = (word, word.removesuffix("s"), word.removesuffix("n"))
    return next((_SECONDS[one] for one in spellings if one in _SECONDS), None)


def sampling(t: Array) -> Sampling:
    """Return the even grid of time stamps (s), up to rounding; refuse uneven ones."""
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
    return _grid(t, digit, np.flatnonzero(steps > _GAP * usual + _ROUNDED * digit) + 1)


def _rounded(t: Array, digit: float) -> bool:
    """Whether all stamps are on one grid but for their last digit, which shows now and then."""
    steps, k = np.diff(t), np.arange(len(t)) - (len(t) - 1) / 2
    away = t - t.mean()
    away -= k * (k @ away) / (k @ k)  # the line of least squares is off by digit / sqrt(T)
    shows = np.count_nonzero(np.abs(steps - np.median(steps)) > 0.5 * digit)
    # The last digit is taken to round if it makes some steps unlike the others.
    return bool(shows >= 5 and np.ptp(away) <= (1.1 + 3 / np.sqrt(len(t))) * digit)


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
    away = t - np.repeat(t[starts], lengths) - place * mean
    away -= np.repeat(np.add.reduceat(away, starts) / lengths, lengths)
    # Jitter: so far, in steps, a stamp may be from its place in an even grid.
    far = np.abs(away) > 0.1 * mean + _ROUNDED * digit
    if far.any():
        twice = np.flatnonzero(steps == 0) + 1
        if 0 < twice.size < _OFTEN * len(t) and _is_grid(np.delete(t, twice)):
            raise TwiceError(
                f"has {twice.size} time stamp(s) twice, the first {t[twice[0]]:.10g} s",
                int(twice[0]),
                "leave out one sample of each two",
            )
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


def _is_grid(t: Array) -> bool:
    try:
        sampling(t)
    except UnevenError:
        return False
    return True


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
