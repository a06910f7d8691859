"""Stretches of time that are left out of a fit in turn: cross-validation inside records.

A short record has no part to spare for validation. So each of several stretches is left out once,
the rest of the record trains, and the model simulates the whole record through what was left out.

The errors there compare models. They are no estimate of the error on new data: the start of a fit,
with its linear model and scales, may have seen the whole record, and what was left out chooses the
iterate. Of outputs that are noise alone they were 0.5 to 3 % below the rms of the noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

from lfrtorch._support.checks import integer
from lfrtorch._support.errors import InputError
from lfrtorch.records import Record, as_records
from lfrtorch.score_window import SHORTEST


class Fold(NamedTuple):
    """What trains and what was left out of it.

    Args:
        train: the rest, before and after.
        left_out: records up to the end of the stretch, which skip what is before it.
    """

    train: list[Record]
    left_out: list[Record]


def folds(records: Record | Sequence[Record], count: int) -> list[Fold]:
    """Cut records into stretches of equal length, each left out in turn.

    The scored samples of all records are laid end to end and divided by ``count``. What comes after
    a stretch begins amid the measurement, and its start state is estimated. A record in steady
    state is divided between its periods, and so are the parts in steady state.

    Args:
        records: what there is to fit and to choose by.
        count: of the stretches, 2 or more.

    Raises:
        ValueError: a stretch without samples, or that leaves nothing to fit.

    Example:
        >>> from lfrtorch.fitting.folds import folds
        >>> first, second = folds(lfrtorch.Record(u, y, skip=20), 2)
        >>> [(r.samples, r.start) for r in first.train]
        [(190, 'estimated')]
        >>> second.left_out
        [Record('record': u -> y, 400 samples at 1 Hz, start zero, skip 210)]
    """
    records = as_records(records)
    integer("folds", count, 2)
    total = sum(r.samples - r.skip for r in records)
    found = []
    for number in range(count):
        fold, before = Fold([], []), 0
        for record in records:
            scored, unit = record.samples - record.skip, _unit(record)
            begin = 0 if record.start == "periodic" else record.skip
            first, last = (
                begin + unit * round(min(max(edge - before, 0), scored) / unit)
                for edge in (total * number / count, total * (number + 1) / count)
            )
            before += scored
            if last - first < min(SHORTEST, scored):
                fold.train.append(record)
                continue
            fold.left_out.append(_between(record, first, last))
            fold.train.extend(_around(record, first, last))
        if not (fold.train and fold.left_out):
            raise InputError(
                f"folds is {count}, and one of these stretches has no samples of its own or leaves "
                "none; give fewer, or more records."
            )
        found.append(fold)
    return found


def _unit(record: Record) -> int:
    """Samples that stay together."""
    return (record.period or record.samples) if record.start == "periodic" else 1


def _between(record: Record, first: int, last: int) -> Record:
    """The record up to the end of a stretch, with what is before it skipped."""
    if record.start == "periodic":
        return _periods(record, first, last)
    return replace(record[:last], start=record.start, x0=record.x0, skip=first)


def _around(record: Record, first: int, last: int) -> list[Record]:
    """What is before a stretch, and what is after it."""
    if record.start == "periodic":
        ends = [(0, first), (last, record.samples)]
        return [_periods(record, a, b) for a, b in ends if b > a]
    found = []
    if first - record.skip >= SHORTEST:
        before = replace(record[:first], start=record.start, x0=record.x0, skip=record.skip)
        found.append(before)
    if record.samples - last >= SHORTEST:
        found.append(replace(record[last:], start="estimated"))
    return found


def _periods(record: Record, first: int, last: int) -> Record:
    """Whole periods of a record in steady state."""
    if (first, last) == (0, record.samples):
        return record
    return replace(record[first:last], start="periodic", period=_unit(record))
