"""A file as input of a model: its channels are found, its samples checked block by block."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lfrtorch._support.errors import InputError
from lfrtorch._support.sampling import UnevenError, sampling
from lfrtorch._support.types import Array
from lfrtorch.data.records import Channel
from lfrtorch.files.formats import BLOCK, open_table
from lfrtorch.files.table import Columns, NoColumnError
from lfrtorch.files.time_base import find_base
from lfrtorch.files.time_stamps import time_unit

_SAME = 1e-3  # largest relative difference of two sampling frequencies that count as equal


class Block(NamedTuple):
    """Consecutive samples of a file: times (n, 1), or (n, 0), in s, u (n, nu), y (n, ny)."""

    times: Array
    u: Array
    y: Array


class FileStream:
    """The inputs of a model in a file, and its outputs if the file has them.

    Args:
        path: the file, of any format that ``open_table`` reads.
        u, y: the model's input and output channels.
        fs: sampling frequency of the model in Hz.
        inputs, outputs: columns of the channels. Default: columns with the channels' names, and no
            outputs unless all of them are there.
        time: column of time stamps, which must run evenly at ``fs``.
        find_time: without ``time``, look for the sampling frequency in the file.
    """

    def __init__(
        self,
        path: str | Path,
        u: Sequence[Channel],
        y: Sequence[Channel],
        fs: float,
        *,
        inputs: Columns | None = None,
        outputs: Columns | None = None,
        time: str | int | None = None,
        find_time: bool = False,
    ) -> None:
        self.table, self.fs = open_table(path), fs
        if self.table.asked:
            raise InputError(
                f"'{path}': a file is simulated at the times that it has; leave out the rate "
                "behind it, or in Python simulate a record of load_records(FILE, ..., test='all')."
            )
        self.u = self._found(inputs, u, "inputs")
        there = {column.name for column in self.table.columns}
        self.missing = [channel.name for channel in y if channel.name not in there]
        """The model's outputs that are missing in the file, by their own names."""
        unmeasured = outputs is None and self.missing
        self.y = () if unmeasured else self._found(outputs, y, "outputs")
        self.times = () if time is None else self.table.find(time, "time")
        if len(self.times) > 1:
            raise InputError(f"time is {time!r}, {len(self.times)} columns; name one.")
        self.note = ""
        """What was found of the sampling."""
        if time is None and find_time:
            self.times, self.note = self._sampled()
        self.clock = self.table.columns[self.times[0]] if self.times else Channel("sample")
        """Name and unit of the time stamps or, without these, of the sample numbers."""

    def blocks(self, samples: int = BLOCK) -> Iterator[Block]:
        """Yield at most ``samples`` samples at a time, with NaN for missing outputs."""
        first, seen, seconds = 0, np.empty(0), 0.0
        columns = [*self.times, *self.u, *self.y]
        ends = [len(self.times), len(self.times) + len(self.u)]
        for block in self.table.blocks(columns, samples):
            if not len(block):
                continue
            missing = ~np.isfinite(block[:, : ends[1]])
            if missing.any():
                k, i = np.argwhere(missing)[0]
                raise InputError(
                    f"{self._at(first + k)}: column {self.table.headers[columns[i]]!r} has no "
                    "finite number; interpolate the gap, or cut the file there and simulate the "
                    "parts."
                )
            times, u, y = np.split(block, ends, axis=1)
            if self.times:
                times = times * (seconds := seconds or self._seconds(times[:, 0]))
                # The last stamps of the block before are checked along with those of a short one.
                seen = np.concatenate([seen[-1000:], times[:, 0]])
                self._check(seen, first + len(block) - len(seen))
            yield Block(times, u, y)
            first += len(block)

    def _sampled(self) -> tuple[tuple[int, ...], str]:
        """Find the file's column of time, and what it says about the sampling."""
        base = find_base(self.table, [*self.u, *self.y])
        if base.why:
            raise InputError(
                f"'{self.table.path}': {base.why}; resample the signals to an even grid, or give "
                f"fs={self.fs:g} if the column is wrong."
            )
        off = base.fs is None or abs(base.fs / self.fs - 1) > _SAME
        if off and not (base.fs and base.named):
            return (), f"nothing says how it is sampled; the model's {self.fs:g} Hz are taken"
        if off and base.column is None:
            raise InputError(
                f"'{self.table.path}': {base.notes[0]}, and the model runs at {self.fs:g} Hz; "
                "resample the signals."
            )
        return () if base.column is None else (base.column,), base.notes[0]

    def _found(
        self, wanted: Columns | None, channels: Sequence[Channel], option: str
    ) -> tuple[int, ...]:
        """Column numbers of the model's channels."""
        listed = ", ".join(map(str, channels))
        try:
            found = self.table.find(
                [c.name for c in channels] if wanted is None else wanted, option
            )
        except NoColumnError as error:
            if wanted is not None:
                raise
            raise InputError(
                f"{str(error).replace(f', named in {option}', '')} The model has {listed}; "
                f"say which columns these are with {option}=[...]."
            ) from error
        if len(found) != len(channels):
            raise InputError(
                f"{option} is {len(found)} column(s) of '{self.table.path}' and the model has "
                f"{len(channels)} ({listed}); give one for each."
            )
        for channel, number in zip(channels, found, strict=True):
            column = self.table.columns[number]
            if channel.unit and column.unit and channel.unit != column.unit:
                raise InputError(
                    f"column {column} of '{self.table.path}' is in another unit than the model's "
                    f"{channel}; convert it, or correct its header."
                )
        return found

    def _seconds(self, times: Array) -> float:
        """The unit of the first time stamps, in seconds."""
        try:
            return time_unit(times, self.clock).seconds
        except UnevenError as error:
            raise InputError(
                f"'{self.table.path}': the time column {self.clock} {error}; {error.remedy}, or "
                "leave out time if the column is wrong."
            ) from error

    def _check(self, times: Array, first: int) -> None:
        """Refuse times of the samples from ``first`` on if they do not run at ``fs``."""
        if len(times) < 2:
            return
        try:
            grid = sampling(times)
        except UnevenError as error:
            raise InputError(
                f"{self._at(first + error.sample)}: the time column {self.clock} {error}; "
                f"{error.remedy}, or leave out time if the column is wrong."
            ) from error
        if abs(grid.fs / self.fs - 1) > max(_SAME, grid.uncertainty):
            raise InputError(
                f"the time column {self.clock} of '{self.table.path}' says {grid.fs:g} Hz and the "
                f"model runs at {self.fs:g} Hz; resample the signals, or correct the column or its "
                "unit."
            )
        if grid.gaps.size:
            raise InputError(
                f"{self._at(first + grid.gaps[0])}: {grid.missing[0]} sample(s) are missing before "
                f"it, as the time column {self.clock} says; fill the gap, or cut the file there "
                "and simulate the parts."
            )

    def _at(self, sample: int) -> str:
        return f"'{self.table.path}', {self.table.where(int(sample))}"
