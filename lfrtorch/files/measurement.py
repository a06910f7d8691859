"""What one file measured: inputs and outputs on an even grid of time, in stretches without gaps."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lfrtorch._support.checks import number
from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array, Booleans, Integers
from lfrtorch.files.formats import Table, open_table
from lfrtorch.files.table import BLOCK, Columns
from lfrtorch.files.time_stamps import Sampling, UnevenError, in_seconds, is_time, sampling
from lfrtorch.records import Channel

Gaps = Literal["error", "split"]

GLANCE = 1000
"""Samples that show of most columns that they are no grid of time."""

_SAME = 1e-3  # relative: sampling frequencies that do not contradict one another


@dataclass(frozen=True)
class Wanted:
    """What is read of every file; see :func:`lfrtorch.load_records`."""

    inputs: Columns | None
    outputs: Columns | None
    fs: float | None = None
    time: str | int | None = None
    units: Mapping[str | int, str] = field(default_factory=dict)
    gaps: Gaps = "error"
    reference: Columns | None = None

    def __post_init__(self) -> None:
        if self.fs is not None:
            number("fs", self.fs, positive=True)


class Stretch(NamedTuple):
    """Consecutive samples: u (T, nu), y (T, ny), and which sample of the file is the first.

    ``reference`` (T, nr) is that of the inputs, if one was asked for.
    """

    u: Array
    y: Array
    first: int
    reference: Array | None = None


@dataclass(frozen=True)
class Measurement:
    """One file."""

    path: Path
    fs: float
    inputs: tuple[Channel, ...]
    outputs: tuple[Channel, ...]
    stretches: list[Stretch]
    notes: list[str]


def read_measurement(path: Path, wanted: Wanted) -> Measurement:
    """Inputs and outputs of a file, and its sampling frequency.

    Raises:
        ValueError: columns that are not there, infinite values, gaps that are not to be split at,
            time stamps that are no even grid, or no sampling frequency or two of them.
    """
    table = open_table(path)
    u = table.find(wanted.inputs, "inputs")
    y = table.find(wanted.outputs, "outputs")
    r = () if wanted.reference is None else table.find(wanted.reference, "reference")
    if r and len(r) != len(u):
        raise InputError(
            f"reference is {wanted.reference!r}, {len(r)} column(s) for {len(u)} input(s); name "
            "one for each input."
        )
    stamps = () if wanted.time is None else table.find(wanted.time, "time")
    if len(stamps) > 1:
        raise InputError(f"time is {wanted.time!r}, which is {len(stamps)} columns; name one.")
    columns = (*u, *y, *r, *stamps)
    twice = [table.headers[i] for i, count in Counter(columns).items() if count > 1]
    if twice:
        raise InputError(
            f"'{path}': {', '.join(map(repr, twice))} stands twice in inputs, outputs, "
            "reference and time; name every column once."
        )
    notes, fs = [*table.notes], wanted.fs
    if fs is None and not stamps:
        rate = find_rate(table, columns)
        if rate is None:
            raise InputError(
                f"the sampling frequency of '{path}' is not known; give fs=HZ"
                f"{_suggested(table, columns)}."
            )
        fs, stamps = rate.fs, rate.stamps
        columns = (*columns, *stamps)
        notes.append(rate.note)
    known = {name for i in (*u, *y) for name in (table.headers[i], table.columns[i].name, i)}
    strange = [name for name in wanted.units if name not in known]
    if strange:
        raise InputError(
            f"units names {', '.join(map(repr, strange))}, which is none of the inputs and "
            f"outputs: {', '.join(table.columns[i].name for i in (*u, *y))}."
        )
    values = table.read(columns)
    present = np.flatnonzero(~np.isnan(values).all(axis=1))
    values = values[: present[-1] + 1 if present.size else 0]  # spreadsheets end in empty lines
    _refuse_infinite(table, values, columns)
    missing = np.asarray(np.isnan(values).any(axis=1))
    grid = None
    if stamps and not missing.all():
        grid = _grid(table, values[:, -1], stamps[0])
        _agree(wanted, grid, table, stamps[0])
    elif wanted.fs is not None:
        notes += _doubts(table, columns, wanted.fs)
    stretches = _stretches(missing, np.array([], np.int64) if grid is None else grid.gaps)
    if len(values) and (missing.any() or len(stretches) > 1) and wanted.gaps == "error":
        raise _gap(table, values, columns, grid)
    if not stretches:
        raise InputError(f"'{path}' has no sample in which all columns have a value.")
    ends = np.cumsum([0, len(u), len(y), len(r)])
    parts = [slice(a, b) for a, b in pairwise(ends)]
    fs = fs if grid is None else grid.fs
    assert fs is not None
    return Measurement(
        path,
        fs,
        _channels(table, u, wanted.units),
        _channels(table, y, wanted.units),
        [
            Stretch(
                values[a:b, parts[0]],
                values[a:b, parts[1]],
                int(a),
                values[a:b, parts[2]] if r else None,
            )
            for a, b in stretches
        ],
        notes,
    )


def _channels(
    table: Table, columns: Sequence[int], units: Mapping[str | int, str]
) -> tuple[Channel, ...]:
    """Channels with the units that are given by name, by header or by number."""
    found = []
    for i in columns:
        channel = table.columns[i]
        given = (units[key] for key in (channel.name, table.headers[i], i) if key in units)
        found.append(Channel(channel.name, next(given, channel.unit)))
    return tuple(found)


def _stretches(missing: Booleans, gaps: Integers) -> list[tuple[int, int]]:
    """First and last sample + 1 of the stretches without a missing value or a gap between."""
    edges = np.flatnonzero(np.diff(np.concatenate([[True], missing, [True]]).astype(np.int8)))
    edges = np.union1d(edges, gaps)
    return [(int(a), int(b)) for a, b in pairwise(edges) if not missing[a]]


def _refuse_infinite(table: Table, values: NDArray, columns: Sequence[int]) -> None:
    infinite = np.isinf(values)
    if infinite.any():
        sample, i = np.argwhere(infinite)[0]
        raise InputError(
            f"'{table.path}': {infinite.sum()} infinite value(s), the first at "
            f"{table.where(int(sample))} in column {table.headers[columns[i]]!r}; correct them, or "
            "leave the cells empty."
        )


def _gap(
    table: Table, values: NDArray, columns: Sequence[int], grid: Sampling | None
) -> ValueError:
    """What is missing, and what to do."""
    empty = np.isnan(values)
    rows = empty.any(axis=1)
    said = []
    if rows.any():
        sample = int(np.argmax(rows))
        places = int(np.count_nonzero(np.diff(np.append(False, rows).astype(np.int8)) == 1))
        column = table.headers[columns[int(np.argmax(empty[sample]))]]
        said.append(
            f"{rows.sum()} sample(s) have missing values, in {places} place(s), the first at "
            f"{table.where(sample)} in column {column!r}"
        )
    if grid is not None and grid.gaps.size:
        said.append(
            f"the time stamps have {grid.gaps.size} gap(s) of {grid.missing.sum()} sample(s) in "
            f"all, the first before {table.where(int(grid.gaps[0]))}"
        )
    return InputError(
        f"'{table.path}': {', and '.join(said)}.\nFill the gaps, or gaps='split' takes every "
        "stretch between them for a record of its own."
    )


def _grid(table: Table, t: Array, column: int) -> Sampling:
    """The grid of time stamps, those that are missing filled in."""
    known = np.isfinite(t)
    k = np.arange(len(t))
    try:
        return sampling(in_seconds(np.interp(k, k[known], t[known]), table.columns[column]))
    except UnevenError as error:
        raise InputError(
            f"'{table.path}': the time column {table.headers[column]!r} {error}, at "
            f"{table.where(error.sample)}; resample the signals to an even grid, or give fs "
            "without time if the column is wrong."
        ) from error


def _agree(wanted: Wanted, grid: Sampling, table: Table, column: int) -> None:
    if wanted.fs is not None and abs(wanted.fs / grid.fs - 1) > max(_SAME, grid.uncertainty):
        raise InputError(
            f"fs is {wanted.fs:g} Hz and the time column {table.headers[column]!r} of "
            f"'{table.path}' says {grid.fs:g} Hz; leave fs or time out, whichever is "
            "wrong."
        )


class Rate(NamedTuple):
    """The sampling frequency in Hz that a file says, by which column if it is one, and a note."""

    fs: float
    stamps: tuple[int, ...]
    note: str


def find_rate(table: Table, used: Sequence[int]) -> Rate | None:
    """What a file says of its sampling frequency; nothing if it says none.

    That is a column which is named as time is and runs evenly, or else a lone number like ``Fs``.

    Args:
        table: the file.
        used: columns that are something else.

    Raises:
        ValueError: two of them that contradict one another.
    """
    times, _ = _beside(table, used, named=True)
    said = [(f"the column {table.columns[c].name!r}", g.fs, g.uncertainty) for c, g in times]
    said += [(repr(name), fs, 0.0) for name, fs in table.rates.items()]
    if not said:
        return None
    for name, fs, uncertainty in said[1:]:
        if abs(fs / said[0][1] - 1) > max(_SAME, uncertainty, said[0][2]):
            raise InputError(
                f"'{table.path}': {said[0][0]} says {said[0][1]:g} Hz and {name} {fs:g} Hz; give "
                "the right one, fs=HZ or time=COLUMN."
            )
    name, fs, _ = said[0]
    if not times:
        return Rate(fs, (), f"fs is {fs:g} Hz, as {name} in the file says")
    return Rate(
        fs, (times[0][0],), f"{name} is taken for the time, {fs:g} Hz; fs=HZ leaves it unread"
    )


def _first(table: Table, columns: Sequence[int], samples: int) -> dict[int, Array]:
    """The first samples of the columns that are numbers, read together as far as possible."""
    if not columns:
        return {}
    try:
        block = next(table.blocks(columns, samples), np.empty((0, len(columns))))
    except ValueError:  # no numbers, in some of them
        half = len(columns) // 2
        return _first(table, columns[:half], samples) | (
            _first(table, columns[half:], samples) if half else {}
        )
    return dict(zip(columns, block.T, strict=True))


def _sampling(t: Array, channel: Channel) -> Sampling:
    """The grid of stamps, what is missing between filled in."""
    known = np.flatnonzero(np.isfinite(t))
    if known.size:
        t = np.interp(np.arange(known[-1] + 1), known, t[known])
    return sampling(in_seconds(t, channel))


def _beside(
    table: Table, columns: Sequence[int], *, named: bool
) -> tuple[list[tuple[int, Sampling]], list[str]]:
    """Columns that are none of those and an even grid of time, and why others are none.

    Args:
        table: the file, of which the first block is read.
        columns: what is measured.
        named: look only at columns that are named as time is.
    """
    left = [
        column
        for column, channel in enumerate(table.columns)
        if column not in columns
        and not (table.lengths and table.lengths[column] != table.lengths[columns[0]])
        and (is_time(channel) or not named)
    ]
    reasons: dict[int, str] = {}
    grids: dict[int, Sampling] = {}
    for samples in (BLOCK,) if named else (GLANCE, BLOCK):
        grids.clear()
        for column, t in _first(table, left, samples).items():
            try:
                grids[column] = _sampling(t, table.columns[column])
            except UnevenError as error:
                reasons[column] = f"the column {table.headers[column]!r} {error}"
        left = list(grids)
    return list(grids.items()), [reasons[column] for column in sorted(reasons)]


def unusable_time(table: Table, used: Sequence[int]) -> str:
    """Why a column that is named as time is none; empty if there is no such column."""
    _, reasons = _beside(table, used, named=True)
    return reasons[0] if reasons else ""


def _suggested(table: Table, columns: Sequence[int]) -> str:
    """The column that may be time, or why none is, as the end of a message."""
    reason = unusable_time(table, columns)
    if reason:
        return f"; {reason}"
    # A counter of samples is a grid of 1 Hz.
    grids = [(c, g) for c, g in _beside(table, columns, named=False)[0] if g.fs != 1]
    if not grids:
        return ""
    column, grid = grids[0]
    return f", or by a column of time stamps: time={table.columns[column].name!r} ({grid.fs:g} Hz)"


def _doubts(table: Table, columns: Sequence[int], fs: float) -> list[str]:
    """Notes if a column that is named as time is, or a lone number, contradicts ``fs``."""
    notes = [
        f"fs is {fs:g} Hz and the column {table.headers[column]!r} says {grid.fs:g} Hz; if "
        f"that is right, give time={table.columns[column].name!r} in place of fs"
        for column, grid in _beside(table, columns, named=True)[0]
        if abs(fs / grid.fs - 1) > max(_SAME, grid.uncertainty)
    ]
    return notes + [
        f"fs is {fs:g} Hz and {name!r} in the file says {said:g} Hz"
        for name, said in table.rates.items()
        if abs(fs / said - 1) > _SAME
    ]
