"""A sheet of an Excel workbook as a table."""

from __future__ import annotations

import warnings
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import date, datetime, time, timedelta
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from lfrtorch._support.errors import InputError, brief
from lfrtorch._support.memory import in_bytes
from lfrtorch._support.types import Array
from lfrtorch.files.arrays import optional
from lfrtorch.files.table import BLOCK, Clock, Table
from lfrtorch.files.text import Layout, Line, is_missing, layout_of, with_thousands

_HEAD = 1000
"""Rows that tell where the samples begin."""

_MOST_ROWS = 2**20
"""Rows that a sheet of Excel may have."""

_PACKED, _LARGE = 100, 1e8
"""How many times longer a part of that many bytes may be than it is packed: see Apache POI,
ZipSecureFile, whose limits are 100 times and 1e5 bytes. Sheets of numbers are packed 5 to 20 times.
"""

EXTENSIONS = (".xlsx", ".xlsm")


def workbook(path: Path) -> tuple[Path, str]:
    """The file of a path and the sheet behind it, empty if it names none.

    Example:
        >>> from pathlib import Path
        >>> from lfrtorch.files.excel import workbook
        >>> file, sheet = workbook(Path("rig.xlsx#Run 2"))
        >>> file.name, sheet
        ('rig.xlsx', 'Run 2')
    """
    name, mark, sheet = str(path).rpartition("#")
    file = Path(name)
    named = mark and file.suffix.lower() in EXTENSIONS and not path.is_file()
    return (file, sheet) if named else (path, "")


class ExcelTable(Table):
    """A sheet, a row a sample; above may be names, units and what else is not read.

    It is the first sheet that has samples, or that named behind the path: ``x.xlsx#Run 2``.
    """

    def __init__(self, path: Path) -> None:
        self._file, sheet = workbook(path)
        with self._opened() as book:
            names = [one.title for one in book.worksheets]
            if sheet and sheet not in names:
                raise InputError(f"'{self._file}' has no sheet {sheet!r}; it has {_listed(names)}.")
            with_samples = []
            refusal = None
            for one in [sheet] if sheet else names:
                try:
                    with_samples.append((one, self._layout(book[one])))
                except InputError as error:
                    refusal = error
        if not with_samples:
            raise refusal or InputError(f"'{self._file}' has no sheet.")
        self._sheet, (self._head, self._used, clocks) = with_samples[0]
        super().__init__(
            path, self._head.headers, units=self._head.units, clocks=self._head.dates | clocks
        )
        self.notes = self._head.notes
        if len(with_samples) > 1:
            self.notes += (
                f"the sheet {self._sheet!r} is read, the first of {len(with_samples)} with "
                f"samples; '{self._file.name}#{with_samples[1][0]}' is the next",
            )

    def _layout(self, sheet: Any) -> tuple[Layout, list[int], set[int]]:
        """Where what is, the columns in use, and those of them that are times of day."""
        rows = list(islice(self._rows(sheet), _HEAD))
        head = [[_text(cell) for cell in row] for row in rows]
        width = max(map(len, head), default=0)
        used = [i for i in range(width) if any(i < len(row) and row[i] for row in head)]
        lines = [
            Line(number, [row[i] if i < len(row) else "" for i in used], False)
            for number, row in enumerate(head, 1)
            if any(row)
        ]
        if not lines:
            raise InputError(f"'{self._file}' is empty; give a file with data.")
        found = layout_of(self._file, "", ";", lines)
        used = used[: len(found.headers)]
        timed = {
            i
            for i, k in enumerate(used)
            if any(k < len(row) and isinstance(row[k], time | timedelta) for row in rows)
        }
        return found, used, timed

    def blocks(self, columns: Sequence[int], samples: int = BLOCK) -> Iterator[Array]:
        """See :meth:`Table.blocks`; empty cells are missing values, empty rows no samples."""
        clocks = {column: Clock() for column in columns}
        rows = self._samples()
        while part := list(islice(rows, samples)):
            found = np.empty((len(part), len(columns)))
            for i, column in enumerate(columns):
                k = self._used[column]
                cells = [(number, row[k] if k < len(row) else None) for number, row in part]
                if column in self._head.dates:
                    times = [self._date(cell, number, column) for number, cell in cells]
                    found[:, i] = clocks[column](np.array(times, "M8[ns]"))
                else:
                    found[:, i] = [self._number(cell, number, column) for number, cell in cells]
            yield found

    def where(self, sample: int) -> str:
        """The row of a sample."""
        row = next(islice(self._samples(), sample, None), None)
        return super().where(sample) if row is None else f"row {row[0]} of sheet {self._sheet!r}"

    def _samples(self) -> Iterator[tuple[int, Sequence[Any]]]:
        """Rows that are not empty, with their numbers."""
        with self._opened() as book:
            numbered = enumerate(self._rows(book[self._sheet]), 1)
            yield from self.without_footer(
                (
                    (number, row)
                    for number, row in numbered
                    if number >= self._head.first
                    and any(_text(row[k]) for k in self._used if k < len(row))
                ),
                self._words,
            )

    def _words(self, row: tuple[int, Sequence[Any]]) -> str:
        """What a row says that begins with words where numbers are; empty if it is a sample."""
        cell = row[1][self._used[0]] if len(row[1]) > self._used[0] else None
        text = cell.strip() if isinstance(cell, str) and self._head.leads else ""
        return text if text[:1].isalpha() and not is_missing(text) else ""

    @contextmanager
    def _opened(self) -> Iterator[Any]:
        openpyxl = optional("openpyxl")
        try:
            self._refuse_bombs()
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # styles and extensions that say nothing of numbers
                book = openpyxl.load_workbook(self._file, read_only=True, data_only=True)
        except InputError:
            raise
        except Exception as error:  # a damaged file raises any of a dozen kinds
            raise self._damaged(error) from error
        try:
            yield book
        finally:
            book.close()

    def _refuse_bombs(self) -> None:
        with zipfile.ZipFile(self._file) as archive:
            for part in archive.infolist():
                if part.file_size > max(_LARGE, _PACKED * part.compress_size):
                    raise InputError(
                        f"'{self._file}': its part {part.filename!r} takes "
                        f"{in_bytes(part.file_size)} unpacked, over {_PACKED} times what it takes "
                        "packed, as in no workbook; save it again as .xlsx."
                    )

    def _rows(self, sheet: Any) -> Iterator[Sequence[Any]]:
        """Rows of a sheet, read one by one."""
        sheet.reset_dimensions()  # what programs write of the size may be wrong
        rows = enumerate(sheet.iter_rows(values_only=True))
        while True:
            try:
                number, row = next(rows, (0, None))
            except Exception as error:
                raise self._damaged(error) from error
            if row is None:
                return
            if number >= _MOST_ROWS:
                raise self._damaged(f"it has more than {_MOST_ROWS} rows")
            yield row

    def _damaged(self, error: Exception | str) -> InputError:
        return InputError(
            f"'{self._file}' is not a readable Excel file ({brief(error)}); save it again as .xlsx."
        )

    def _number(self, cell: Any, row: int, column: int) -> float:
        if isinstance(cell, int | float):
            return float(cell)
        text = _text(cell)
        if is_missing(text):
            return np.nan
        try:
            if with_thousands(text) and not self._head.comma:
                raise ValueError
            return float(text.replace(",", "."))
        except ValueError:
            raise self._refusal(text, row, column, "number") from None

    def _date(self, cell: Any, row: int, column: int) -> np.datetime64:
        text = _text(cell)
        if is_missing(text):
            return np.datetime64("NaT")
        try:
            when = datetime.fromisoformat(text.replace(",", "."))
            return np.datetime64(when.replace(tzinfo=None) - (when.utcoffset() or timedelta()))
        except ValueError:
            raise self._refusal(text, row, column, "date-time") from None

    def _refusal(self, text: str, row: int, column: int, kind: str) -> InputError:
        return InputError(
            f"'{self.path}', row {row} of sheet {self._sheet!r}: {text!r} in column "
            f"{self.headers[column]!r} is not a {kind}; correct it, or leave the cell empty where "
            "the value is missing."
        )


def _text(cell: Any) -> str:
    """A cell as a text file would have it; a time of day or a duration in seconds."""
    if cell is None:
        return ""
    if isinstance(cell, time):
        cell = datetime.combine(date.min, cell) - datetime.min
    if isinstance(cell, timedelta):
        return repr(cell.total_seconds())
    if isinstance(cell, date):
        return cell.isoformat()
    return str(int(cell) if isinstance(cell, bool) else cell).strip()


def _listed(names: Sequence[str]) -> str:
    return ", ".join(map(repr, names))
