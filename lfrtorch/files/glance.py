"""A first look at a file: signals by use, and their clock; what is odd is said, not refused."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lfrtorch._support.errors import InputError
from lfrtorch._support.runs import find_runs, is_run
from lfrtorch._support.sampling import Piece
from lfrtorch._support.types import Array
from lfrtorch.data.records import Channel, check_largest, check_rate
from lfrtorch.files.table import BLOCK, Columns, Table
from lfrtorch.files.time_base import TimeBase, find_base, on_grid

LARGEST = 2**22
"""Values that are read of a file, of all channels together: what comes after is not looked at."""


@dataclass(frozen=True, eq=False)
class Glance:
    """The beginning of a file."""

    inputs: list[Channel]
    outputs: list[Channel]  # all signals if none was named
    u: Array  # (T, nu), NaN where a value is missing
    y: Array  # (T, ny)
    fs: float | None  # Hz, if it is known
    remarks: list[str]  # what was taken for what
    doubts: list[str]  # what is wrong with the times


def look_at(
    table: Table,
    inputs: Columns | None = None,
    outputs: Columns | None = None,
    *,
    time: str | int | None = None,
    fs: float | None = None,
) -> Glance:
    """Read the first samples of a file; without inputs and outputs, of all signals."""
    # If one side is given, the other columns are the other side. Without ``time`` the rule of
    # :func:`find_base` finds one.
    (u, y), base, remarks = _roles(table, inputs, outputs, time, fs)
    wanted = [*u, *y]
    signals, more = _read(table, [*wanted, *([] if base.column is None else [base.column])])
    doubts = [base.why] if base.why else []
    try:
        times = (
            None if base.column is None or (base.fs is None and not base.given) else signals[:, -1]
        )
        grid = on_grid(table, base, len(signals), times, fs=fs, used=wanted)
    except InputError as error:
        doubts.append(str(error).partition(": ")[2])
        grid = on_grid(table, TimeBase(fs), len(signals), fs=fs, used=wanted)
    (remarks if fs is None else doubts).extend(base.notes)
    remarks += grid.notes
    signals = signals[:, : len(wanted)]
    if more:
        remarks.append(f"the first {len(signals)} samples are read, and no more")
    longest = max(grid.pieces, key=lambda run: sum(len(piece.rows) for piece in run))
    if len(grid.pieces) > 1:
        name = grid.runs.names[grid.pieces.index(longest)]
        remarks.append(f"what follows is of the longest run, {name}")
    if grid.holes[0]:
        doubts.append(f"{grid.gap(table)}: data.gaps=split cuts the record there")
    signals = _joined(longest, signals, len(u))
    for i, signal in zip(wanted, signals.T, strict=False):
        known = np.abs(signal[np.isfinite(signal)])
        check_largest(f"'{table.path}': {table.columns[i].name!r}", known.max(initial=0.0))
    if grid.fs is not None:
        check_rate(f"'{table.path}': the sampling frequency", grid.fs)
    return Glance(
        [table.columns[i] for i in u],
        [table.columns[i] for i in y],
        signals[:, : len(u)],
        signals[:, len(u) :],
        grid.fs,
        [*table.notes, *remarks],
        doubts,
    )


def _joined(pieces: Sequence[Piece], signals: Array, nu: int) -> Array:
    """The signals of a run on its grid, NaN in its holes as far as these are not too long."""
    found, end = [], 0.0
    for piece in pieces:
        hole = min(round(piece.start - end), LARGEST // signals.shape[1]) if found else 0
        found.append(np.full((hole, signals.shape[1]), np.nan))
        part, lost = piece.on_grid(signals), piece.missing()
        if lost.any():
            part[lost, nu:] = np.nan
        found.append(part)
        end = piece.start + len(part)
    return np.concatenate(found)


def _roles(
    table: Table,
    inputs: Columns | None,
    outputs: Columns | None,
    time: str | int | None,
    fs: float | None,
) -> tuple[list[tuple[int, ...]], TimeBase, list[str]]:
    """Inputs and outputs, what tells their times, and remarks on the choice."""
    told = list[str]()
    if inputs is None and outputs is None:
        inputs, outputs, told = table.by_name(inputs, outputs)
    u = () if inputs is None else table.find(inputs, "inputs")
    y = () if outputs is None else table.find(outputs, "outputs")
    stamps = () if time is None else table.find(time, "time")
    named = [*u, *y, *stamps]
    twice = [table.headers[i] for i in dict.fromkeys(named) if named.count(i) > 1]
    if twice or len(stamps) > 1:
        raise InputError(
            f"'{table.path}': {', '.join(map(repr, twice)) or 'time'} stands for several; "
            "give every column one use, and one column of times."
        )
    remarks = told
    if not table.contents:
        remarks += [f"left out: {name!r} {reason}" for name, reason in table.refused.items()]
    rest = sorted(set(range(len(table.columns))) - set(named))
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
    base = find_base(
        table,
        named or [i for i in range(len(table.columns)) if i not in rest],
        fs=fs,
        stamps=stamps,
    )
    others = tuple(
        i
        for i, head in heads.items()
        if i not in (base.column, *base.others)
        and not (is_run(table.columns[i].name) and find_runs(len(head), {"": head}).told)
    )
    if not u and not y:
        y = others
    elif not u or not y:
        side = "outputs" if u else "inputs"
        names = ", ".join(table.columns[i].name for i in others)
        remarks.append(
            f"{side}: {names}, all other columns" if others else f"no column is left for {side}"
        )
        u, y = u or others, y or others
    if not y:
        lacking = "no column is left for the outputs" if u else "there is no column to show"
        raise InputError(f"'{table.path}': {lacking}; it has {table.listed}.")
    return [u, y], base, remarks


def _read(table: Table, wanted: list[int]) -> tuple[Array, bool]:
    """The first samples (T, wanted), and whether there are more."""
    most = LARGEST // len(wanted)
    blocks, T = [], 0
    for block in table.blocks(wanted):
        blocks.append(block[: most - T])
        T += len(block)
        if most < T:
            break
    signals = np.concatenate(blocks)
    present = np.flatnonzero(~np.isnan(signals).all(axis=1))
    if not present.size:
        raise InputError(f"'{table.path}' has no values in the columns to show.")
    return signals[: present[-1] + 1], most < T  # spreadsheets end in empty lines
