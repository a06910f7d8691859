"""Channels that have their own times, as loggers store them, as a table on even clocks.

Channels that are read together are put on one clock. If all of them have the same even stamps,
these are the clock. Otherwise the clock is even, at their mean rate, over the time in which all of
them run, and straight lines join their samples. If two neighbouring samples are several steps
apart, there is a hole without values (NaN). A channel that is logged on change is held between its
samples and after the last one. Channels of different rates are refused together, unless the path
ends in a rate for all: ``drive.mf4#50Hz``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lfrtorch._support.errors import InputError, brief
from lfrtorch._support.types import Array
from lfrtorch.files.table import BLOCK, Table, rate_behind

_UNEVEN = 0.01
"""Largest deviation of a time from an even clock, relative to a step."""

_SAME = 0.01
"""Largest relative difference of rates that count as one."""

_HOLE = 5
"""More steps than this without a sample are a hole; fewer may be jitter of messages."""

_RARE = 0.05
"""Largest part of all steps that are holes."""

_LIKE = 0.2
"""A step is usual if it differs from the median step of its clock by at most this part."""

_MOST = 0.75
"""A clock has a rate if at least this part of its steps is usual."""

_FEW = 10
"""Fewer samples than this do not show a rate."""

_SLOWER = 2
"""A channel logged on change is slower than another one by at least this ratio."""

_FAR = 20
"""The same ratio for a channel without other signs that it is logged on change."""


class Series(NamedTuple):
    """One channel: times in seconds and values, each (samples,), its unit, and a note on it."""

    t: Array
    values: Array
    unit: str = ""
    note: str = ""


@dataclass(frozen=True, eq=False)
class _Clock:
    """Instants of samples; a step that is longer than ``hole`` (s) is a hole."""

    t: Array
    hole: float
    fs: float  # Hz, the mean between holes
    group: int  # number of the group of clocks with the same rate
    even: bool  # whether it runs evenly between holes


class _Channel(NamedTuple):
    """The values of a channel at the instants of a clock, which channels may share."""

    values: Array
    clock: _Clock
    note: str


class SeriesTable(Table):
    """Channels by name, with a column of times for each rate; a text says why one is refused."""

    def __init__(self, path: Path, file: Path, found: Mapping[str, Series | str]) -> None:
        # ``path`` may be the file and a rate.
        self._asked = _asked(str(path)[len(str(file)) + 1 :]) if path != file else None
        ordered = {n: s if isinstance(s, str) else _in_order(s) for n, s in found.items()}
        refused = {name: each for name, each in ordered.items() if isinstance(each, str)}
        series = {n: s for n, s in ordered.items() if not isinstance(s, str) and len(s.t) > 1}
        if not series:
            why = brief("; ".join(f"{name!r} {reason}" for name, reason in refused.items()))
            raise InputError(
                f"'{file}' has no channel of two samples or more{f': {why}' if why else ''}."
            )
        clocks = _clocks([each.t for each in series.values()], one=self._asked is not None)
        self._longest = [
            max((clock for clock in clocks if clock.group == i), key=lambda c: c.t[-1] - c.t[0])
            for i in range(1 + max(clock.group for clock in clocks))
        ]
        headers = ["time", *(f"time_{i + 1}" for i in range(1, len(self._longest)))]
        units = dict.fromkeys(headers, "s")
        self._channels: dict[int, _Channel] = {}
        for (name, each), clock in zip(series.items(), clocks, strict=True):
            header = name if name not in headers else f"channel {name}"
            self._channels[len(headers)] = _Channel(each.values, clock, each.note)
            headers.append(header)
            units[header] = each.unit
        groups = [*range(len(self._longest)), *(clock.group for clock in clocks)]
        lengths = [len(self._longest[group].t) for group in groups]
        times = range(len(self._longest))
        super().__init__(path, headers, units=units, refused=refused, lengths=lengths, clocks=times)
        self._t = np.empty(0)  # of the samples that were read last

    def blocks(self, columns: Sequence[int], samples: int = BLOCK) -> Iterator[Array]:
        """See :meth:`Table.blocks`."""
        held = self._held(columns)
        t = self._t = self._instants(columns, held)
        parts = []
        for i in columns:
            if i in self._channels:
                self._remark(self._channels[i].note)
                parts.append((_hold if i in held else _join)(self._channels[i], t))
            else:
                parts.append(t)
        for i in held:
            self._remark(f"{self.headers[i]!r} is logged on change and held between its samples")
        for start in range(0, len(t), samples):
            yield np.column_stack([part[start : start + samples] for part in parts])

    def beside(self, column: int, columns: Sequence[int]) -> bool:
        """See :meth:`Table.beside`."""
        held = self._held(columns)
        first = next(i for i in columns if i not in held)
        return self._clock(column).group == self._clock(first).group

    def where(self, sample: int) -> str:
        """The time of a sample, and its number."""
        return f"{self._t[sample]:.6g} s, {super().where(sample)}"

    def _clock(self, column: int) -> _Clock:
        return self._channels[column].clock if column in self._channels else self._longest[column]

    def _held(self, columns: Sequence[int]) -> list[int]:
        """Those of some columns that are logged on change, judged by the stamps of the others."""
        channels = [i for i in columns if i in self._channels]
        fastest = max(map(self._clock, channels), key=lambda clock: clock.fs, default=None)
        return [i for i in channels if fastest and _on_change(self._channels[i], fastest)]

    def _instants(self, columns: Sequence[int], held: Sequence[int]) -> Array:
        """The instants at which all columns that are not held run, and all held ones have begun.

        A time column beside channels has their times; alone, those of its longest channel.
        """
        measured = [i for i in columns if i in self._channels] or columns
        running = [i for i in measured if i not in held]
        last = max(measured, key=lambda i: self._clock(i).t[0])
        first = min(running, key=lambda i: self._clock(i).t[-1])
        begin, end = float(self._clock(last).t[0]), float(self._clock(first).t[-1])
        if begin >= end:
            raise InputError(
                f"'{self.path}': {self.headers[first]!r} ends at {end:.6g} s and "
                f"{self.headers[last]!r} begins at {begin:.6g} s: they have no time in common; "
                "name channels that were measured together."
            )
        rates = {self._clock(i).group: i for i in columns if i not in held}
        if len(rates) > 1:
            said = " and ".join(
                f"{self.headers[i]!r} at {self._clock(i).fs:.6g} Hz" for i in rates.values()
            )
            slowest = float(f"{min(self._clock(i).fs for i in rates.values()):.3g}")
            raise InputError(
                f"'{self.path}' has {said}; for one clock write '{self.path.name}#{slowest:.9g}Hz'."
            )
        clocks = {self._clock(i) for i in running}
        clock = self._clock(running[0])
        outside = max(self._clock(i).t[-1] for i in running) - end
        outside += begin - min(self._clock(i).t[0] for i in measured)
        if outside > clock.hole:
            self._remark(
                f"the channels run together from {begin:.6g} s to {end:.6g} s only: the rest is "
                "left out"
            )
        if self._asked is None and len(clocks) == 1 and clock.even:
            return clock.t[clock.t >= begin - _UNEVEN / clock.fs]
        fs = self._asked or float(f"{clock.fs:.3g}")  # any rate will do, so a round one
        self._remark(f"channels are interpolated to even times of {fs:.6g} Hz")
        self.check_memory((end - begin) * fs * len(columns))
        return begin + np.arange(int((end - begin) * fs + 1e-6) + 1) / fs

    def _remark(self, note: str) -> None:
        if note and note not in self.notes:
            self.notes = (*self.notes, note)


def _asked(text: str) -> float:
    """The rate that is asked for after the file's name."""
    fs = rate_behind(text)
    if fs is None:
        raise InputError(f"'#{text}' behind the file is not a rate; write #50Hz, for example.")
    return fs


def _in_order(series: Series) -> Series | str:
    """A channel in the order of its times, without values at no time; or why it is refused."""
    t, values = (np.asarray(part, dtype=np.float64) for part in series[:2])
    kept = np.isfinite(t)
    t, values = t[kept], values[kept]
    if (np.diff(t) <= 0).any():
        # Messages overtake one another by a few steps.
        late = np.maximum.accumulate(t) - t > _HOLE * np.ptp(t) / (len(t) - 1)
        if late.any():
            k = int(np.argmax(late))
            return (
                f"has a clock that is set back, from {t[k - 1]:.10g} s to {t[k]:.10g} s after {k} "
                "samples; give the parts before and after it as separate files"
            )
        t, first = np.unique(t, return_index=True)
        values = values[first]
    return series._replace(t=t, values=values)


def _clocks(times: Sequence[Array], *, one: bool) -> list[_Clock]:
    """The clock of each channel; clocks of one rate are a group, or all are if ``one``."""
    own: list[_Clock] = []
    found = []
    for t in times:
        clock = next((known for known in own if np.array_equal(t, known.t)), None)
        if clock is None:
            steps = np.diff(t)
            hole = _HOLE * float(np.quantile(steps, 1 - _RARE, method="lower"))
            fs = 1 / float(steps[steps <= hole].mean())
            near = (known.group for known in own if one or abs(known.fs / fs - 1) < _SAME)
            group = next(near, 1 + max((known.group for known in own), default=-1))
            own.append(clock := _Clock(t, hole, fs, group, _even(t, fs, hole)))
        found.append(clock)
    return found


def _even(t: Array, fs: float, hole: float) -> bool:
    """Tell whether a clock runs evenly between holes."""
    holes = np.flatnonzero(np.diff(t) > hole) + 1
    off = np.split(t - np.arange(len(t)) / fs, holes)
    return all(np.abs(part - part[0]).max() <= _UNEVEN / fs for part in off)


def _on_change(channel: _Channel, fastest: _Clock) -> bool:
    """Tell whether a channel is logged on change: without a rate, and slower than another one."""
    t, fs = channel.clock.t, channel.clock.fs
    steps = np.diff(t)
    like = np.abs(steps / np.median(steps) - 1) <= _LIKE
    if (like.mean() >= _MOST and len(t) >= _FEW) or _SLOWER * fs > fastest.fs:
        return False
    place = np.searchsorted(fastest.t, t - _UNEVEN / fastest.fs).clip(max=len(fastest.t) - 1)
    beside = np.abs(fastest.t[place] - t) <= _UNEVEN / fastest.fs  # logged by the same task
    levels = len(np.unique(channel.values))
    return bool(_FAR * fs <= fastest.fs or beside.mean() >= _MOST or 2 * levels <= len(t))


def _hold(channel: _Channel, t: Array) -> Array:
    """The last value at each instant; no instant is before the first value."""
    step = t[1] - t[0] if len(t) > 1 else 0.0
    return channel.values[np.searchsorted(channel.clock.t, t + _UNEVEN * step, "right") - 1]


def _join(channel: _Channel, t: Array) -> Array:
    """Straight lines between values, NaN in holes."""
    own = channel.clock.t
    if np.array_equal(own, t):
        return channel.values
    values = np.interp(t, own, channel.values, left=np.nan, right=np.nan)
    after = np.searchsorted(own, t).clip(1, len(own) - 1)
    before, after = own[after - 1], own[after]
    inside = np.minimum(t - before, after - t) > _UNEVEN / channel.clock.fs
    values[inside & (after - before > channel.clock.hole)] = np.nan
    return values
