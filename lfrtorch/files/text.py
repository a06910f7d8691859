"""A text file as a table, one line a sample, as written by spreadsheets, loggers and programs."""

from __future__ import annotations

import codecs
import csv
import gzip
import io
import re
import warnings
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lfrtorch._support.errors import InputError, brief
from lfrtorch._support.headers import bracketed, is_unit
from lfrtorch.files.frame import FrameTable
from lfrtorch.files.table import LEAST, Table

_HEAD = 1 << 18  # characters in which the layout is looked for
_LONGEST = 1 << 25  # characters of a line
_MARKS = "#%"  # first characters of comment lines
_COMMENT = re.compile(r"^[ \t]*[#%](?!N/?A\b|[A-Z]+/?0?[!?]).*(?:\n|$)", re.MULTILINE)  # no #N/A
_MISSING = ("", "nan", "na", "n/a", "#n/a", "null", "none", "-nan", "<na>", "#na", "-")
_NUMBER = re.compile(  # no digit may match two parts of it: that took hours for a million
    r"[+-]?(\d+(\.\d*)?|\.\d+)(e[+-]?\d+)?|[+-]?inf(inity)?", re.IGNORECASE | re.ASCII
)
_COMMA = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?", re.ASCII)  # a number with a decimal comma
_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2}(,\d{3})+", re.ASCII)  # or three decimals
_WHOLE = re.compile(r"\d{1,9}", re.ASCII)
_DATE = re.compile(
    r"\d{4}-\d\d-\d\d([T ]\d\d:\d\d(:\d\d([.,]\d+)?)?)?(Z|[+-]\d\d:?\d\d)?", re.ASCII
)

_HEADERS = {
    True: "is taken for the names of the columns: such a name stands in quotes, as a number "
    "counts columns from 0",
    None: "is read as a sample; if it is a header, write names in its place",
}

_DAMAGED = (OSError, EOFError, zlib.error, UnicodeError)


class Line(NamedTuple):
    """Cells of a line that is not blank."""

    number: int  # from 1
    cells: list[str]
    comment: bool


@dataclass(frozen=True)
class Layout:
    """Layout of a file or a sheet."""

    encoding: str
    delimiter: str
    comma: bool  # whether numbers have a decimal comma
    first: int  # line number of the first sample, from 1
    headers: tuple[str, ...]
    units: dict[str, str]
    dates: frozenset[int]  # columns of date-times
    leads: bool  # whether the first column holds numbers or date-times
    rates: dict[str, float]  # sampling frequencies in the lines above the samples
    notes: tuple[str, ...]
    times: frozenset[int] = frozenset()  # columns of times of day, given in seconds


class TextTable(FrameTable):
    """A text file (.csv, .tsv, .txt, .dat, .lvm, also as .gz), read by pandas in blocks.

    The delimiter is a tab, ";", ",", "|" or blanks, whichever makes the most cells numbers. Numbers
    may have a decimal comma unless the comma is the delimiter. Lines that begin with # or % are
    comments. The samples begin at the first line of numbers. The line above names the columns, with
    a line of units between them at most; lines further above are not read.
    """

    def __init__(self, path: Path, layout: Layout | None = None) -> None:
        self.layout = layout = layout or _layout(path)
        clocks = layout.dates | layout.times
        told = {"units": layout.units, "rates": layout.rates, "clocks": clocks}
        super().__init__(path, layout.headers, self._parsed, **told)
        self.notes = layout.notes

    def _parsed(self, columns: Sequence[int], samples: int) -> Iterator[Any]:
        """Frames of some columns; a line's missing cells are missing values."""
        import pandas as pd  # slow to import

        layout, beyond = self.layout, len(self.columns)
        dates = layout.dates.intersection(columns)
        # pandas takes the number of columns from the first line. So a line of missing values, one
        # more than there are columns, is put before the samples.
        first = layout.delimiter.join(["nan"] * (beyond + 1)) + "\n"
        try:
            for text in self._texts(samples):
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")  # a line of too many cells is refused below
                    part = pd.read_csv(
                        io.StringIO(first + text),
                        sep=r"\s+" if layout.delimiter == " " else layout.delimiter,
                        decimal="," if layout.comma else ".",
                        header=None,
                        names=range(beyond + 1),
                        usecols=sorted({*columns, beyond}),
                        index_col=False,
                        dtype=dict.fromkeys(columns, np.float64)
                        | dict.fromkeys((*dates, beyond), str),
                        na_values=[
                            *_MISSING,
                            *map(str.upper, _MISSING),
                            *map(str.capitalize, _MISSING),
                        ],
                        skipinitialspace=layout.delimiter != " ",
                        **_exact(pd.__version__),
                    )[1:]
                if part[beyond].notna().any():
                    self._explain(columns)
                found = part[[*columns]].copy()
                for column in dates:
                    found[column] = _times(part[column])
                yield found
        except InputError:
            raise
        except (ValueError, *_DAMAGED) as error:  # pandas names the cell, but not its place
            if isinstance(error, ValueError):
                self._explain(columns)
            raise InputError(
                f"'{self.path}' is damaged or not text ({brief(error)}); write it again."
            ) from error

    def labels(self, column: int) -> NDArray[Any]:
        """See :meth:`Table.labels`."""
        found = Table.labels(self, column)
        if len(found):
            return found
        cells = (line.cells for line in self._lines())
        return np.array([each[column] if column < len(each) else "" for each in cells])

    def where(self, sample: int) -> str:
        """The line of a sample."""
        for i, line in enumerate(self._lines()):
            if i == sample:
                return self._place(line.number)
        return super().where(sample)

    def _place(self, number: int) -> str:
        """Place of a line, as a user would look for it."""
        return f"line {number}"

    @contextmanager
    def _stream(self) -> Iterator[Iterable[str]]:
        """Open the file as lines of text."""
        with _Text(self.path, self.layout.encoding) as stream:
            yield stream

    def _texts(self, count: int) -> Iterator[str]:
        """At most ``count`` lines at a time, from the first sample on, without comments."""
        with self._stream() as stream:
            samples = islice(stream, self.layout.first - 1, None)
            lines = self.without_footer(samples, self._is_text)
            while block := list(_bounded(lines, count)):
                text = "".join(block)
                if any(mark in text for mark in _MARKS):
                    text = _COMMENT.sub("", text)
                if text.strip(" \r\n"):
                    yield text

    def _is_text(self, line: str) -> str:
        """Text of a line that begins with words in columns of numbers; empty if it is a sample."""
        start = line.lstrip(' "\t')[:1]
        if not (self.layout.leads and (start.isalpha() or start == "*")):
            return ""
        cell = next(iter(_cells(line.rstrip("\r\n"), self.layout.delimiter)), "")
        known = _is_missing(cell) or self._is_number(cell) or _is_date(cell)
        return "" if known else line.strip()

    def _lines(self) -> Iterator[Line]:
        """The lines of samples."""
        with self._stream() as stream:
            for line in _split(stream, self.layout.delimiter):
                if line.number >= self.layout.first and not line.comment:
                    yield line

    def _explain(self, columns: Sequence[int]) -> None:
        """Refuse the first cell that a sample cannot have."""
        width = len(self.columns)
        for line in self._lines():
            cells = line.cells
            if any(cells[width:]):
                raise InputError(
                    f"'{self.path}', {self._place(line.number)}: {len(cells)} cells, where there "
                    f"are {width} columns; give every line the same columns"
                    + (", and numbers a decimal point." if self.layout.delimiter == "," else ".")
                )
            for column in sorted(columns):
                cell = cells[column] if column < len(cells) else ""
                known = _is_time if column in self.layout.dates else self._is_number
                if not (_is_missing(cell) or known(cell)):
                    kind = "date-time" if column in self.layout.dates else "number"
                    raise InputError(
                        f"'{self.path}', {self._place(line.number)}: {cell!r} in column "
                        f"{self.headers[column]!r} is not a {kind}; correct it, or leave the cell "
                        "empty where the value is missing."
                    )

    def _is_number(self, cell: str) -> bool:
        return _is_number(cell, self.layout.comma)


def _exact(version: str) -> dict[str, Any]:
    """Options that make pandas read numbers to the last bit; from 3.1 on it needs none."""
    old = tuple(map(int, version.split(".")[:2])) < (3, 1)
    return {"float_precision": "round_trip"} if old else {}


def _bounded(lines: Iterable[str], count: int) -> Iterator[str]:
    """The next lines, no more than fit into memory at once."""
    size = 0
    for line in islice(lines, count):
        yield line
        size += len(line)
        if size > _LONGEST:
            return


class _Text(io.TextIOWrapper):
    """Text with a limit for lines: a packed file of blanks alone would be one line of gigabytes."""

    def __init__(self, path: Path, encoding: str) -> None:
        super().__init__(_bytes(path), encoding, errors="replace")
        self._path = path

    def readline(self, size: int = -1) -> str:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The next line."""
        line = super().readline(_LONGEST if size < 0 else size)
        if len(line) == _LONGEST and not line.endswith("\n"):
            raise InputError(
                f"'{self._path}' has a line of more than {_LONGEST} characters and is not a table "
                "of samples: give one line a sample."
            )
        return line


def _bytes(path: Path) -> gzip.GzipFile | io.BufferedReader:
    return gzip.open(path) if path.suffix.lower() == ".gz" else path.open("rb")


def _encoding(path: Path) -> str:
    """The encoding: UTF-8 or UTF-16 if marks or bytes say so, else Latin-1."""
    with _bytes(path) as stream:
        start = stream.read(_HEAD)
    if start.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16"
    if b"\0" in start:
        for encoding, zeros in (("utf-16-le", start[1::2]), ("utf-16-be", start[::2])):
            if zeros.count(0) > 0.9 * len(zeros):
                return encoding
        raise InputError(
            f"'{path}' is not text, as its zero bytes show; give it the extension of its format, "
            "or save it as text."
        )
    for encoding in ("utf-8-sig", "cp1252"):
        with suppress(UnicodeDecodeError):
            codecs.getincrementaldecoder(encoding)().decode(start)
            return encoding
    return "latin-1"


def _split(lines: Iterable[str], delimiter: str) -> Iterator[Line]:
    """Cells of the lines that are not blank."""
    for number, line in enumerate(lines, 1):
        text = line.rstrip("\r\n")
        if not text.strip(" " if delimiter == "\t" else None):
            continue
        comment = _COMMENT.match(text) is not None
        if comment:
            text = text.lstrip().lstrip(_MARKS)
        yield Line(number, _cells(text, delimiter), comment)


def _cells(text: str, delimiter: str) -> list[str]:
    if delimiter == " ":
        # The unit in brackets belongs to the name before it.
        return [cell.strip('"') for cell in re.split(r"\s+(?![(\[])", text.strip())]
    if len(text) > csv.field_size_limit() and delimiter not in text:  # csv takes no such cell
        return [text]
    cells = next(csv.reader([text.strip(" ")], delimiter=delimiter, skipinitialspace=True), [])
    return [cell.strip() for cell in cells]


def _layout(path: Path) -> Layout:
    try:
        encoding = _encoding(path)
        with _Text(path, encoding) as stream:
            head = stream.read(_HEAD)
            head += stream.readline()
    except _DAMAGED as error:
        raise InputError(f"'{path}' is damaged ({brief(error)}); write it again.") from error
    text = head.split("\n")  # as a stream has lines: splitlines ends them at form feeds, too
    if not any(line.strip() for line in text):
        raise InputError(f"'{path}' is empty; give a file with data.")
    try:
        # The delimiter " " stands for any number of blanks; the first of the best ones is taken.
        delimiter, lines = max(
            ((d, list(_split(iter(text), d))) for d in ("\t", ";", ",", "|", " ")),
            key=lambda split: _order(split[0], split[1]),
        )
    except csv.Error as error:
        raise InputError(
            f"'{path}' is not a readable table ({brief(error)}); save it again."
        ) from error
    return layout_of(path, encoding, delimiter, lines)


def _bulk(lines: Sequence[Line]) -> list[list[str]]:
    """Cells of the second half of the lines, which are samples unless the preamble is very long."""
    samples = [line.cells for line in lines if not line.comment]
    return samples[len(samples) // 2 :]


def _order(delimiter: str, lines: Sequence[Line]) -> tuple[float, float]:
    """Quality of a delimiter: the share of cells that are numbers, then their count."""
    bulk = _bulk(lines)
    commas = (False,) if delimiter == "," else (False, True)
    known = [
        sum(
            any(_is_number(c, comma) for comma in commas) or _is_date(c) or _is_missing(c)
            for c in cells
        )
        / len(cells)
        for cells in bulk
        if cells
    ]
    return (
        (round(sum(known) / len(known), 6), sum(map(len, bulk)) / len(bulk))
        if known
        else (0.0, 0.0)
    )


def layout_of(path: Path, encoding: str, delimiter: str, lines: list[Line]) -> Layout:
    """The layout of a file from its first lines."""
    bulk = _bulk(lines)
    width = Counter(map(len, bulk)).most_common(1)[0][0] if bulk else 0
    whole = [cells for cells in bulk if len(cells) == width]
    comma = delimiter != "," and _decimal_comma(whole)

    def numeric(cell: str) -> bool:
        return _is_number(cell, comma) or _is_date(cell)

    # Columns that hold numbers or nothing, and the first line that fits them.
    given = [[cells[i] for cells in whole if not _is_missing(cells[i])] for i in range(width)]
    most = {i for i, cells in enumerate(given) if 2 * sum(map(numeric, cells)) > len(cells)}
    empty = {i for i, cells in enumerate(given) if not cells}
    clean = (
        i
        for i, line in enumerate(lines)
        if not line.comment
        and len(line.cells) == width
        and any(numeric(line.cells[c]) for c in most)
        and all(numeric(line.cells[c]) or _is_missing(line.cells[c]) for c in most | empty)
    )
    start = next(clean, None)
    if start is None:
        shown = delimiter.join(lines[0].cells)
        raise InputError(
            f"'{path}' has no samples: no line of numbers follows its first line, "
            f"{shown[:80]!r}; give a file with data."
        )
    # A line of samples does not become a header by one number that cannot be read.
    while start:
        _, cells, comment = lines[start - 1]
        if comment or len(cells) != width or not any(map(numeric, cells)):
            break
        start -= 1

    above = [
        line.cells
        for line in lines[:start]
        if len(line.cells) >= width and not any(map(numeric, line.cells[:width]))
    ]
    notes: tuple[str, ...] = ()
    if not above:
        below = [ln.cells for ln in lines[start + 1 :] if not ln.comment and len(ln.cells) == width]
        named = named_by_numbers(lines[start].cells, below, comma=comma)
        if named is not False:
            shown = brief(repr(delimiter.join(lines[start].cells)))
            notes = (f"line {lines[start].number}, {shown}, {_HEADERS[named]}",)
        if named:
            above, start = [lines[start].cells], start + 1
    unnamed = not above or not above[-1][width - 1]  # the last column
    if width > 1 and unnamed and not any(cells[-1] for cells in whole):
        width -= 1  # every sample ends with a delimiter
        above = [line.cells for line in lines[:start] if len(line.cells) >= width]
    headers, units = _names(above, width)
    names = lines[start - 1].cells if start and not above else []
    if 1 < len(names) < width and not any(map(_is_missing, names)):
        notes += (
            f"line {lines[start - 1].number}, {brief(repr(delimiter.join(names)))}, has "
            f"{len(names)} names for {width} columns and is not used: these are called "
            f"{headers[0]!r} to {headers[-1]!r}",
        )
    return Layout(
        encoding,
        delimiter,
        comma,
        lines[start].number,
        headers,
        units,
        dates=frozenset(i for i in range(width) if any(_is_date(cells[i]) for cells in whole)),
        leads=0 in most,
        rates=_interval(lines[:start]) if 0 in empty else {},
        notes=notes,
    )


def _decimal_comma(whole: list[list[str]]) -> bool:
    """Tell if numbers have a decimal comma: fewer columns have a point than a comma."""
    commas, points, thousands = set(), set(), set()
    for cells in whole:
        for i, cell in enumerate(cells):
            if "." in cell and _NUMBER.fullmatch(cell):
                points.add(i)
            elif "," in cell and _COMMA.fullmatch(cell):
                (thousands if _with_thousands(cell) else commas).add(i)
    return len(commas) > len(points) or bool(thousands and not points)


def named_by_numbers(
    cells: Sequence[str], below: Sequence[Sequence[str]], *, comma: bool = False
) -> bool | None:
    """Tell if a line is a header with numbers as names; None if it may be a sample."""
    # It is if these numbers are unlike all samples below, or are 0, 1, 2 ... as pandas writes them.
    # It is not if a column runs on from its number, as a time does.
    numbers = {i: int(cell) for i, cell in enumerate(cells) if _WHOLE.fullmatch(cell)}
    words = [cell for i, cell in enumerate(cells) if i not in numbers and (cell or i)]
    if any(_is_missing(word) or not word[0].isalpha() for word in words):
        return False
    if len(cells) < 2 or len({*numbers.values()}) < len(numbers) or len(below) < LEAST:
        return False
    columns = {i: _finite((c[i] for c in below), comma) for i in numbers}
    if any(len(values) < LEAST for values in columns.values()):
        return False
    unlike = {i for i in numbers if not any(_WHOLE.fullmatch(c[i]) for c in below)}
    far = all(
        abs(number - np.median(columns[i])) > 2 * np.ptp(columns[i])
        for i, number in numbers.items()
    )
    counted = [*numbers.values()] == [*range(len(numbers))]
    running = {i for i, number in numbers.items() if _runs_on(number, columns[i])}
    if running:
        return None if counted and unlike and unlike >= numbers.keys() - running else False
    if not numbers or not (far or counted or unlike == numbers.keys()):
        return False
    index = not cells[0] and all(_is_number(c[0], comma) for c in below)
    if far or words or index or (counted and (len(numbers) > 2 or unlike == numbers.keys())):
        return True
    return None


def _runs_on(number: float, column: Sequence[float]) -> bool:
    """Tell if a column rises evenly, or is constant, from a number on."""
    steps = np.diff([number, *column[:LEAST]])
    usual = float(np.median(steps))
    return bool(not steps.any() or (steps.min() > 0 and 0.5 <= steps[0] / usual <= 2))


def _interval(lines: Sequence[Line]) -> dict[str, float]:
    """The sampling frequency from LabVIEW's row Delta_X, if its channels have the same."""
    rows = [line.cells[1:] for line in lines if line.cells and line.cells[0] == "Delta_X"]
    steps = {step for cells in rows for comma in (False, True) for step in _finite(cells, comma)}
    return {"Delta_X": 1 / steps.pop()} if len(steps) == 1 and 1e-99 < min(steps) < 1e99 else {}


def _finite(cells: Iterable[str], comma: bool) -> list[float]:
    """The finite numbers among cells."""
    numbers = (float(cell.replace(",", ".")) for cell in cells if _is_number(cell, comma))
    return [number for number in numbers if abs(number) < np.inf]


def _names(above: list[list[str]], width: int) -> tuple[tuple[str, ...], dict[str, str]]:
    """Headers and units by header from the lines above the samples."""
    units: list[str] = []
    if len(above) > 1 and all(not c or is_unit(c) or bracketed(c) for c in above[-1]):
        *above, units = above
    if len(above) > 1 and _doubled(above[-1]) and not _doubled(above[-2]):
        above.pop()  # words as units, such as "Volt, Volt"
    names = above[-1] if above else []
    names = names[: max([width, *(i + 1 for i, name in enumerate(names) if name)])]
    headers = tuple(name or f"column {i}" for i, name in enumerate(names)) or tuple(
        f"column {i}" for i in range(width)
    )
    return headers, {
        header: bracketed(unit) or unit
        for header, unit in zip(headers, units, strict=False)
        if unit
    }


def _doubled(names: list[str]) -> bool:
    return len(set(names)) < len(names)


def _is_number(cell: str, comma: bool) -> bool:
    if comma and _COMMA.fullmatch(cell):
        return True
    return not (comma and "." in cell) and _NUMBER.fullmatch(cell) is not None


def _is_date(cell: str) -> bool:
    return _DATE.fullmatch(cell) is not None


def _is_time(cell: str) -> bool:
    """Tell if a cell is a date that exists: 2020-02-30 only has the form of one."""
    import pandas as pd

    try:
        return _is_date(cell) and _times(pd.Series([cell])).size == 1
    except ValueError:
        return False


def _is_missing(cell: str) -> bool:
    """Tell if a cell stands for a missing value."""
    return cell.lower() in _MISSING


def with_point(cell: str, *, comma: bool) -> str:
    """A number with a decimal point; 5,189 may mean thousands, unless commas are decimal."""
    decimal = _COMMA.fullmatch(cell) and (comma or not _with_thousands(cell))
    return cell.replace(",", ".") if decimal else cell


def _with_thousands(cell: str) -> bool:
    """Tell if a comma may separate thousands, as in 5,189."""
    return _THOUSANDS.fullmatch(cell) is not None


def _times(values) -> NDArray[np.datetime64]:
    import pandas as pd

    times = pd.to_datetime(values.str.replace(",", "."), format="ISO8601", utc=True)
    return times.dt.tz_localize(None).to_numpy().astype("M8[ns]")
