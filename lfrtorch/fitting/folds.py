"""Stretches of time that are left out of a fit in turn: blocked cross-validation inside records.

A stretch is left out by a mask, and the model is simulated through it. So the stretch begins in the
state that the inputs before it lead to, and a slow system is not judged by the start states of
short pieces. Records with a measured start are cut instead, as each piece begins at an output.

References:
    Burman, Chow and Nolan, "A cross-validatory method for dependent data", Biometrika 81(2), 1994.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from lfrtorch._support.checks import integer
from lfrtorch._support.errors import InputError
from lfrtorch.data.records import Record, as_records, without_coordinates
from lfrtorch.data.score_window import SHORTEST, score_window, with_window


class Fold(NamedTuple):
    """Training records, and the samples that were left out of them.

    Args:
        train: the records, with masked measurements in the stretch that is left out.
        windows: for each record, first left-out sample and the sample after the last one; both are
            equal if none is left out.
        begun: for each record, the left-out samples as a record that begins in an estimated state;
            None if they are too few to determine a state and score the rest. With a measured
            start it begins a horizon earlier, at the output that the first prediction needs.
    """

    train: list[Record]
    windows: list[tuple[int, int]]
    begun: list[Record | None]

    def left_out(self, signals: Sequence[np.ndarray]) -> np.ndarray:
        """Return the samples that are left out of signals (T, n), a signal each record."""
        pairs = zip(signals, self.windows, strict=True)
        return np.concatenate([signal[a:b] for signal, (a, b) in pairs])

    def begun_again(
        self, signals: Sequence[np.ndarray], simulate: Callable[[Record], np.ndarray]
    ) -> np.ndarray:
        """Return ``left_out`` of signals, with simulations that begin there in their place."""
        found = [np.array(signal) for signal in signals]
        for signal, part, (_, b) in zip(found, self.begun, self.windows, strict=True):
            if part is not None:  # whose skipped samples tell its start
                signal[b - part.samples + part.skip : b] = simulate(part)[part.skip :]
        return self.left_out(found)


def as_folded(records: Record | Sequence[Record]) -> list[Record]:
    """Return the records as folds cut them: none periodic, each with its score window."""
    free = [without_coordinates(record) for record in as_records(records)]
    moving: dict[str, Any] = {"start": "estimated", "period": None, "line_weight": None}
    return [with_window(replace(r, **moving) if r.start == "periodic" else r) for r in free]


def folds(records: Sequence[Record], count: int, horizon: int = 0) -> list[Fold]:
    """Cut records of ``as_folded`` into stretches of about equal length, each left out in turn.

    The scored samples of all records are laid end to end and divided by ``count``. Records with a
    measured start are predicted ``horizon`` samples ahead; 0: simulated from the first output.

    Raises:
        ValueError: a stretch without samples, or that leaves nothing to fit.

    Example:
        >>> from lfrtorch.fitting.folds import folds
        >>> first, second = folds([lfrtorch.Record(u, y, skip=20)], 2)
        >>> first.windows, second.windows
        ([(20, 210)], [(210, 400)])
    """
    integer("folds", count, 2)
    ends = np.cumsum([0] + [r.samples - r.skip for r in records])
    cuts = np.linspace(0, ends[-1], count + 1).round().astype(int)
    found = []
    for first, last in pairwise(cuts):
        windows = [
            (r.skip + int(np.clip(first - at, 0, r.samples - r.skip)),
             r.skip + int(np.clip(last - at, 0, r.samples - r.skip)))
            for r, at in zip(records, ends, strict=False)
        ]  # fmt: skip
        pairs = zip(records, windows, strict=True)
        train = [part for r, window in pairs for part in _outside(r, *window, horizon)]
        if last - first < SHORTEST or not train:
            raise InputError(
                f"the records have {ends[-1]} scored samples, of which {count} stretches are left "
                f"out in turn; each needs {SHORTEST}: give longer records."
            )
        begun = [_begun(r, *window, horizon) for r, window in zip(records, windows, strict=True)]
        found.append(Fold(train, windows, begun))
    return found


def _begun(record: Record, first: int, last: int, horizon: int) -> Record | None:
    """Return a stretch of a record as one that begins there; None if it is too short."""
    if record.start == "measured":
        before = max(first - max(horizon, 1), 0)
        return replace(record[before:last], skip=first - before) if last > first else None
    skip = score_window(last - first) if last > first else 0
    valid = np.ones_like(record.y, dtype=bool) if record.valid is None else record.valid
    told = valid[first : first + skip].any(axis=0).all() and valid[first + skip : last].any()
    if last - first - skip < SHORTEST or not told:
        return None
    return replace(record[first:last], start="estimated", skip=skip)


def _outside(record: Record, first: int, last: int, horizon: int) -> list[Record]:
    """Return the record without the measurements of a stretch; an empty list if none is left."""
    if record.start == "measured" and last > first:
        pieces = slice(first), slice(last, record.samples)
        return [record[p] for p in pieces if len(record.u[p]) > max(horizon, SHORTEST)]
    valid = record.is_valid.copy()
    valid[first:last] = False
    if not valid[record.skip :].any(axis=0).all():
        return []
    # An estimated start is fitted to all samples that are left.
    skip = 0 if record.start == "estimated" else record.skip
    return [replace(record, valid=valid, skip=skip)]
