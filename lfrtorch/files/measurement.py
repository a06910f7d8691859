"""What one file measured: inputs and outputs on an even grid of time, run by run."""

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
from lfrtorch._support.sampling import Piece
from lfrtorch._support.types import Array, Booleans
from lfrtorch.data.records import Channel, interpolated
from lfrtorch.files.formats import Table, open_table
from lfrtorch.files.table import Columns
from lfrtorch.files.time_base import OnGrid, find_base, on_grid

Gaps = Literal["error", "split"]


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
    begins: bool  # whether it is the beginning of a run
    run: str  # empty if there is one
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
    base = find_base(table, columns, fs=wanted.fs, stamps=stamps)
    if base.fs is None and not base.given:
        raise InputError(
            f"the sampling frequency of '{path}' is not known; give fs=HZ"
            f"{'; ' if base.why else ''}{base.why}."
        )
    beside = () if base.column is None or base.column in columns else (base.column,)
    if beside and wanted.fs is None:
        columns, beside = (*columns, *beside), ()
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
        base, beside = base._replace(column=None), ()
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
        raise InputError(f"'{path}' has no sample in which all columns have a value.")
    assert grid.fs is not None
    notes = [*base.notes, *grid.notes]
    empty = np.isnan(values[:, parts[1]])
    if wanted.gaps == "error" and empty.any():
        sample, i = np.argwhere(empty)[0]
        notes.append(
            f"{empty.sum()} output sample(s) have no value, the first at "
            f"{table.where(int(sample))} in column {table.headers[y[i]]!r}: they are simulated "
            "through, and neither fitted nor scored"
        )
    return Measurement(
        path,
        grid.fs,
        _channels(table, u, wanted.units),
        _channels(table, y, wanted.units),
        stretches,
        [*table.notes, *told, *notes],
    )


def _stretches(
    values: Array, pieces: Sequence[Piece], parts: Sequence[slice], gaps: Gaps, run: str
) -> list[Stretch]:
    """The stretches of a run, without a missing value if they are split."""
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
    found = []
    for i in columns:
        channel = table.columns[i]
        given = (units[key] for key in (channel.name, table.headers[i], i) if key in units)
        found.append(Channel(channel.name, next(given, channel.unit)))
    return tuple(found)


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
    """What is missing, and what to do."""
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
        f"'{table.path}': {', and '.join(said)}.\nFill the gaps, or gaps='split' takes every "
        "stretch between them for a record of its own."
        + "".join(
            f" If {table.headers[column]!r} is no time, give it another name." for column in beside
        )
    )
