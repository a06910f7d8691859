"""Columns of the tables of scores, each declared once for the terminal and the report."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

from lfrtorch._support import tables
from lfrtorch.data.dataset import Published
from lfrtorch.data.records import common_unit, of_one_unit
from lfrtorch.reporting.evaluation import CROSS, Score, finite

ALL = "all"
"""Name of all outputs together."""

USES = {"train": "fitted", "validation": "chooses the iterate", "selection": "chooses the start"}
"""Words of the report for the uses of records."""


def use_of(use: str, record: str) -> str:
    """Use of a record in words; stretches of cross-validation were "left out in turn"."""
    return "left out in turn" if record.endswith(CROSS) else USES.get(use, use)


class Row(NamedTuple):
    """Errors on a record or a group of records, of one output or of all together."""

    key: str  # name in publications; the name of the record in its first row
    record: str
    score: Score
    output: str
    unit: str
    linear: float | None
    error: float | None = None  # error of the NL-LFR; nan if it diverges
    std: float = math.nan  # standard deviation of the measured output
    factor: float = 1.0  # errors times this factor are in the unit of the row

    @property
    def ratio(self) -> float:
        """The linear model's error over the NL-LFR's."""
        return self.linear / self.error if self.linear is not None and self.error else math.nan

    def scaled(self, error: float | None) -> float | None:
        """An error in the unit of the row."""
        return tables.times(self.factor, error)

    def relative(self, error: float | None) -> float | None:
        """An error over the standard deviation of the output."""
        return None if error is None else error / (self.std or math.nan)


class _Column(NamedTuple):
    """A column of scores: its head, the tables that contain it, and a function for its cells."""

    head: str
    where: str
    cell: Callable[[Row], tables.Cell]


def _error(row: Row) -> tables.Cell:
    """The NL-LFR's error, or the word "diverges"."""
    known = row.error is None or not row.score.scored or math.isfinite(row.error)
    return row.scaled(row.error) if known else "diverges"


def _start(row: Row) -> tables.Cell:
    """Part of the error by the uncertainty of the start, if it is large."""
    return row.scaled(row.score.start_error) if row.score.start_matters else None


def _published(of: Published, row: Row) -> tables.Cell:
    """Published scores of a test."""
    known = of.scores.get(row.key) if row.score.use == "test" else None
    return row.scaled(known)


_COLUMNS = (
    _Column("record", "terminal", lambda r: r.key),
    _Column("record", "tests others", lambda r: r.record if r.key == r.record else ""),
    _Column("record", "linear outputs", lambda r: r.record),
    _Column("use", "terminal linear", lambda r: r.score.use),
    _Column("use", "others", lambda r: use_of(r.score.use, r.key) if r.key == r.record else ""),
    _Column("source", "terminal linear", lambda r: r.score.source.replace("file", "")),
    _Column("scored", "terminal linear", lambda r: r.score.counted),
    _Column("output", "tests others", lambda r: r.output if len(r.score.channels) > 1 else ""),
    _Column("output", "linear outputs", lambda r: r.output),
    _Column("unit", "tests others", lambda r: r.unit if len(r.score.channels) > 1 else ""),
    _Column("unit", "linear outputs", lambda r: r.unit),
    _Column("{linear}", "terminal tests others linear outputs", lambda r: r.scaled(r.linear)),
    _Column("NL-LFR", "terminal tests others", _error),
    _Column("NL-LFR", "outputs", lambda r: r.scaled(finite(r.error))),
    _Column("from the start", "terminal", _start),
    _Column("ratio", "tests others", lambda r: r.ratio),
    _Column("linear NRMSE", "tests others", lambda r: tables.percent(r.relative(r.linear))),
    _Column("% of std", "linear", lambda r: tables.in_percent(r.relative(r.linear))),
    _Column("NRMSE", "tests others", lambda r: tables.percent(r.relative(r.error))),
)


def columns(
    where: str, rows: Sequence[Row], *, linear: str = "linear", published: Sequence[Published] = ()
) -> tuple[list[str], list[list[tables.Cell]], int]:
    """Head and cells of all columns that are not empty, and the number of columns with words."""
    found = [column for column in _COLUMNS if where in column.where.split()]
    found += [_Column(p.label, where, partial(_published, p)) for p in published]
    found = [c for c in found if any(c.cell(row) not in ("", None) for row in rows)]
    head = [column.head.format(linear=linear) for column in found]
    words = sum(column.head in ("record", "use", "output", "unit") for column in found)
    return head, [[column.cell(row) for column in found] for row in rows], words


def rows_of(record: str, score: Score) -> list[Row]:
    """Rows of a record: all outputs together if they have one unit, and each output if several."""
    together, *each = _every_row(record, score)
    joint = [together] if len(each) > 1 and of_one_unit(score.channels) else []
    first, *others = [*joint, *each]
    return [first._replace(key=record), *others]


def named_rows(record: str, score: Score, published: Sequence[Published]) -> list[Row]:
    """Rows of a record: all outputs together, and each output that published scores name."""
    together, *each = _every_row(record, score)
    named = {key.rpartition(" ")[2] for p in published for key in p.scores if " " in key}
    own = [row._replace(unit=together.unit) for row in each if row.output in named]
    rows = [together, *(own if len(each) > 1 else [])]
    return [row._replace(linear=finite(row.linear)) for row in rows]


def _every_row(record: str, score: Score) -> list[Row]:
    """Rows of all outputs together, with relative errors if units differ, and of each output."""
    unknown = [None] * len(score.channels)
    errors = score.lti_rmse_by_output or unknown, score.rmse_by_output or unknown
    unit, joint = common_unit(score.channels), (score.lti_rmse, score.rmse, score.std)
    return [
        Row(record, record, score, ALL, unit, *joint),
        *(
            Row(f"{record} {c.name}", record, score, c.name, c.unit, linear, error, std)
            for c, linear, error, std in zip(
                score.channels, *errors, score.std_by_output, strict=True
            )
        ),
    ]


def in_units(rows: Sequence[Row], published: Sequence[Published] = ()) -> list[Row]:
    """The rows with one prefix for each unit; publications may ask for a prefix."""
    values: dict[str, list[float | None]] = {}
    for row in rows:
        values.setdefault(row.unit, []).extend([row.linear, row.error])
    asked = next((p.unit for p in published if p.unit), "")
    found = {unit: tables.engineering(own, unit, asked) for unit, own in values.items()}
    return [row._replace(factor=found[row.unit][0], unit=found[row.unit][1]) for row in rows]
