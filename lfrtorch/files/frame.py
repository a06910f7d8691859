"""Frames of pandas as a table: one in memory, or those of a Parquet file one after another."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lfrtorch._support.errors import InputError, brief
from lfrtorch._support.frames import columns_of, index_times, is_frame
from lfrtorch._support.types import Array
from lfrtorch.files.arrays import optional
from lfrtorch.files.table import BLOCK, Clock, Table

Frames = Callable[[list[int], int], Iterator[Any]]
"""Returns frames of columns, given by their numbers, with at most a given number of rows."""


class FrameTable(Table):
    """Columns of numbers and of date-times."""

    def __init__(self, path: Path, headers: Sequence[str], frames: Frames, **found: Any) -> None:
        super().__init__(path, headers, **found)
        self._frames = frames

    def blocks(self, columns: Sequence[int], samples: int = BLOCK) -> Iterator[Array]:
        """See :meth:`Table.blocks`."""
        clocks = [Clock() for _ in columns]
        for part in self._frames([*columns], samples):
            found = np.empty((len(part), len(columns)))
            for i, clock in enumerate(clocks):
                column = part.iloc[:, i]
                dated, plain = column.dtype.kind == "M", column.dtype == np.float64
                if dated:
                    found[:, i] = clock(column.to_numpy("M8[ns]"))
                else:
                    found[:, i] = column if plain else columns_of(part, [i])[:, 0]
            yield found

    def labels(self, column: int) -> NDArray[Any]:
        """See :meth:`Table.labels`."""
        found = super().labels(column)
        if len(found):
            return found
        words = [part.iloc[:, 0].astype(str) for part in self._frames([column], BLOCK)]
        return np.concatenate(words) if words else found


def frame_tables(given: Any) -> list[FrameTable]:
    """The tables of a frame or of a list of frames; empty for anything else."""
    if is_frame(given):
        return [_in_memory(given, "frame")]
    if isinstance(given, list | tuple) and given and all(map(is_frame, given)):
        return [_in_memory(frame, f"frame{i}") for i, frame in enumerate(given, 1)]
    return []


def _in_memory(frame: Any, name: str) -> FrameTable:
    """The table of a frame; the index is its first column if it holds times."""
    times, index = index_times(frame), f"{frame.index.name or 'time'}"
    if times is not None:
        frame = frame.copy(deep=False)
        frame.insert(0, index, times, allow_duplicates=True)

    def frames(columns: list[int], samples: int) -> Iterator[Any]:
        for first in range(0, len(frame), samples):
            yield frame.iloc[first : first + samples, columns]

    clocks = {i for i, kind in enumerate(frame.dtypes) if kind.kind == "M"}
    clocks |= {0} if times is not None else set()
    return FrameTable(Path(name), [*map(str, frame.columns)], frames, clocks=clocks)


def parquet(path: Path) -> FrameTable:
    """The columns of a Parquet file, by batches of row groups; nulls are missing values."""
    pa, pq = optional("pyarrow"), optional("pyarrow.parquet")

    def damaged(error: Exception) -> InputError:
        said = brief(error)
        return InputError(f"'{path}' is not a readable Parquet file ({said}); write it again.")

    try:
        schema = pq.read_schema(path)
    except (pa.ArrowException, OSError) as error:
        raise damaged(error) from error
    kinds = pa.types
    dated = kinds.is_timestamp
    usable = kinds.is_integer, kinds.is_floating, kinds.is_boolean, kinds.is_decimal, dated
    fields = [f for f in schema if any(check(f.type) for check in usable)]
    headers = [f.name for f in fields]

    def frames(columns: list[int], samples: int) -> Iterator[Any]:
        names = [headers[column] for column in columns]
        try:
            # With read-ahead, the whole file would end up in memory.
            with pq.ParquetFile(path, pre_buffer=False) as file:
                for batch in file.iter_batches(samples, columns=list(dict.fromkeys(names))):
                    yield batch.select(names).to_pandas(ignore_metadata=True)
        except (pa.ArrowException, OSError) as error:
            raise damaged(error) from error

    refused = {
        f.name: f"has no numbers (its type is {f.type}); store it as numbers"
        for f in schema
        if f.name not in headers
    }
    clocks = {i for i, f in enumerate(fields) if dated(f.type)}
    return FrameTable(path, headers, frames, refused=refused, clocks=clocks)
