"""Columns of time stamps: their names, their units, and the seconds in them."""

from __future__ import annotations

import re
from typing import NamedTuple

import numpy as np

from lfrtorch._support.sampling import UnevenError
from lfrtorch._support.types import Array
from lfrtorch.data.records import Channel

_NAMES = re.compile(
    r"(t|time|zeit|uhrzeit|timestamps?|time[ _-]?stamps?|date[ _-]?time|date|sec|seconds?|x_value)",
    re.IGNORECASE,
)
_SUFFIX = re.compile(r"(.+)[ _.-]([a-zµμ]+)", re.IGNORECASE)  # a unit behind a name, as in time_ms
_UNITS = (
    (1e-9, "nanoseconds", "ns nsec nanosecond nanosekunde"),
    (1e-6, "microseconds", "us µs μs usec µsec μsec microsecond mikrosekunde"),
    (1e-3, "milliseconds", "ms msec millisecond millisekunde"),
    (1.0, "seconds", "s sec second sek sekunde"),
    (60.0, "minutes", "min minute"),
    (3600.0, "hours", "h hr hour std stunde"),
    (86400.0, "days", "d day tag tage"),
    (1e3, "kiloseconds", "ks kilosecond"),
)
"""Units of time: seconds, name, and spellings without endings such as the plural s."""

_SECONDS = {spelling: one for one, _, spellings in _UNITS for spelling in spellings.split()}
_KNOWN = "s, ms, us, ns, min, h or d"

THOUSANDTHS = {one: name for one, name, _ in _UNITS[2::-1]}
"""Units in which stamps may count without naming them, by their seconds."""

_SINCE_1970 = (1e9, 4e9)  # seconds: the years 2001 to 2096


class TimeUnit(NamedTuple):
    """A unit of time in seconds, and its name if it is assumed, as the file does not name it."""

    seconds: float
    assumed: str = ""


def is_time(channel: Channel) -> bool:
    """Tell if a column has a name for time, as ``Time`` or ``time_ms``."""
    return _NAMES.fullmatch(_named(channel)[0]) is not None


def time_unit(t: Array, channel: Channel) -> TimeUnit:
    """Return the unit of time stamps, from header or size; refuse stamps with several choices."""
    written = _named(channel)[1]
    if written:
        seconds = _seconds(written)
        if seconds is None:
            raise UnevenError(
                f"has the unit {written!r}, which is not a unit of time ({_KNOWN})", 0, "correct it"
            )
        return TimeUnit(seconds)
    known = t[np.isfinite(t)]
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 0.0)
    for seconds, name in THOUSANDTHS.items():
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


def seconds(t: Array, channel: Channel) -> tuple[Array, str]:
    """Time stamps (T,) in s, with missing ones filled in, and the unit if it is assumed."""
    unit, known = time_unit(t, channel), np.flatnonzero(np.isfinite(t))
    if not known.size:
        raise UnevenError("has no values", 0)
    k, T = np.arange(len(t)), len(t)
    step = float(np.median(np.diff(t[known]) / np.diff(known))) if known.size > 1 else 0.0
    filled = np.interp(k, known, t[known])
    filled[: known[0]] -= step * np.arange(known[0], 0, -1)
    filled[known[-1] + 1 :] += step * np.arange(1, T - known[-1])
    return filled * unit.seconds, unit.assumed


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
