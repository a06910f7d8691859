"""One's own measurement as records: a table in a text file, or the arrays of a .npz file."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lfrtorch.checks import integer, number
from lfrtorch.datasets import Dataset
from lfrtorch.records import Channel, Record

__all__ = ["load"]

_TEXT = (".csv", ".tsv", ".txt")
_DELIMITERS = "\t;,"  # the first of these that the first line has
_SHORTEST = 10  # scored samples of a part
_WARM_UP = 0.05  # of the file: default of skip

Columns = str | int | Sequence[str | int]
Signal = tuple[str, NDArray[np.float64]]  # name, (T, channels)


def load(
    path: str | Path,
    *,
    inputs: Columns | None = None,
    outputs: Columns | None = None,
    fs: float | None = None,
    validation: float = 0.2,
    test: float = 0.2,
    skip: int | None = None,
    period: int | None = None,
) -> Dataset:
    """One measurement, cut in time into a training, a validation and a test record.

    A text file (.csv, .tsv, .txt) has one line a sample: numbers with a decimal point, separated
    by tabs, semicolons or commas. Its first line names the columns; it may be missing where
    ``inputs`` and ``outputs`` are column numbers. In a .npz file every array has a name; one of
    shape (T, channels) is several channels.

    Every record begins where the file begins and is simulated from there, from zero state: only its
    own part is scored, so that the transient of the start reaches neither validation nor test.

    Args:
        path: the file.
        inputs: one or several names of columns or arrays, or column numbers from 0.
        outputs: likewise.
        fs: sampling frequency in Hz.
        validation: fraction of the samples, those after the training part.
        test: fraction of the samples, those at the end.
        skip: samples at the beginning of the file that are left out of the cost, for the transient
            of the start; 5 % of the file where left out.
        period: samples of one period of the inputs, where they repeat: a frequency response then
            tells noise from distortion.

    Shape:
        u, y of a part: (its samples, inputs), (its samples, outputs), in the file's units.

    Raises:
        ValueError: a file, column or number that cannot be used, or a part too short to score.
        FileNotFoundError: no such file.
    """
    path = Path(path).expanduser()
    u_columns, y_columns = _listed(inputs, "inputs"), _listed(outputs, "outputs")
    if fs is None:
        raise ValueError("the sampling frequency is not given; say it in Hz with data.fs.")
    if not path.is_file():
        raise FileNotFoundError(f"there is no file '{path}'; give the path of a .csv or .npz file.")
    if path.suffix.lower() not in (*_TEXT, ".npz"):
        raise ValueError(
            f"'{path}' has the unknown extension '{path.suffix}'; give a text file "
            f"({', '.join(_TEXT)}) or a .npz file (numpy.savez writes one)."
        )
    read = _arrays if path.suffix.lower() == ".npz" else _table
    signals = read(path, [*u_columns, *y_columns])
    names = [name for name, _ in signals]
    twice = [name for name in dict.fromkeys(names) if names.count(name) > 1]
    if twice:
        raise ValueError(
            f"'{path}': {_quoted(twice)} stands twice in data.inputs and data.outputs; "
            "name every column once."
        )
    whole = _record(path, signals[: len(u_columns)], signals[len(u_columns) :], fs)
    whole = replace(whole, period=period)
    skip = round(_WARM_UP * whole.samples) if skip is None else skip
    parts = _split(path, whole.samples, validation, test, skip)
    train, chosen, tests = (
        [replace(whole[: scored.stop], name=name, skip=scored.start)]
        for name, scored in parts.items()
    )
    return Dataset(path.stem, train, chosen, tests)


def _listed(columns: Columns | None, what: str) -> list[str | int]:
    given = [columns] if isinstance(columns, str | int) else list(columns or [])
    if not given or not all(isinstance(column, str | int) for column in given):
        raise ValueError(
            f"the {what} are {columns!r}; say which columns they are, by names or numbers from 0, "
            f"with data.{what}."
        )
    return given


def _quoted(names: Sequence[str]) -> str:
    return ", ".join(map(repr, names))


def _record(path: Path, u: list[Signal], y: list[Signal], fs: float) -> Record:
    """The whole measurement as one record."""
    lengths = {name: len(array) for name, array in (*u, *y)}
    if len(set(lengths.values())) > 1:
        listed = ", ".join(f"{name!r} has {length}" for name, length in lengths.items())
        raise ValueError(f"'{path}': {listed} samples; give arrays of one length.")

    def channels(signals: list[Signal]) -> tuple[Channel, ...]:
        return tuple(
            Channel(name if array.shape[1] == 1 else f"{name}{i + 1}")
            for name, array in signals
            for i in range(array.shape[1])
        )

    return Record(
        np.hstack([array for _, array in u]),
        np.hstack([array for _, array in y]),
        fs=fs,
        name=path.stem,
        source="file",
        inputs=channels(u),
        outputs=channels(y),
    )


def _split(path: Path, samples: int, validation: float, test: float, skip: int) -> dict[str, slice]:
    """The scored samples of each record by its name."""
    number("data.validation", validation)
    number("data.test", test)
    if not (0 < validation < 1 and 0 < test < 1 and validation + test < 1):
        raise ValueError(
            f"the fractions are validation={validation} and test={test}; both must be above 0 "
            "and leave something for training, for example 0.2 and 0.2."
        )
    integer("data.skip", skip, 0)
    ends = [0, samples - round(samples * validation) - round(samples * test)]
    ends += [samples - round(samples * test), samples]
    parts = {}
    for i, name in enumerate(("train", "validation", "test")):
        first = max(ends[i], skip)
        scored = ends[i + 1] - first
        if scored < _SHORTEST:
            raise ValueError(
                f"'{path}': the {name} part has {scored} scored samples of {samples}, with "
                f"skip={skip}; it needs {_SHORTEST}. Change the fractions or skip, or give a "
                "longer file."
            )
        parts[name] = slice(first, ends[i + 1])
    return parts


def _table(path: Path, wanted: list[str | int]) -> list[Signal]:
    """Columns of a text file, in the order wanted."""
    rows = _rows(path)
    first = rows[0][1]
    numbered = [column for column in wanted if isinstance(column, int)]
    for column in numbered:
        if not 0 <= column < len(first):
            raise ValueError(
                f"'{path}' has no column number {column}: its {len(first)} columns are numbered "
                f"from 0, and its first line says {_quoted(first)}."
            )
    # A first line with a number in a wanted column is a sample, unless columns go by name.
    headed = len(numbered) < len(wanted) or not any(_is_number(first[i]) for i in numbered)
    names = [
        name if headed and name and first.count(name) == 1 else f"column {i}"
        for i, name in enumerate(first)
    ]
    if headed:
        rows = rows[1:]
    if not rows:
        raise ValueError(f"'{path}' has a header line but no samples; give a file with data.")
    signals = []
    for column in wanted:
        name = names[column] if isinstance(column, int) else column
        if name not in names:
            found = f"{first.count(name)} columns" if name in first else "no column"
            raise ValueError(
                f"'{path}' has {found} {name!r}; its first line says {_quoted(first)}. Give the "
                "name of one column, or its number from 0."
            )
        i = names.index(name)
        values = [[_number(path, line, name, row[i])] for line, row in rows]
        signals.append((name, np.array(values)))
    return signals


def _rows(path: Path) -> list[tuple[int, list[str]]]:
    """Line number and cells of every line that is not blank; as many cells in each."""
    try:
        text = path.read_text(encoding="utf-8-sig")  # Excel begins its UTF-8 with a mark
        lines = text.splitlines()
        first = next((line for line in lines if line.strip()), "")
        delimiter = next((d for d in _DELIMITERS if d in first), ",")
        reader = csv.reader(lines, delimiter=delimiter)
        rows = [(reader.line_num, [cell.strip() for cell in row]) for row in reader]
        rows = [(line, row) for line, row in rows if len(row) > 1 or any(row)]  # not blank
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(
            f"'{path}' is not a readable table ({error}); save it as UTF-8 text, one line a sample."
        ) from error
    if not rows:
        raise ValueError(f"'{path}' is empty; give a file with data.")
    start, header = rows[0]
    header[0] = header[0].lstrip("#% ")  # as numpy.savetxt marks a header
    for line, row in rows:
        if len(row) != len(header):
            raise ValueError(
                f"'{path}', line {line}: {len(row)} column(s), where line {start} has "
                f"{len(header)}; give every line the same columns."
            )
    return rows


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _number(path: Path, line: int, name: str, cell: str) -> float:
    value = float(cell) if _is_number(cell) else math.nan
    if not math.isfinite(value):
        raise ValueError(
            f"'{path}', line {line}: {cell!r} in column {name!r} is not a finite number; write "
            "numbers with a decimal point, and cut or interpolate gaps."
        )
    return value


def _arrays(path: Path, wanted: list[str | int]) -> list[Signal]:
    """Arrays of a .npz file, in the order wanted."""
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            names = file.files
            arrays = {name: np.asarray(file[name]) for name in names if name in wanted}
    except Exception as error:  # a damaged archive raises any of half a dozen kinds
        raise ValueError(
            f"'{path}' is not a readable .npz file ({error}); write it again with numpy.savez, "
            "arrays of numbers only."
        ) from error
    signals = []
    for name in wanted:
        if not isinstance(name, str) or name not in arrays:
            raise ValueError(
                f"'{path}' has no array {name!r}: it has {_quoted(names) or 'none'}. Name one "
                "that is there."
            )
        array = arrays[name]
        array = array[:, None] if array.ndim == 1 else array
        if array.dtype.kind not in "biuf" or array.ndim != 2 or array.shape[0] < array.shape[1]:
            raise ValueError(
                f"'{path}': array {name!r} has shape {arrays[name].shape} and type {array.dtype}; "
                "give real numbers of shape (samples,) or (samples, channels)."
            )
        bad = ~np.isfinite(array).all(axis=1)
        if bad.any():
            raise ValueError(
                f"'{path}': array {name!r} has NaN or infinite values in {bad.sum()} sample(s), "
                f"the first at index {np.argmax(bad)}; cut or interpolate them."
            )
        signals.append((name, array.astype(np.float64)))
    return signals
