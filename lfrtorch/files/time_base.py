"""Time base of a file's samples: a time column or a sampling frequency; and the runs in it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lfrtorch._support.errors import InputError
from lfrtorch._support.runs import Runs, find_runs, is_run, restarts
from lfrtorch._support.sampling import EvenTimes, Piece, Sampling, UnevenError, even_times
from lfrtorch._support.types import Array
from lfrtorch.files.table import BLOCK, Table
from lfrtorch.files.time_stamps import THOUSANDTHS, is_time, seconds

_SAME = 1e-3  # largest relative difference of sampling frequencies that agree


class TimeBase(NamedTuple):
    """The sampling frequency in Hz, the time column, and notes; None if unknown."""

    fs: float | None
    column: int | None = None
    notes: tuple[str, ...] = ()
    given: bool = False  # whether the user named the column
    named: bool = True  # whether a name says that it is the time
    others: tuple[int, ...] = ()  # further columns that are named as time is
    why: str = ""  # why a column that is named as time is not a time


class OnGrid(NamedTuple):
    """Samples on an even grid: its rate in Hz, the runs, the pieces of each, and notes."""

    fs: float | None
    runs: Runs
    pieces: list[list[Piece]]
    notes: list[str]

    @property
    def holes(self) -> tuple[int, int, int]:
        """Number of gaps, number of samples missing in them, and the first row after a gap."""
        found = [
            (int(b.rows[0]), round(b.start - a.start - a.places[-1]) - 1)
            for run in self.pieces
            for a, b in pairwise(run)
        ]
        return len(found), sum(n for _, n in found), found[0][0] if found else 0

    def gap(self, table: Table) -> str:
        """Where time stamps are missing."""
        count, lost, row = self.holes
        return (
            f"the time stamps have {count} gap(s) of {lost} sample(s) in all, the first before "
            f"{table.where(row)}"
        )


class _Found(NamedTuple):
    """A column of time stamps and its grid."""

    column: int
    even: EvenTimes

    @property
    def fs(self) -> float:
        """Its rate in Hz."""
        return self.even.grid.fs


def find_base(
    table: Table, used: Sequence[int], *, fs: float | None = None, stamps: Sequence[int] = ()
) -> TimeBase:
    """Return what tells the times of a file; columns ``used`` are something else.

    It is the column that the user names, else a column that is named as time is; else a lone number
    like ``Fs``; else the first other column that rises evenly. If ``fs`` is given, it is a column
    named as time is that runs at that rate, in some unit. Two that contradict are refused.
    """
    if stamps:
        return TimeBase(fs, stamps[0], given=True)
    named, reasons = _columns(table, used, named=True)
    if fs is not None:
        return _beside(table, named, fs)
    said = [(_called(table, found.column), found.fs, found.even.tolerance) for found in named]
    said += [(repr(name), rate, _SAME) for name, rate in table.rates.items()]
    for name, rate, tolerance in said[1:]:
        if abs(rate / said[0][1] - 1) > max(tolerance, said[0][2]):
            raise InputError(
                f"'{table.path}': {said[0][0]} says {said[0][1]:g} Hz and {name} {rate:g} Hz; give "
                "the right one, fs=HZ or time=COLUMN."
            )
    if said and not named:
        return TimeBase(
            said[0][1], None, (f"fs is {said[0][1]:g} Hz, as {said[0][0]} in the file says",)
        )
    found = bool(named)
    if not named and not reasons:
        # A counter of samples is a grid of 1 Hz.
        named = sorted(_columns(table, used, named=False)[0], key=lambda found: found.fs == 1)
        if named and named[0].fs == 1:
            note = f"{_called(table, named[0].column)} is taken for sample numbers"
            return TimeBase(None, named[0].column, (note,), named=False)
    if named:
        column, even = named[0]
        note = f"{_called(table, column)} is taken for {even.grid}"
        columns = tuple(each.column for each in named) if found else ()
        return TimeBase(even.grid.fs, column, (note,), named=found, others=columns)
    why = "".join(f"the column {table.headers[c]!r} {error}" for c, error in reasons[:1])
    return TimeBase(None, why=why)


def _beside(table: Table, named: Sequence[_Found], fs: float) -> TimeBase:
    """Find the column that runs at the given rate, and note what contradicts it."""
    notes, agree = [], [found.column for found in named if _agrees(fs, found)]
    for column, even in named:
        rate = even.grid.fs
        if abs(fs / rate - 1) > even.tolerance:
            unit = THOUSANDTHS.get(1 / _thousands(fs / rate), "another unit")
            notes.append(
                f"fs is {fs:g} Hz and the column {table.headers[column]!r} says {rate:g} Hz; if "
                f"that is right, give time={table.columns[column].name!r} in place of fs"
                + f", unless it is in {unit}"
                * (column in agree)
            )
    notes += [
        f"fs is {fs:g} Hz and {name!r} in the file says {said:g} Hz"
        for name, said in table.rates.items()
        if abs(fs / said - 1) > _SAME
    ]
    columns = tuple(found.column for found in named)
    return TimeBase(fs, agree[0] if agree else None, tuple(notes), others=columns)


def _agrees(fs: float, found: _Found) -> bool:
    """Tell whether a column runs at a rate, if its unit may also be ms, us or ns."""
    return abs(fs / found.fs / _thousands(fs / found.fs) - 1) <= found.even.tolerance


def _thousands(ratio: float) -> float:
    return 1000.0 ** round(np.log10(ratio) / 3)


def _called(table: Table, column: int) -> str:
    return f"the column {table.columns[column].name!r}"


def _first(table: Table, columns: Sequence[int], samples: int) -> dict[int, Array]:
    """The first samples of the columns that hold numbers, read together as far as possible."""
    if not columns:
        return {}
    try:
        block = next(table.blocks(columns, samples), np.empty((0, len(columns))))
    except ValueError:  # some of the columns do not hold numbers
        half = len(columns) // 2
        return _first(table, columns[:half], samples) | (
            _first(table, columns[half:], samples) if half else {}
        )
    return dict(zip(columns, block.T, strict=True))


def _columns(
    table: Table, used: Sequence[int], *, named: bool
) -> tuple[list[_Found], list[tuple[int, UnevenError]]]:
    """Find times among the columns that are not signals, and why others are not times."""
    usual = [length for length, _ in Counter(table.lengths).most_common(1)]
    with_them = used or [i for i, length in enumerate(table.lengths) if [length] == usual][:1]
    measured = set(used)
    left = [
        column
        for column, channel in enumerate(table.columns)
        if column not in measured
        and (not with_them or table.beside(column, with_them))
        and (not named or is_time(channel) or column in table.clocks)
    ]
    reasons: dict[int, UnevenError] = {}
    found: dict[int, _Found] = {}
    # For most columns, a few samples show that they are not evenly rising times.
    for samples in (BLOCK,) if named else (1000, BLOCK):
        found.clear()
        for column, t in _first(table, left, samples).items():
            try:
                times, unit = seconds(t, table.columns[column])
                again = restarts(times)
                even = even_times(times[: again[0]] if again.size else times)
            except UnevenError as error:
                reasons[column] = error
                continue
            if named or not (again.size or even.uneven or even.grid.gaps.size):
                even = even._replace(grid=even.grid._replace(unit=unit))
                found[column] = _Found(column, even)
        left = list(found)
    return list(found.values()), sorted(reasons.items())


def on_grid(
    table: Table,
    base: TimeBase,
    T: int,
    t: Array | None = None,
    *,
    fs: float | None = None,
    used: Sequence[int] = (),
    whole: bool = False,
) -> OnGrid:
    """Put the samples of a file on an even grid, run by run.

    Args:
        base: source of the samples' times.
        T: number of samples.
        t: (T,), as they are in the column of times.
        fs: sampling frequency in Hz that the user gave.
        used: columns that cannot be run numbers.
        whole: every missing sample is a hole, see :func:`even_times`.
    """
    times, unit = np.arange(T) / base.fs if table.asked and base.fs else None, ""
    try:
        if base.column is not None and t is not None:
            times, unit = seconds(t, table.columns[base.column])
        runs = find_runs(T, _labels(table, used, T), times)
        ends = [*map(int, runs.starts), T]
        found = OnGrid(base.fs, runs, [[Piece.of(a, b)] for a, b in pairwise(ends)], [])
        if times is not None:
            found = _at_times(table, base, times, runs, fs, whole=whole)
    except UnevenError as error:
        wrong = "give fs without time if the column is wrong"
        if fs is not None and not base.given:
            wrong = "give the column another name if it is not a time"
        raise InputError(
            f"'{table.path}': the time {_uneven(table, base, error)}; {error.remedy}, or {wrong}."
        ) from error
    if unit and base.given and found.fs:
        said = Sampling(found.fs, 0.0, runs.starts, runs.starts, unit)
        found.notes.insert(0, f"{_called(table, base.column or 0)} is taken for {said}")
    if runs.told:
        found.notes.append(f"{len(found.pieces)} runs, as {runs.told}: a record each")
    return found


def _at_times(
    table: Table,
    base: TimeBase,
    times: Array,
    runs: Runs,
    fs: float | None,
    *,
    whole: bool,
) -> OnGrid:
    """Place the samples by their times."""
    parts = [slice(a, b) for a, b in pairwise([*map(int, runs.starts), len(times)])]
    own = [_even(times, part, None, whole=whole) for part in parts]
    longest = max(own, key=lambda even: sum(len(piece.rows) for piece in even.pieces))
    rate = longest.grid.fs
    for name, even in zip(runs.names, own, strict=True):
        off = abs(even.grid.fs / rate - 1) > max(even.tolerance, longest.tolerance)
        if off and not table.asked:
            raise InputError(
                f"'{table.path}': run {name} is sampled at {even.grid.fs:g} Hz and the longest at "
                f"{rate:g} Hz; '{table.path.name}#{rate:.6g}Hz' puts all on one grid."
            )
    factor = 1.0 if fs is None or base.given else _thousands(fs / rate)
    if fs is not None and base.given and abs(fs / rate - 1) > longest.tolerance:
        raise InputError(
            f"fs is {fs:g} Hz and the time column {_header(table, base)} of '{table.path}' says "
            f"{rate:g} Hz; leave fs or time out, whichever is wrong."
        )
    if fs is not None and (longest.uneven or not base.given):
        rate = fs / factor
    rate = table.asked / factor if table.asked else rate
    found = [_even(times, part, rate, whole=whole) for part in parts]
    pieces = [piece for even in found for piece in even.pieces]
    uneven = next((even.uneven for even in found if even.uneven), None)
    why = "" if uneven is None else f"the time {_uneven(table, base, uneven)}: "
    notes = list[str]()
    if any(even.interpolated for even in found):
        notes.append(f"{why}signals are interpolated to even times of {rate * factor:g} Hz")
    elif why:
        notes.append(f"{why}samples that are off the even grid are left out")
    for piece in pieces:
        missing = piece.missing()
        if missing.any():
            row = piece.rows[np.searchsorted(piece.places, np.argmax(missing))]
            count = sum(int(each.missing().sum()) for each in pieces)
            notes.append(
                f"{count} sample(s) are missing between the others, the first before "
                f"{table.where(int(row))}: inputs are interpolated there, outputs are neither "
                "fitted nor scored"
            )
            break
    return OnGrid(rate * factor, runs, [even.pieces for even in found], notes)


def _even(times: Array, part: slice, fs: float | None, *, whole: bool) -> EvenTimes:
    """The places of a run's samples; rows and reasons count from the first sample of the file."""
    try:
        even = even_times(times[part], fs, whole=whole)
    except UnevenError as error:
        error.sample += part.start
        raise
    if even.uneven is not None:
        even.uneven.sample += part.start
    pieces = [piece._replace(rows=piece.rows + part.start) for piece in even.pieces]
    return even._replace(pieces=pieces)


def _uneven(table: Table, base: TimeBase, error: UnevenError) -> str:
    return f"column {_header(table, base)} {error}, at {table.where(error.sample)}"


def _header(table: Table, base: TimeBase) -> str:
    return "" if base.column is None else repr(table.headers[base.column])


def _labels(table: Table, used: Sequence[int], T: int) -> dict[str, NDArray[Any]]:
    """Values of columns with names for run numbers."""
    found, measured = {}, set(used)
    for i, channel in enumerate(table.columns):
        if i not in measured and is_run(channel.name):
            each = table.labels(i)[:T]
            if len(each) == T:
                found[channel.name] = each
    return found
