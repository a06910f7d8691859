"""Measurement in one file: the roles of its columns, their clock, and signals on an even grid.

:func:`read_measurement` refuses what a model cannot be fitted to; :func:`look_at` reads the
beginning of any file, and says what is odd.
"""

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
from lfrtorch._support.runs import find_runs, is_run
from lfrtorch._support.sampling import Piece
from lfrtorch._support.types import Array, Booleans
from lfrtorch.data.records import Channel, check_largest, check_rate, interpolated
from lfrtorch.files.formats import Table, open_table
from lfrtorch.files.table import BLOCK, Columns
from lfrtorch.files.time_base import OnGrid, TimeBase, find_base, on_grid

Gaps = Literal["error", "split"]

LARGEST = 2**22
"""Values that :func:`look_at` reads at most, over all channels."""


@dataclass(frozen=True)
class Wanted:
    """Selection of signals to read from every file; see :func:`lfrtorch.load_records`."""

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
    begins: bool  # whether it begins a run
    run: str  # name of the run; empty if the file has only one run
    reference: Array | None = None  # (T, nr), if wanted
    valid: Booleans | None = None  # (T, ny): False for outputs without a value, interpolated


@dataclass(frozen=True, eq=False)
class Measurement:
    """One file."""

    path: Path
    fs: float | None  # Hz; None if look_at does not find it
    inputs: tuple[Channel, ...]
    outputs: tuple[Channel, ...]  # from look_at: all signals, if no inputs or outputs are named
    stretches: list[Stretch]  # from look_at: the longest run, NaN where a value is missing
    notes: list[str]  # which columns and which times were assumed
    doubts: list[str] = field(default_factory=list)  # problems with the time stamps

    @property
    def u(self) -> Array:
        """Inputs of the first stretch, (T, nu)."""
        return self.stretches[0].u

    @property
    def y(self) -> Array:
        """Outputs of the first stretch, (T, ny)."""
        return self.stretches[0].y


class _Roles(NamedTuple):
    """Numbers of the columns."""

    u: tuple[int, ...]
    y: tuple[int, ...]
    r: tuple[int, ...]
    stamps: tuple[int, ...]


def read_measurement(source: Path | Table, wanted: Wanted) -> Measurement:
    """Read inputs, outputs and sampling frequency of a file; refuse gaps unless they are split."""
    table = source if isinstance(source, Table) else open_table(source)
    (u, y, r, stamps), told = _roles(table, wanted, needed=True)
    columns = (*u, *y, *r, *stamps)
    base = find_base(table, columns, fs=wanted.fs, stamps=stamps)
    if base.fs is None and not base.given:
        raise InputError(
            f"the sampling frequency of '{table.path}' is not known; give fs=HZ"
            f"{'; ' if base.why else ''}{base.why}."
        )
    channels = _channels(table, (*u, *y), wanted.units)
    beside = () if base.column is None or base.column in columns else (base.column,)
    if beside and wanted.fs is None:
        columns, beside = (*columns, *beside), ()
    try:
        values = table.read((*columns, *beside))
    except InputError:  # with fs given the time column is only a check; later rows may hold words
        base, beside = base._replace(column=None), ()
        values = table.read(columns)
    values, t = _to_the_end(values, len(columns))
    _refuse_infinite(table, values, columns)
    ends = np.cumsum([0, len(u), len(y), len(r)])
    parts = [slice(a, b) for a, b in pairwise(ends)]
    needed = np.arange(len(columns))
    if wanted.gaps == "error":  # an output without a value is not a gap
        needed = np.delete(needed, parts[1])
    missing = np.asarray(np.isnan(values[:, needed]).any(axis=1))
    grid = on_grid(
        table,
        base,
        len(values),
        None if base.column is None or missing.all() else t,
        fs=wanted.fs,
        used=columns,
        whole=wanted.gaps == "split",
    )
    if len(values) and wanted.gaps == "error" and (missing.any() or grid.holes[0]):
        raise _gap(table, values[:, needed], [columns[i] for i in needed], grid, beside)
    stretches = [
        stretch
        for name, pieces in zip(grid.runs.names, grid.pieces, strict=True)
        for stretch in _stretches(values, pieces, parts, wanted.gaps, name)
    ]
    if not stretches:
        raise InputError(f"'{table.path}' has no sample in which all columns have a value.")
    notes = [*table.notes, *told, *base.notes, *grid.notes]
    empty = np.isnan(values[:, parts[1]])
    if wanted.gaps == "error" and empty.any():
        sample, i = np.argwhere(empty)[0]
        notes.append(
            f"{empty.sum()} output sample(s) have no value, the first at "
            f"{table.where(int(sample))} in column {table.headers[y[i]]!r}: the model is "
            "simulated there, but these samples are neither fitted nor scored"
        )
    nu = len(u)
    return Measurement(table.path, grid.fs, channels[:nu], channels[nu:], stretches, notes)


def look_at(
    table: Table,
    inputs: Columns | None = None,
    outputs: Columns | None = None,
    *,
    time: str | int | None = None,
    fs: float | None = None,
) -> Measurement:
    """Read the first samples of a file: of all signals, unless inputs or outputs are given."""
    # If one side is given, the other columns are the other side.
    u, y, base, remarks = _guessed(table, Wanted(inputs, outputs, fs, time))
    columns, doubts = (*u, *y), [base.why] if base.why else []
    read = columns if base.column is None else (*columns, base.column)
    values, more = _beginning(table, read)
    values, t = _to_the_end(values, len(columns) + (fs is None))
    if not len(values):
        raise InputError(f"'{table.path}' has no values in the columns to show.")
    try:
        timed = base.column is not None and (base.fs is not None or base.given)
        grid = on_grid(table, base, len(values), t if timed else None, fs=fs, used=columns)
    except InputError as error:
        doubts.append(str(error).partition(": ")[2])
        grid = on_grid(table, TimeBase(fs), len(values), fs=fs, used=columns)
    (remarks if fs is None else doubts).extend(base.notes)
    remarks += grid.notes
    if more:
        remarks.append(f"only the first {len(values)} samples are read")
    longest = max(grid.pieces, key=lambda run: sum(len(piece.rows) for piece in run))
    name = grid.runs.names[grid.pieces.index(longest)]
    if len(grid.pieces) > 1:
        remarks.append(f"the rows below are for the longest run, {name}")
    if grid.holes[0]:
        doubts.append(f"{grid.gap(table)}: data.gaps=split cuts the record there")
    signals = _joined(longest, values[:, : len(columns)], len(u))
    for i, signal in zip(columns, signals.T, strict=True):
        known = np.abs(signal[np.isfinite(signal)])
        check_largest(f"'{table.path}': {table.columns[i].name!r}", known.max(initial=0.0))
    if grid.fs is not None:
        check_rate(f"'{table.path}': the sampling frequency", grid.fs)
    channels, nu = _channels(table, columns, {}), len(u)
    whole = [Stretch(signals[:, :nu], signals[:, nu:], begins=True, run=name)]
    notes = [*table.notes, *remarks]
    return Measurement(table.path, grid.fs, channels[:nu], channels[nu:], whole, notes, doubts)


def _roles(table: Table, wanted: Wanted, *, needed: bool) -> tuple[_Roles, list[str]]:
    """Return the columns that are named, or whose names leave no doubt, and a note on these."""
    inputs, outputs, told = wanted.inputs, wanted.outputs, list[str]()
    if needed or (inputs is None and outputs is None):
        inputs, outputs, told = table.by_name(inputs, outputs)
    sides = {"inputs": inputs, "outputs": outputs}
    sides |= {"reference": wanted.reference, "time": wanted.time}
    found = _Roles(
        *(
            table.find(columns, side)
            if columns is not None or (needed and side in ("inputs", "outputs"))
            else ()
            for side, columns in sides.items()
        )
    )
    if found.r and len(found.r) != len(found.u):
        raise InputError(
            f"reference is {wanted.reference!r}, {len(found.r)} column(s) for {len(found.u)} "
            "input(s); name one for each input."
        )
    if len(found.stamps) > 1:
        raise InputError(
            f"time is {wanted.time!r}, which is {len(found.stamps)} columns; name one."
        )
    named = Counter(i for side in found for i in side)
    twice = [table.headers[i] for i, count in named.items() if count > 1]
    if twice:
        raise InputError(
            f"'{table.path}': {', '.join(map(repr, twice))} stands twice in inputs, outputs, "
            "reference and time; name every column once."
        )
    return found, told


def _guessed(
    table: Table, wanted: Wanted
) -> tuple[tuple[int, ...], tuple[int, ...], TimeBase, list[str]]:
    """Return inputs and outputs, what tells their times, and remarks on the choice."""
    (u, y, _, stamps), remarks = _roles(table, wanted, needed=False)
    named = [*u, *y, *stamps]
    if not table.contents:
        remarks += [f"left out: {name!r} {reason}" for name, reason in table.refused.items()]
    rest = [i for i in range(len(table.columns)) if i not in named]
    if table.lengths:
        counted = Counter(table.lengths[i] for i in named or rest)
        usual = max(counted, key=lambda T: (counted[T], T), default=0)
        short = [table.columns[i].name for i in rest if table.lengths[i] != usual]
        rest = [i for i in rest if table.lengths[i] == usual]
        if short:
            remarks.append(f"left out: {', '.join(short)}, of other lengths than {usual} samples")
    heads = dict[int, Array]()
    for i in rest:
        try:
            heads[i] = next(table.blocks([i], BLOCK))[:, 0]
        except InputError as error:
            remarks.append(f"left out: {error}")
    used = named or [i for i in range(len(table.columns)) if i not in rest]
    base = find_base(table, used, fs=wanted.fs, stamps=stamps)
    others = tuple(
        i
        for i, head in heads.items()
        if i not in (base.column, *base.others)
        and not (is_run(table.columns[i].name) and find_runs(len(head), {"": head}).told)
    )
    if bool(u) != bool(y):
        side = "outputs" if u else "inputs"
        names = ", ".join(table.columns[i].name for i in others)
        remarks.append(
            f"{side}: {names}, all other columns" if others else f"no column is left for {side}"
        )
    u, y = u or (others if y else ()), y or others
    if not y:
        lacking = "no column is left for the outputs" if u else "there is no column to show"
        raise InputError(f"'{table.path}': {lacking}; it has {table.listed}.")
    return u, y, base, remarks


def _beginning(table: Table, columns: Sequence[int]) -> tuple[Array, bool]:
    """The first samples (T, columns), and whether there are more."""
    most = LARGEST // len(columns)
    blocks, T = [np.empty((0, len(columns)))], 0
    for block in table.blocks(columns):
        blocks.append(block[: most - T])
        T += len(block)
        if most < T:
            break
    return np.concatenate(blocks), most < T


def _to_the_end(values: Array, count: int) -> tuple[Array, Array]:
    """The first columns and the last one, without the empty lines at the end of spreadsheets."""
    present = np.flatnonzero(~np.isnan(values[:, :count]).all(axis=1))
    values = values[: present[-1] + 1 if present.size else 0]
    return values[:, :count], values[:, -1]


def _joined(pieces: Sequence[Piece], signals: Array, nu: int) -> Array:
    """The signals of a run on its grid, NaN in its holes; the whole length is limited."""
    found, end = [], 0.0
    for piece in pieces:
        hole = min(round(piece.start - end), LARGEST // signals.shape[1]) if found else 0
        part, lost = piece.on_grid(signals), piece.missing()
        if lost.any():
            part[lost, nu:] = np.nan
        found += [np.full((hole, signals.shape[1]), np.nan), part]
        end = piece.start + len(part)
    return np.concatenate(found)


def _stretches(
    values: Array, pieces: Sequence[Piece], parts: Sequence[slice], gaps: Gaps, run: str
) -> list[Stretch]:
    """The stretches of a run; if gaps are split, without missing values."""
    found = list[Stretch]()
    for piece in pieces:
        signals, lost = piece.on_grid(values), piece.missing()
        u, y, r = (signals[:, part] for part in parts)
        if lost.any():
            y = np.where(lost[:, None], np.nan, y)
        ends = [(0, len(u))] if len(u) else []
        if gaps == "split":
            gone = lost | np.isnan(signals).any(axis=1)
            edges = np.flatnonzero(np.diff(np.concatenate([[True], gone, [True]]).astype(np.int8)))
            ends = [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
        for a, b in ends:
            valid = np.isfinite(y[a:b])
            whole = bool(valid.all())
            found.append(
                Stretch(
                    u[a:b],
                    y[a:b] if whole else interpolated(y[a:b], valid),
                    begins=piece is pieces[0] and a == 0,
                    run=run,
                    reference=r[a:b] if r.shape[1] else None,
                    valid=None if whole else valid,
                )
            )
    return found


def _channels(
    table: Table, columns: Sequence[int], units: Mapping[str | int, str]
) -> tuple[Channel, ...]:
    """Channels with the units that are given by name, by header or by number."""
    keys = [(table.columns[i].name, table.headers[i], i) for i in columns]
    strange = [key for key in units if not any(key in own for own in keys)]
    if strange:
        raise InputError(
            f"units names {', '.join(map(repr, strange))}, which is not among the inputs and "
            f"outputs: {', '.join(name for name, *_ in keys)}."
        )
    return tuple(
        Channel(own[0], next((units[key] for key in own if key in units), table.columns[i].unit))
        for i, own in zip(columns, keys, strict=True)
    )


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
    grid: OnGrid,
    beside: Sequence[int],
) -> ValueError:
    """Message on missing values, with a remedy."""
    empty = np.isnan(values)
    rows = np.asarray(empty.any(axis=1))
    said = []
    if rows.any():
        sample = int(np.argmax(rows))
        places = int(np.count_nonzero(np.diff(np.append(False, rows).astype(np.int8)) == 1))
        column = table.headers[columns[int(np.argmax(empty[sample]))]]
        samples = int(np.argmin(np.append(rows[sample:], False)))
        said.append(
            f"{rows.sum()} sample(s) have missing values, in {places} place(s), the first at "
            f"{table.where(sample)} in column {column!r}, for {samples} sample(s)"
            + (f" ({samples / grid.fs:.3g} s)" if grid.fs else "")
        )
    if grid.holes[0]:
        said.append(grid.gap(table))
    return InputError(
        f"'{table.path}': {', and '.join(said)}.\nFill the gaps, or set gaps='split' to make a "
        "record of every stretch between them."
        + "".join(f" If {table.headers[column]!r} is not a time, rename it." for column in beside)
    )
