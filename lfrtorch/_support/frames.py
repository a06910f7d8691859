"""Data frames of pandas: whether something is one, its times, and a frame of results like it."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

import numpy as np

from lfrtorch._support.errors import InputError
from lfrtorch._support.headers import names_and_units
from lfrtorch._support.types import Array

_UNEVEN = 0.4
"""Of a step, that a time may be off an even grid: stamps are rounded, a lost sample moves half."""


def is_frame(value: Any) -> bool:
    """Whether it is a data frame; nobody has one who has not imported pandas."""
    pandas = sys.modules.get("pandas")
    return pandas is not None and isinstance(value, pandas.DataFrame)


def index_times(frame: Any) -> Array | None:
    """The index in seconds from its first entry; None if it only counts rows or is no time."""
    import pandas as pd

    index = frame.index
    if isinstance(index, pd.RangeIndex) or not len(index):
        return None
    if isinstance(index, pd.DatetimeIndex | pd.TimedeltaIndex):
        return (index - index[0]).total_seconds().to_numpy(np.float64)
    if not pd.api.types.is_float_dtype(index.dtype):
        return None
    return index.to_numpy(np.float64) - float(index[0])


def index_rate(frame: Any, fs: float | None) -> float:
    """The sampling frequency in Hz that the index says, checked against the one that is given."""
    t = index_times(frame)
    if t is None or len(t) < 2:
        if fs is None:
            raise InputError(
                "the frame's index is no time; give fs=HZ, or an index of date-times or seconds: "
                "df.set_index('t')."
            )
        return fs
    step = (t[-1] - t[0]) / (len(t) - 1)
    off = np.abs(t - t[0] - step * np.arange(len(t)))
    if not step > 0 or not off.max() <= _UNEVEN * step:
        steps = np.diff(t)
        odd = int(np.argmax(np.abs(steps - np.median(steps))))
        raise InputError(
            f"the frame's index is no even time: {steps[odd]:.4g} s before row {odd + 1}, and "
            f"{np.median(steps):.4g} s usually; resample it, df.resample('10ms').mean(), or "
            "load_records(df, gaps='split')."
        )
    if fs is not None and abs(fs * step - 1.0) > 0.01:
        raise InputError(f"fs is {fs:g} Hz and the frame's index says {1.0 / step:g} Hz.")
    return 1.0 / step if fs is None else fs


def places_of(frame: Any, wanted: Sequence[str], side: str) -> list[int]:
    """Numbers of columns by header, "force (N)", or by the name in it; messages name the side."""
    headers = [str(column) for column in frame.columns]
    names = [name for name, _ in names_and_units(headers, {})]
    found = []
    for one in wanted:
        known = next((own for own in (headers, names) if one in own), [])
        if known.count(one) != 1:
            several = f"{known.count(one)} columns" if known else "no column"
            raise InputError(f"the frame has {several} {one!r}, of the {side}; it has {headers}.")
        found.append(known.index(one))
    return found


def columns_of(frame: Any, wanted: Sequence[int]) -> Array:
    """Columns as numbers (rows, columns), NaN for missing ones."""
    import pandas as pd

    parts = []
    for i in wanted:
        column = frame.iloc[:, i]
        try:
            parts.append(pd.to_numeric(column).to_numpy(np.float64, na_value=np.nan))
        except (TypeError, ValueError) as error:
            raise InputError(
                f"the column {str(frame.columns[i])!r} has no numbers: {error}"
            ) from error
    return np.column_stack(parts) if parts else np.empty((len(frame), 0))


def framed(values: Array, names: Sequence[str], like: Any) -> Any:
    """A frame of columns with the index of another."""
    import pandas as pd

    return pd.DataFrame(values, index=like.index, columns=list(names))
