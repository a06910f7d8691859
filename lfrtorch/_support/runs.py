"""Several runs below one another in one table, and the sample at which each begins."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lfrtorch._support.types import Array, Integers

_WORDS = (
    *("run", "exp", "experiment", "trial", "test", "episode", "session", "segment", "sequence"),
    *("recording", "record", "sweep", "lap", "batch", "flight", "manoeuvre", "maneuver", "file"),
    *("versuch", "messung", "lauf"),
)
_ENDINGS = "id", "no", "nr", "num", "number", "index", "idx", "name"
_NAMES = re.compile(rf"({'|'.join(_WORDS)})s?([ _.-]?({'|'.join(_ENDINGS)}))?|id", re.IGNORECASE)
_LEAST = 20  # smallest number of samples of most runs
_AGAIN = 10  # steps: the time of a run's start is at most so much later than the last run's


class Runs(NamedTuple):
    """First samples of the runs, from 0, their names and evidence; a single run has no name."""

    starts: Integers
    names: tuple[str, ...] = ("",)
    told: str = ""


def is_run(name: str) -> bool:
    """Tell if the name of a column is one for run numbers, as ``run`` or ``trial_id``."""
    return _NAMES.fullmatch(name) is not None


def find_runs(T: int, labels: Mapping[str, NDArray[Any]], t: Array | None = None) -> Runs:
    """Find runs by columns of labels (T,), constant in each run, or by times (T,) that restart.

    A column counts if each of its values stands in one stretch, most of 20 samples or more.
    """
    numbered = {name: starts for name, each in labels.items() if len(starts := _changes(each))}
    again = np.array([], np.int64) if t is None else restarts(t)
    starts = np.unique(np.concatenate([[0], *numbered.values(), again]).astype(np.int64))
    if len(starts) < 2:
        return Runs(starts)
    names = tuple(str(i) for i in range(1, len(starts) + 1))
    told = "the time begins again"
    if numbered:
        told = f"the column {next(iter(numbered))!r} says"
        own = tuple(_label(labels[next(iter(numbered))][k]) for k in starts)
        names = own if len(set(own)) == len(own) else names
    return Runs(starts, names, told)


def restarts(t: Array) -> Integers:
    """Samples at which a clock returns to its first time; none if it also falls to other times."""
    falls = np.flatnonzero(np.diff(t) < 0) + 1
    starts = np.append(0, falls)
    if not falls.size or np.median(np.diff(np.append(starts, len(t)))) < _LEAST:
        return falls[:0]
    usual = float(np.median(np.abs(np.diff(t))))
    return falls if (np.diff(t[starts]) <= _AGAIN * usual).all() else falls[:0]


def _changes(labels: NDArray[Any]) -> Integers:
    """Samples at which a column changes, if each of its values fills one long stretch."""
    found = np.flatnonzero(labels[1:] != labels[:-1]) + 1
    lengths = np.diff(np.concatenate([[0], found, [len(labels)]]))
    several = 0 < found.size < len(labels) and np.median(lengths) >= _LEAST
    if not several or len(set(labels[np.append(0, found)])) <= found.size:
        return found[:0]
    whole = labels.dtype.kind not in "f" or bool((labels == np.rint(labels)).all())
    return found if whole else found[:0]


def _label(value: Any) -> str:
    """Label as part of a record's name."""
    return f"{value:.0f}" if isinstance(value, float | np.floating) else str(value).strip()
