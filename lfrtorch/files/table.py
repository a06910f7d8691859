"""A file as a table of channels that is read in blocks."""

from __future__ import annotations

import difflib
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from lfrtorch._support.errors import InputError, brief
from lfrtorch._support.headers import names_and_units
from lfrtorch._support.memory import check_memory
from lfrtorch._support.types import Array
from lfrtorch.data.records import Channel

Columns = str | int | Sequence[str | int]
"""Columns of a table by their names or numbers: one or several."""

BLOCK = 65536
"""Samples in memory at once."""

LEAST = 10
"""Samples needed to tell a header of numbers, or words at the end, from them; and the most rows of
words at the end."""

_CHANNEL = re.compile(r"(.+)\[(\d+)\]")
_SIDES = {
    "inputs": re.compile(r"(u|uest|in|input)_?(\d*)", re.IGNORECASE),
    "outputs": re.compile(r"(y|yest|out|output)_?(\d*)", re.IGNORECASE),
}
"""Column names that leave no doubt of their use, each with a number if there are several."""

_Row = TypeVar("_Row")

_ALL, _SOME = 24, 20  # a message names all columns if there are up to 24, else the first 20
_RATE = re.compile(r"((?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?)\s*(k?)Hz", re.IGNORECASE)
_NAME = 60  # characters of a column's name in a list


class NoColumnError(InputError):
    """A file that does not have the wanted column."""


class Table(ABC):
    """Channels of one file: consecutive samples (T, columns), NaN where a value is missing.

    Args:
        path: the file.
        headers: the columns as the file names them, with units in brackets or after "/".
        units: units of columns by header, if the file has them separately.
        arrays: column numbers by the name of an array of several channels.
        refused: why something in the file is not a channel, by its name.
        rates: sampling frequencies in Hz that stand in the file, by their names.
        lengths: samples of each column, if they may differ.
        clocks: columns of date-times, which are given in seconds whatever their headers say.
    """

    path: Path
    columns: tuple[Channel, ...]
    notes: tuple[str, ...] = ()
    """Remarks on the reading of the file, for the user."""
    contents: Sequence[tuple[str, str, str]] = ()
    """Contents of a file of arrays: name, shape and role of each."""
    asked: float | None = None
    """The rate in Hz to which the signals are interpolated, as in ``x.csv#50Hz``."""

    def __init__(
        self,
        path: Path,
        headers: Sequence[str],
        *,
        units: Mapping[str, str] | None = None,
        arrays: Mapping[str, tuple[int, ...]] | None = None,
        refused: Mapping[str, str] | None = None,
        rates: Mapping[str, float] | None = None,
        lengths: Sequence[int] = (),
        clocks: Container[int] = (),
    ) -> None:
        self.path = path
        self.headers = tuple(headers)
        self.columns = tuple(
            channel._replace(unit="s") if i in clocks else channel
            for i, channel in enumerate(
                Channel(*each) for each in names_and_units(headers, units or {})
            )
        )
        self.arrays = dict(arrays or {})
        self.refused = dict(refused or {})
        self.rates = dict(rates or {})
        self.lengths = tuple(lengths)
        self.clocks = clocks

    @abstractmethod
    def blocks(self, columns: Sequence[int], samples: int = BLOCK) -> Iterator[Array]:
        """Yield at most ``samples`` samples at a time, (n, len(columns)).

        Date-times are in seconds since the first of the file.

        Raises:
            ValueError: a damaged file, columns of different lengths, or text that is not a number.
        """

    def labels(self, column: int) -> NDArray[Any]:
        """All entries of a column, which may be words; none if they cannot be read."""
        try:
            return self.read([column])[:, 0]
        except InputError:
            return np.array([])

    def without_footer(self, rows: Iterable[_Row], said: Callable[[_Row], str]) -> Iterator[_Row]:
        """Yield rows without the rows of words at the end, which a note names."""
        # ``said`` returns the text of a row that is not a sample, and nothing for a sample.
        held, words, count = [], "", 0
        for row in rows:
            text = said(row) if count >= LEAST and len(held) < LEAST else ""
            words = words or text
            if text or (held and isinstance(row, str) and row.isspace()):
                held.append(row)
                continue
            yield from held
            held.clear()
            yield row
            words, count = "", count + 1
        note = f"the end of the file, from {brief(repr(words), _NAME)} on, has no samples"
        if words and note not in self.notes:
            self.notes = (*self.notes, note)

    def beside(self, column: int, columns: Sequence[int]) -> bool:
        """Tell whether a column can be read with others."""
        return not self.lengths or self.lengths[column] == self.lengths[columns[0]]

    def where(self, sample: int) -> str:
        """Place of a sample, as a user would look for it."""
        return f"sample {sample} (from 0)"

    def read(self, columns: Sequence[int]) -> Array:
        """All samples of some columns, (T, len(columns))."""
        T = max((self.lengths[column] for column in columns), default=0) if self.lengths else 0
        self.check_memory(T * len(columns))
        grown = bytearray()  # grows in place: joining a list of blocks would need twice the memory
        for block in self.blocks(columns):
            grown += block.tobytes()
            self.check_memory(len(grown) // 8)
        return np.frombuffer(grown, np.float64).reshape(-1, len(columns))

    def check_memory(self, numbers: float) -> None:
        """Refuse with a ValueError to read more numbers than there is memory for."""
        # Samples are in memory three times: as read, as a record, and normalised.
        check_memory(
            3 * 8.0 * numbers,
            f"'{self.path}', of which {numbers:g} numbers are to be read,",
            "give a part of it",
        )

    def find(self, wanted: str | int | Sequence[str | int] | None, option: str) -> tuple[int, ...]:
        """Return the numbers of columns given by name, header or number."""
        # The name u of an array of several channels stands for all of them, u[0] for the first.
        # Messages call the argument by the name ``option``.
        listed = [wanted] if isinstance(wanted, str | int) else wanted
        if (
            not isinstance(listed, Sequence)
            or not listed
            or not all(isinstance(w, str | int) and not isinstance(w, bool) for w in listed)
        ):
            raise InputError(
                f"{option} is {wanted!r}; give {option}=[...], names of columns or their numbers "
                f"from 0. '{self.path}' has {self.listed}."
            )
        return tuple(column for one in listed for column in self._find(one, option))

    def by_name(
        self, inputs: Columns | None, outputs: Columns | None
    ) -> tuple[Columns | None, Columns | None, list[str]]:
        """Return inputs and outputs, found by column names if not given, and a note on these."""
        given = {"inputs": inputs, "outputs": outputs}
        told = {side: self._told(side) for side in given if given[side] is None}
        if not told or not all(told.values()):
            return inputs, outputs, []
        said = ", ".join(f"{side}={','.join(names)}" for side, names in told.items())
        given |= told
        return given["inputs"], given["outputs"], [f"{said}, by the names of the columns"]

    def _told(self, side: str) -> list[str]:
        """The columns named as those of a side: a single one, or several with a number each."""
        found = [match for c in self.columns if (match := _SIDES[side].fullmatch(c.name))]
        alike = len({match[1].lower() for match in found}) == 1
        numbers = {match[2] for match in found}
        clear = len(found) == 1 or (len(numbers) == len(found) and "" not in numbers)
        return [match[0] for match in found] if alike and clear else []

    def _find(self, wanted: str | int, option: str) -> tuple[int, ...]:
        if isinstance(wanted, int):
            if not 0 <= wanted < len(self.columns):
                raise NoColumnError(
                    f"'{self.path}' has no column number {wanted}, named in {option}; "
                    f"it has {self.listed}, numbered from 0."
                )
            return (wanted,)
        if wanted in self.arrays:
            return self.arrays[wanted]
        channel = _CHANNEL.fullmatch(wanted)
        if channel and channel[1] in self.arrays:
            array = self.arrays[channel[1]]
            if int(channel[2]) < len(array):
                return (array[int(channel[2])],)
            raise NoColumnError(
                f"'{self.path}' has no {wanted!r}, named in {option}; the channels of "
                f"{channel[1]!r} are {channel[1]}[0] .. {channel[1]}[{len(array) - 1}]."
            )
        for names in (self.headers, [column.name for column in self.columns]):
            found = [i for i, name in enumerate(names) if name == wanted]
            if len(found) == 1:
                return (found[0],)
            if found:
                numbers = ", ".join(map(str, found))
                raise InputError(
                    f"'{self.path}' has {len(found)} columns {wanted!r}, named in {option}; "
                    f"give the number of one: {numbers}."
                )
        if wanted in self.refused:
            raise InputError(
                f"'{self.path}': {wanted!r}, named in {option}, {self.refused[wanted]}."
            )
        close = self._close(wanted.lower())
        meant = f" Did you mean {close!r}?" if close else ""
        raise NoColumnError(
            f"'{self.path}' has no column {wanted!r}, named in {option}; it has {self.listed}."
            f"{meant}"
        )

    def _close(self, wanted: str) -> str | None:
        """The column name, without unit, that a word in small letters may be meant for."""
        spelt = self.headers, [column.name for column in self.columns]
        names = {of[i].lower(): spelt[1][i] for of in spelt for i in range(len(of))}
        close = difflib.get_close_matches(wanted, names, n=1, cutoff=0.75)
        last = [name for name in spelt[1] if re.split(r"\W+", name.lower())[-1] == wanted]
        if close:
            return names[close[0]]
        return last[0] if len(last) == 1 else None

    @property
    def listed(self) -> str:
        """The columns by the names that a user may give, for messages."""
        if not self.columns:
            refused = [*self.refused.items()][:_SOME]
            why = "; ".join(f"{brief(repr(name), _NAME)} {reason}" for name, reason in refused)
            return f"no columns of numbers{f' ({why})' if why else ''}"
        count = len(self.columns)
        names = [brief(repr(column.name), _NAME) for column in self.columns[:_ALL]]
        shown = names if count <= _ALL else [*names[:_SOME], "..."]
        return f"{count} column(s): {', '.join(shown)}"


def rate_behind(text: str) -> float | None:
    """The rate in Hz after a file's name, as in ``x.csv#50Hz``; None if the text is not a rate."""
    found = _RATE.fullmatch(text.strip())
    rate = float(found[1]) * (1000.0 if found[2] else 1.0) if found else 0.0
    return rate if 0 < rate < np.inf else None


class Clock:
    """Seconds since the first of date-times that come in blocks; NaN for a missing date-time."""

    def __init__(self) -> None:
        self._first: np.datetime64 | None = None

    def __call__(self, times: NDArray[np.datetime64]) -> Array:
        """Seconds of a block."""
        times = times.astype("M8[ns]")
        known = ~np.isnat(times)
        if self._first is None and known.any():
            self._first = times[known][0]
        since = np.full(times.shape, np.nan)
        if self._first is not None:
            since[known] = (times[known] - self._first).astype(np.int64) * 1e-9
        return since
