"""A first look at a file: signals by use, and their clock; what is odd is said, not refused."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array
from lfrtorch.files.table import BLOCK, Columns, Table
from lfrtorch.files.time_stamps import Sampling, UnevenError, column_sampling, is_time
from lfrtorch.records import Channel, check_largest, check_rate

LARGEST = 2**22
"""Values that are read of a file, of all channels together: what comes after is not looked at."""

_RATE = 0.01  # relative difference of two sampling frequencies that are the same
_THOUSANDS = {1e3: "milliseconds", 1e6: "microseconds", 1e9: "nanoseconds"}


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
    grid: Sampling | None  # of the times

    def spread(self) -> Array:
        """All signals with NaN for the samples that the times lack, unless these are too many."""
        signals = np.hstack([self.u, self.y])
        if self.grid is None or self.grid.missing.sum() > LARGEST:
            return signals
        return np.insert(signals, np.repeat(self.grid.gaps, self.grid.missing), np.nan, axis=0)


def look_at(
    table: Table,
    inputs: Columns | None = None,
    outputs: Columns | None = None,
    *,
    time: str | int | None = None,
    fs: float | None = None,
) -> Glance:
    """Read the first samples of a file; without inputs and outputs, of all signals."""
    # If one side is given, the other columns are the other side. Without ``time`` a column that
    # looks like time is taken, without ``fs`` the sampling frequency that the file says.
    (u, y, stamps), remarks = _roles(table, inputs, outputs, time)
    wanted = [*u, *y]
    signals, more = _read(table, [*wanted, *stamps])
    for name, said in table.rates.items():
        remarks.append(f"{name!r} says {said:.6g} Hz")
        fs = said if fs is None else fs
    doubts, grid = [], None
    for column in stamps:
        name = f"'{table.columns[column].name}'"
        grid, remark, doubts = _clock(signals[:, -1], table.columns[column])
        remarks.append(f"{name} is taken for {remark}")
        if grid is not None and (
            fs is None or abs(fs / grid.fs - 1) < max(_RATE, grid.uncertainty)
        ):
            fs = fs or grid.fs
        elif grid is not None and fs is not None:
            doubts.append(_contradicted(fs, grid, name))
    if more:
        remarks.append(f"the first {len(signals)} samples are read, and no more")
    for i, signal in zip(wanted, signals.T, strict=False):
        known = np.abs(signal[np.isfinite(signal)])
        check_largest(f"'{table.path}': {table.columns[i].name!r}", known.max(initial=0.0))
    if fs is not None:
        check_rate(f"'{table.path}': the sampling frequency", fs)
    return Glance(
        [table.columns[i] for i in u],
        [table.columns[i] for i in y],
        signals[:, : len(u)],
        signals[:, len(u) : len(wanted)],
        fs,
        [*table.notes, *remarks],
        doubts,
        grid,
    )


def _roles(
    table: Table, inputs: Columns | None, outputs: Columns | None, time: str | int | None
) -> tuple[list[tuple[int, ...]], list[str]]:
    """Inputs, outputs and times, and remarks on the choice."""
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
    heads, remarks = {}, told
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
    for i in rest:
        try:
            heads[i] = next(table.blocks([i], BLOCK))[:, 0]
        except InputError as error:
            remarks.append(f"left out: {error}")
    stamps = stamps or _clocks(table, heads)[:1]
    others = tuple(i for i in heads if i not in stamps)
    if not u and not y:
        y = others
    elif not u or not y:
        side = "outputs" if u else "inputs"
        names = ", ".join(table.columns[i].name for i in others)
        remarks.append(f"{side}: {names}, all other columns")
        u, y = u or others, y or others
    if not y:
        lacking = "no column is left for the outputs" if u else "there is no column to show"
        raise InputError(f"'{table.path}': {lacking}; it has {table.listed}.")
    return [u, y, stamps], remarks


def _clocks(table: Table, heads: Mapping[int, Array]) -> tuple[int, ...]:
    """Columns that look like times, the likeliest first: by name, even ones, sample numbers."""
    ranked = []
    for i, head in heads.items():
        named = is_time(table.columns[i])
        try:
            grid = column_sampling(head, table.columns[i])
        except UnevenError:
            even, counter = False, False
        else:
            even, counter = not grid.gaps.size, not named and grid.fs == 1
        if named or even:
            ranked.append((counter, not named, i))
    return tuple(i for *_, i in sorted(ranked))


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


def _clock(times: Array, channel: Channel) -> tuple[Sampling | None, str, list[str]]:
    """The grid of a column of times, what it was taken for, and what is wrong with it."""
    name = f"'{channel.name}'"
    try:
        grid = column_sampling(times, channel)
    except UnevenError as error:
        said = f"the time column {name} {error}, at sample {error.sample}; {error.remedy}."
        return None, "the time", [said]
    if grid.fs == 1 and not is_time(channel):
        return None, "sample numbers", []
    if not grid.gaps.size:
        return grid, str(grid), []
    said = (
        f"the times in {name} have {grid.gaps.size} gap(s) of {grid.missing.sum()} sample(s) in "
        f"all, the first after sample {grid.gaps[0] - 1}: data.gaps=split cuts the record there."
    )
    return grid, str(grid), [said]


def _contradicted(fs: float, grid: Sampling, name: str) -> str:
    """A sampling frequency that is not that of the times."""
    unit = next((u for f, u in _THOUSANDS.items() if abs(fs / grid.fs / f - 1) < _RATE), None)
    remedy = f", unless they are in {unit}." if unit else "; correct one of them."
    return f"fs looks like {grid.fs:.6g} Hz, not {fs:g}, by the times in {name}{remedy}"
