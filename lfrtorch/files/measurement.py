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
from lfrtorch.files.time_stamps import Sampling, TwiceError, UnevenError, column_sampling, is_time
from lfrtorch.records import Channel, interpolated

Gaps = Literal["error", "split"]

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
    """Consecutive samples without a gap."""

    u: Array  # (T, nu)
    y: Array  # (T, ny)
    first: int  # sample of the file
    reference: Array | None = None  # (T, nr), if one was asked for
    valid: Booleans | None = None  # (T, ny): False for outputs without a value, interpolated


@dataclass(frozen=True)
class Measurement:
    """One file."""

    path: Path
    fs: float
    inputs: tuple[Channel, ...]
    outputs: tuple[Channel, ...]
    stretches: list[Stretch]
    notes: list[str]


def read_measurement(source: Path | Table, wanted: Wanted) -> Measurement:
    """Read inputs, outputs and sampling frequency of a file; refuse gaps, unless to be split."""
    table = source if isinstance(source, Table) else open_table(source)
    path = table.path
    inputs, outputs, told = table.by_name(wanted.inputs, wanted.outputs)
    u = table.find(inputs, "inputs")
    y = table.find(outputs, "outputs")
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
    notes, fs, beside = list[str](), wanted.fs, ()
    if fs is not None and not stamps:
        beside, notes = _beside_rate(table, columns, fs)
    elif not stamps:
        rate = find_rate(table, columns)
        if rate is None:
            raise InputError(
                f"the sampling frequency of '{path}' is not known; give fs=HZ"
                f"{_suggested(table, columns)}."
            )
        fs, stamps = rate.fs, rate.stamps
        columns = (*columns, *stamps)
        notes = [rate.note]
    known = {name for i in (*u, *y) for name in (table.headers[i], table.columns[i].name, i)}
    strange = [name for name in wanted.units if name not in known]
    if strange:
        raise InputError(
            f"units names {', '.join(map(repr, strange))}, which is none of the inputs and "
            f"outputs: {', '.join(table.columns[i].name for i in (*u, *y))}."
        )
    try:
        values = table.read((*columns, *beside))
    except InputError:  # further on than was looked at, what is beside may have words
        beside = ()
        values = table.read(columns)
    present = np.flatnonzero(~np.isnan(values[:, : len(columns)]).all(axis=1))
    values = values[: present[-1] + 1 if present.size else 0]  # spreadsheets end in empty lines
    values, t = values[:, : len(columns)], values[:, -1]
    _refuse_infinite(table, values, columns)
    ends = np.cumsum([0, len(u), len(y), len(r)])
    parts = [slice(a, b) for a, b in pairwise(ends)]
    needed = np.arange(len(columns))
    if wanted.gaps == "error":  # an output without a value leaves no gap
        needed = np.delete(needed, parts[1])
    missing = np.asarray(np.isnan(values[:, needed]).any(axis=1))
    grid = None
    if stamps and not missing.all():
        grid = _grid(table, t, stamps[0])
        _agree(wanted, grid, table, stamps[0])
        fs = grid.fs
        if grid.unit and wanted.time is not None:
            notes.append(f"{_called(table, stamps[0])} is taken for {grid}")
    elif beside:
        grid, doubts = _beside_fs(table, t, beside[0])
        notes += doubts
    stretches = _stretches(missing, np.array([], np.int64) if grid is None else grid.gaps)
    if len(values) and (missing.any() or len(stretches) > 1) and wanted.gaps == "error":
        raise _gap(table, values[:, needed], [columns[i] for i in needed], grid, beside)
    if not stretches:
        raise InputError(f"'{path}' has no sample in which all columns have a value.")
    assert fs is not None
    outputs = values[:, parts[1]]
    valid = np.isfinite(outputs)
    if wanted.gaps == "error" and not valid.all():
        sample, i = np.argwhere(~valid)[0]
        notes.append(
            f"{(~valid).sum()} output sample(s) have no value, the first at "
            f"{table.where(int(sample))} in column {table.headers[y[i]]!r}: they are simulated "
            "through, and neither fitted nor scored"
        )
        outputs = interpolated(outputs, valid)
    return Measurement(
        path,
        fs,
        _channels(table, u, wanted.units),
        _channels(table, y, wanted.units),
        [
            Stretch(
                values[a:b, parts[0]],
                outputs[a:b],
                int(a),
                values[a:b, parts[2]] if r else None,
                None if valid[a:b].all() else valid[a:b],
            )
            for a, b in stretches
        ],
        [*table.notes, *told, *notes],
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
    table: Table,
    values: NDArray,
    columns: Sequence[int],
    grid: Sampling | None,
    beside: Sequence[int],
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
        + "".join(_renamed(table, column) for column in beside)
    )


def _grid(table: Table, t: Array, column: int) -> Sampling:
    """The grid of time stamps, those that are missing filled in."""
    try:
        return column_sampling(t, table.columns[column])
    except UnevenError as error:
        raise InputError(
            f"'{table.path}': the time column {_uneven(table, column, error)}; {error.remedy}, or "
            "give fs without time if the column is wrong."
        ) from error


def _uneven(table: Table, column: int, error: UnevenError) -> str:
    return f"{table.headers[column]!r} {error}, at {table.where(error.sample)}"


def _beside_fs(table: Table, t: Array, column: int) -> tuple[Sampling | None, list[str]]:
    """The grid of a column that is not named as time by the user, and doubts if it is none."""
    doubts, missing = [], np.isnan(t)
    name = table.headers[column]
    if missing.any():
        doubts.append(
            f"the column {name!r} has no value in {missing.sum()} sample(s), the first at "
            f"{table.where(int(np.argmax(missing)))}"
        )
    try:
        return column_sampling(t, table.columns[column]), doubts
    except UnevenError as error:
        return None, [*doubts, _lost(table, column, error)]


def _lost(table: Table, column: int, error: UnevenError) -> str:
    """Note that a column runs at the given frequency, but not evenly; refuse samples twice."""
    said = f"the column {_uneven(table, column, error)}"
    if isinstance(error, TwiceError):
        raise InputError(f"'{table.path}': {said}; {error.remedy}.{_renamed(table, column)}")
    return f"{said}: samples are lost or doubled unless it is wrong; {error.remedy}"


def _renamed(table: Table, column: int) -> str:
    return f" If {table.headers[column]!r} is no time, give it another name."


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
    """Return what a file says of its sampling frequency, None if nothing."""
    # It is a column that is named as time is and runs evenly, or else a lone number like ``Fs``.
    # Columns ``used`` are something else. Two that contradict one another are refused.
    times, _ = _beside(table, used, named=True)
    said = [(_called(table, c), g.fs, g.uncertainty) for c, g in times]
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
    return Rate(fs, (times[0][0],), f"{name} is taken for {times[0][1]}")


def _called(table: Table, column: int) -> str:
    return f"the column {table.columns[column].name!r}"


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


def _beside(
    table: Table, columns: Sequence[int], *, named: bool
) -> tuple[list[tuple[int, Sampling]], list[tuple[int, UnevenError]]]:
    """Find even grids of time among the columns that are not measured, and why others are none."""
    known = set(columns)
    left = [
        column
        for column, channel in enumerate(table.columns)
        if column not in known
        and not (table.lengths and table.lengths[column] != table.lengths[columns[0]])
        and (is_time(channel) or not named)
    ]
    reasons: dict[int, UnevenError] = {}
    grids: dict[int, Sampling] = {}
    # A few samples show of most columns that they are no grid of time.
    for samples in (BLOCK,) if named else (1000, BLOCK):
        grids.clear()
        for column, t in _first(table, left, samples).items():
            try:
                grids[column] = column_sampling(t, table.columns[column])
            except UnevenError as error:
                reasons[column] = error
        left = list(grids)
    return list(grids.items()), sorted(reasons.items())


def unusable_time(table: Table, used: Sequence[int]) -> str:
    """Why a column that is named as time is none; empty if there is no such column."""
    for column, error in _beside(table, used, named=True)[1]:
        return f"the column {table.headers[column]!r} {error}"
    return ""


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


def _beside_rate(
    table: Table, columns: Sequence[int], fs: float
) -> tuple[tuple[int, ...], list[str]]:
    """A column that is named as time is and runs at ``fs``, in some unit, and what contradicts."""
    grids, reasons = _beside(table, columns, named=True)
    agree, notes = [], []
    for column, grid in grids:
        ratio = fs / grid.fs
        if abs(ratio - 1) > max(_SAME, grid.uncertainty):
            notes.append(
                f"fs is {fs:g} Hz and the column {table.headers[column]!r} says {grid.fs:g} Hz; if "
                f"that is right, give time={table.columns[column].name!r} in place of fs"
            )
        if _agrees(ratio, max(_SAME, grid.uncertainty)):
            agree.append(column)
    notes += [
        f"fs is {fs:g} Hz and {name!r} in the file says {said:g} Hz"
        for name, said in table.rates.items()
        if abs(fs / said - 1) > _SAME
    ]
    if agree:
        return (agree[0],), notes
    # The usual step of stamps that are uneven is of that frequency.
    return (), notes + [
        _lost(table, column, error)
        for column, error in reasons
        if error.fs and _agrees(fs / error.fs, 0.1)
    ]


def _agrees(ratio: float, tolerance: float) -> bool:
    """Whether two sampling frequencies are the same, if one is in ms, us or ns, too."""
    return abs(ratio / 1000.0 ** round(np.log10(ratio) / 3) - 1) <= tolerance
