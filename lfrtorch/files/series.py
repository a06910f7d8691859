"""Channels that have their own times, as loggers store them, as a table on even clocks.

Channels of one clock are read together. A clock that runs unevenly, as messages do that come over a
network, is replaced by an even one of its mean rate, and so are clocks of equal rates that began at
other instants; the channels are interpolated linearly, NaN where they do not run. Channels of
different rates are refused together, unless the path ends in a rate for all: ``drive.mf4#50Hz``.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array
from lfrtorch.files.table import BLOCK, Table

_UNEVEN = 0.01
"""Of a step, that a time may be off an even clock."""

_SAME = 0.01
"""Relative difference of rates that are one."""

_HOLE = 5
"""Steps without a sample that are a gap, and not what messages do."""

_LONG = 0.5
"""Of the longest time that a channel lasts: one that lasts less does not cut the others."""

_RATE = re.compile(r"([0-9.]+)\s*(k?)Hz", re.IGNORECASE)


class Series(NamedTuple):
    """One channel: times in seconds and values, each (samples,), and its unit."""

    t: Array
    values: Array
    unit: str = ""


class _Clock(NamedTuple):
    """Instants, and their mean rate in Hz."""

    t: Array
    fs: float


class SeriesTable(Table):
    """Channels by name, with a column of times for each clock."""

    def __init__(self, path: Path, file: Path, found: Mapping[str, Series]) -> None:
        # ``path`` may name a rate behind the file.
        asked = _asked(str(path)[len(str(file)) + 1 :]) if path != file else None
        found = {name: _in_order(each) for name, each in found.items() if len(each.t) > 1}
        if not found:
            raise InputError(f"'{file}' has no channel of two samples or more.")
        clocks, of_channel, changed = _clocks([each.t for each in found.values()], asked)
        self._columns: list[Array] = []
        self._clock_of: list[int] = []
        headers, units = [], {}
        for i, clock in enumerate(clocks):
            headers.append("time" if i == 0 else f"time_{i + 1}")
            units[headers[-1]] = "s"
            self._columns.append(clock.t)
            self._clock_of.append(i)
        for (name, each), i in zip(found.items(), of_channel, strict=True):
            header = name if name not in headers else f"channel {name}"
            headers.append(header)
            units[header] = each.unit
            on, values = clocks[i].t, each.values
            if not np.array_equal(each.t, on):
                values = np.interp(on, each.t, values, left=np.nan, right=np.nan)
            self._columns.append(values)
            self._clock_of.append(i)
        self._clocks = clocks
        super().__init__(path, headers, units=units, lengths=[len(c) for c in self._columns])
        if changed:
            rates = ", ".join(f"{fs:.6g} Hz" for fs in dict.fromkeys(clocks[i].fs for i in changed))
            self.notes = (f"channels are interpolated to even times of {rates}",)

    def blocks(self, columns: Sequence[int], samples: int = BLOCK) -> Iterator[Array]:
        """See :meth:`Table.blocks`."""
        first: dict[int, int] = {}
        for column in columns:
            first.setdefault(self._clock_of[column], column)
        if len(first) > 1:
            said = " and ".join(
                f"{self.headers[column]!r} at {self._clocks[clock].fs:.6g} Hz"
                for clock, column in first.items()
            )
            slowest = min(self._clocks[clock].fs for clock in first)
            raise InputError(
                f"'{self.path}' has {said}; for one clock write '{self.path.name}#{slowest:.3g}Hz'."
            )
        T = len(self._columns[columns[0]]) if columns else 0
        for begin in range(0, T, samples):
            part = slice(begin, begin + samples)
            yield np.column_stack([self._columns[column][part] for column in columns])


def _asked(text: str) -> float:
    """The rate that stands behind a file."""
    found = _RATE.fullmatch(text.strip())
    if found is None or not float(found[1]) > 0:
        raise InputError(f"'#{text}' behind the file is no rate; write #50Hz, for example.")
    return float(found[1]) * (1000.0 if found[2] else 1.0)


def _in_order(series: Series) -> Series:
    """A channel without values that are none, in the order of time."""
    t, values = (np.asarray(part, dtype=np.float64) for part in series[:2])
    kept = np.isfinite(t)
    t, values = t[kept], values[kept]
    if (np.diff(t) <= 0).any():
        t, first = np.unique(t, return_index=True)
        values = values[first]
    return Series(t, values, series.unit)


def _clocks(
    times: Sequence[Array], asked: float | None
) -> tuple[list[_Clock], list[int], list[int]]:
    """The clocks, that of each channel, and those that channels are interpolated to."""
    if asked is not None:
        longest = max(t[-1] - t[0] for t in times)
        long = [t for t in times if t[-1] - t[0] >= _LONG * longest]
        return [_Clock(_common(long, asked), asked)], [0] * len(times), [0]
    own: list[Array] = []
    number: list[int] = []
    for t in times:
        known = (i for i, other in enumerate(own) if np.array_equal(t, other))
        found = next(known, len(own))
        own += [t] if found == len(own) else []
        number.append(found)
    groups: list[list[int]] = []
    rates = [(len(t) - 1) / (t[-1] - t[0]) for t in own]
    whole = [_gapless(t, fs) for t, fs in zip(own, rates, strict=True)]
    for i, fs in enumerate(rates):
        near = (g for g in groups if abs(rates[g[0]] / fs - 1) < _SAME and whole[i] and whole[g[0]])
        group = next((g for g in near if _together(own[i], own[g[0]])), None)
        if group is None:
            groups.append([i])
        else:
            group.append(i)
    clocks, changed, place = list[_Clock](), list[int](), dict[int, int]()
    for number_of_group, group in enumerate(groups):
        first = own[group[0]]
        fs = rates[group[0]]
        even = np.abs(first - first[0] - np.arange(len(first)) / fs).max() <= _UNEVEN / fs
        if len(group) == 1 and (even or not whole[group[0]]):
            clocks.append(_Clock(first, fs))
        else:
            fs = float(f"{fs:.3g}")  # any rate will do, so a round one
            clocks.append(_Clock(_common([own[i] for i in group], fs), fs))
            changed.append(number_of_group)
        place |= dict.fromkeys(group, number_of_group)
    return clocks, [place[i] for i in number], changed


def _common(times: Sequence[Array], fs: float) -> Array:
    """An even grid where all of the clocks run."""
    low, high = max(t[0] for t in times), min(t[-1] for t in times)
    if not (high - low) * fs >= 1.0:
        raise InputError("the channels have no common stretch of time; give their files apart.")
    return low + np.arange(int((high - low) * fs + 1e-6) + 1) / fs


def _together(t: Array, other: Array) -> bool:
    """Whether two clocks run at the same time for the most part."""
    common = min(t[-1], other[-1]) - max(t[0], other[0])
    return bool(common >= _LONG * max(t[-1] - t[0], other[-1] - other[0]))


def _gapless(t: Array, fs: float) -> bool:
    """Whether no stretch of several steps is without a sample."""
    return bool(np.diff(t).max() * fs < _HOLE)
