"""Data frames of pandas: recognition, times, and frames of results."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lfrtorch._support.errors import InputError
from lfrtorch._support.headers import names_and_units
from lfrtorch._support.runs import find_runs, is_run
from lfrtorch._support.sampling import Piece, UnevenError, even_times
from lfrtorch._support.types import Array


def is_frame(value: Any) -> bool:
    """Tell if a value is a data frame, without importing pandas."""
    pandas = sys.modules.get("pandas")
    return pandas is not None and isinstance(value, pandas.DataFrame)


def index_times(frame: Any) -> Array | None:
    """Index in seconds from its first entry; None if it counts rows or is not a time."""
    import pandas as pd

    index = frame.index
    if isinstance(index, pd.RangeIndex) or not len(index):
        return None
    if isinstance(index, pd.DatetimeIndex | pd.TimedeltaIndex):
        return (index - index[0]).total_seconds().to_numpy(np.float64)
    if not pd.api.types.is_float_dtype(index.dtype):
        return None
    return index.to_numpy(np.float64) - float(index[0])


def index_grid(frame: Any, fs: float | None, used: Sequence[int] = ()) -> tuple[float, Piece]:
    """Sampling frequency in Hz, and positions of the rows on its grid, from the index.

    An uneven index is put on a grid of ``fs``, if given. Several runs, numbered by a column that
    is not ``used``, are refused: they are several records.
    """
    names = [name for name, _ in names_and_units([*map(str, frame.columns)], {})]
    labels = {
        name: _labels(frame.iloc[:, i])
        for i, name in enumerate(names)
        if is_run(name) and i not in used
    }
    t = index_times(frame)
    runs = find_runs(len(frame), labels, t)
    if runs.told:
        raise InputError(
            f"the frame has {len(runs.starts)} runs, as {runs.told.replace('time', 'index')}; give "
            "one of them, or load_records(df, inputs=..., outputs=...), which makes a record of "
            "each."
        )
    if t is None or len(t) < 2:
        if fs is None:
            raise InputError(
                "the frame's index is not a time; give fs=HZ or an index of date-times or seconds: "
                "df.set_index('t')."
            )
        return fs, Piece.of(0, len(frame))
    if not np.isfinite(t).all():
        row = int(np.argmin(np.isfinite(t)))
        raise InputError(f"the frame's index has no time in row {row}; leave the row out.")
    try:
        even = even_times(t)
        rate, holes = even.grid.fs, len(even.pieces) > 1
        off = 0.1 if even.uneven else max(0.01, even.grid.uncertainty)
        if fs is not None and abs(fs / rate - 1.0) > off:
            raise InputError(f"fs is {fs:g} Hz and the frame's index says {rate:g} Hz.")
        if fs is not None and even.uneven:
            even = even_times(t, fs)
    except UnevenError as error:
        raise InputError(
            f"the frame's index {error}, at row {error.sample}; sort it, df.sort_index(), or give "
            "the parts before and after as frames of their own."
        ) from error
    if holes:
        raise InputError(
            f"the frame's index has a gap before row {even.pieces[1].rows[0]}; load_records(df, "
            "inputs=..., outputs=..., gaps='split') makes a record of each part between gaps."
        )
    if fs is None and (even.uneven or even.pieces[0].missing().any()):
        why = even.uneven or f"lacks {even.pieces[0].missing().sum()} sample(s)"
        raise InputError(
            f"the frame's index {why}; fs={rate:g} interpolates the signals to even times, and so "
            "does load_records(df, inputs=..., outputs=...), which says so in its notes."
        )
    return rate if fs is None else fs, even.pieces[0]


def check_index(frame: Any, fs: float) -> None:
    """Refuse an index that is not an even time at ``fs`` in Hz."""
    places = index_grid(frame, fs)[1].places
    if not np.array_equal(places, np.arange(len(frame))):
        raise InputError(
            f"the frame's index is not an even time; Record.from_frame(df, ..., fs={fs:g}) makes a "
            "record on even times, which the model simulates."
        )


def _labels(column: Any) -> NDArray[Any]:
    """Numbers or words of a column that may number runs."""
    import pandas as pd

    number = pd.api.types.is_numeric_dtype(column.dtype)
    return column.to_numpy(np.float64, na_value=np.nan) if number else column.astype(str).to_numpy()


def places_of(frame: Any, wanted: Sequence[str], side: str) -> list[int]:
    """Positions of columns by header, "force (N)", or by the name in it; messages name the side."""
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
    """Values of columns (rows, columns), NaN where missing."""
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
