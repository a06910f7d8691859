"""A data frame of pandas as a table."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lfrtorch._support.frames import columns_of, index_times, is_frame
from lfrtorch._support.types import Array
from lfrtorch.files.table import BLOCK, Table


class FrameTable(Table):
    """The columns of a frame, and its index as the first one if that is a time."""

    def __init__(self, frame: Any, name: str) -> None:
        self._frame, self._times = frame, index_times(frame)
        timed = self._times is not None
        index = f"{frame.index.name or 'time'}"
        headers = [index] * timed + [str(column) for column in frame.columns]
        super().__init__(Path(name), headers, clocks={0} if timed else ())

    def blocks(self, columns: Sequence[int], samples: int = BLOCK) -> Iterator[Array]:
        """See :meth:`Table.blocks`."""
        times = self._times
        timed = times is not None
        for first in range(0, len(self._frame), samples):
            part = self._frame.iloc[first : first + samples]
            block = np.empty((len(part), len(columns)))
            for place, column in enumerate(columns):
                if times is not None and column == 0:
                    block[:, place] = times[first : first + samples]
                else:
                    block[:, place] = columns_of(part, [column - timed])[:, 0]
            yield block

    def labels(self, column: int) -> NDArray[Any]:
        """See :meth:`Table.labels`."""
        place = column - (self._times is not None)
        found = super().labels(column)
        return found if len(found) else self._frame.iloc[:, place].astype(str).to_numpy(str)


def frame_tables(given: Any) -> list[FrameTable]:
    """The tables of a frame, or of a list of them; none of anything else."""
    if is_frame(given):
        return [FrameTable(given, "frame")]
    if isinstance(given, list | tuple) and given and all(map(is_frame, given)):
        return [FrameTable(frame, f"frame{i}") for i, frame in enumerate(given, 1)]
    return []
