"""A sheet of an Excel workbook as a table."""

from __future__ import annotations

import re
import warnings
import zipfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from datetime import date, datetime, time, timedelta
from itertools import islice
from pathlib import Path
from typing import Any

from lfrtorch._support.errors import InputError, brief
from lfrtorch._support.memory import in_bytes
from lfrtorch.files.arrays import optional
from lfrtorch.files.loggers import READERS
from lfrtorch.files.table import rate_behind
from lfrtorch.files.text import Layout, Line, TextTable, layout_of, with_point

_HEAD = 1000
"""First rows of a sheet, in which the beginning of the samples is looked for."""

_MOST_ROWS = 2**20
"""Largest number of rows of a sheet of Excel."""

_PACKED = 100
"""Largest ratio of unpacked to packed size for parts of 1e8 bytes and more. Apache POI's
ZipSecureFile has limits of 100 times and 1e5 bytes. Sheets of numbers are packed 5 to 20 times.
"""

_DELIMITER = "\t"
_NO_TEXT = re.compile(r"[\s\"]+")  # in a cell of a line

EXTENSIONS = (".xlsx", ".xlsm")


def workbook(path: Path) -> tuple[Path, str]:
    """Split a path as ``rig.xlsx#Run 2`` into the file and what follows #, empty if nothing."""
    name, mark, behind = str(path).rpartition("#")
    file = Path(name)
    if not mark or path.is_file():
        return path, ""
    named = file.suffix.lower() in (*EXTENSIONS, *READERS) or (file.suffix and rate_behind(behind))
    return (file, behind) if named else (path, "")


class ExcelTable(TextTable):
    """A sheet read as lines of text: the sheet named in the path, or the first with samples."""

    # openpyxl reads row by row. calamine would end the process at a damaged cell reference.

    def __init__(self, path: Path) -> None:
        self._file, sheet = workbook(path)
        with self._opened() as book:
            names = [one.title for one in book.worksheets]
            if sheet and sheet not in names:
                listed = ", ".join(map(repr, names))
                raise InputError(f"'{self._file}' has no sheet {sheet!r}; it has {listed}.")
            found = []
            refusal = None
            for one in [sheet] if sheet else names:
                try:
                    found.append((one, *self._layout(book[one])))
                except InputError as error:
                    refusal = error
        if not found:
            raise refusal or InputError(f"'{self._file}' has no sheet.")
        self._sheet, layout, self._used = found[0]
        self._comma = layout.comma
        super().__init__(path, replace(layout, comma=False))  # the lines have decimal points
        if len(found) > 1:
            self.notes += (
                f"the sheet {self._sheet!r} is read, the first of {len(found)} with "
                f"samples; '{self._file.name}#{found[1][0]}' is the next",
            )

    def _layout(self, sheet: Any) -> tuple[Layout, list[int]]:
        """Return the layout of a sheet and the columns in use."""
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
        found = layout_of(self._file, "", _DELIMITER, lines)
        used = used[: len(found.headers)]
        clocks = (time, timedelta)
        timed = (
            i
            for i, k in enumerate(used)
            if any(k < len(row) and isinstance(row[k], clocks) for row in rows)
        )
        return replace(found, times=frozenset(timed)), used

    def _place(self, number: int) -> str:
        return f"row {number} of sheet {self._sheet!r}"

    def _is_text(self, line: str) -> str:
        return super()._is_text(line).partition(_DELIMITER)[0]

    @contextmanager
    def _stream(self) -> Iterator[Iterable[str]]:
        with self._opened() as book:
            yield map(self._line, self._rows(book[self._sheet]))

    def _line(self, row: Sequence[Any]) -> str:
        """A row as a line of text."""
        cells = [self._plain(row[k]) if k < len(row) else "" for k in self._used]
        return (_DELIMITER.join(cells) if any(cells) else "") + "\n"

    def _plain(self, cell: Any) -> str:
        """A cell as text in a line."""
        if type(cell) is float:  # nearly all are
            return repr(cell)
        return _NO_TEXT.sub(" ", with_point(_text(cell), comma=self._comma))

    @contextmanager
    def _opened(self) -> Iterator[Any]:
        openpyxl = optional("openpyxl")
        try:
            self._refuse_bombs()
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of styles and extensions, which hold no numbers
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
                if part.file_size > max(1e8, _PACKED * part.compress_size):
                    raise InputError(
                        f"'{self._file}': its part {part.filename!r} takes "
                        f"{in_bytes(part.file_size)} unpacked, over {_PACKED} times what it takes "
                        "packed, as in no workbook; save it again as .xlsx."
                    )

    def _rows(self, sheet: Any) -> Iterator[Sequence[Any]]:
        """Rows of a sheet, read one by one."""
        sheet.reset_dimensions()  # the size that a program wrote may be wrong
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


def _text(cell: Any) -> str:
    """A cell as text, as a text file would have it; times of day and durations in seconds."""
    if cell is None:
        return ""
    if isinstance(cell, time):
        cell = datetime.combine(date.min, cell) - datetime.min
    if isinstance(cell, timedelta):
        return repr(cell.total_seconds())
    if isinstance(cell, date):
        return cell.isoformat()
    return str(int(cell) if isinstance(cell, bool) else cell).strip()
