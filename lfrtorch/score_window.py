"""Which samples of a record are scored, if nobody says: those after what its start may spoil.

A record from rest leaves out what its output takes to settle. An estimated start state is fitted to
the first 50 samples, or the first fifth of a shorter record, and the rest is scored, by every model
alike. Published scores of measured records leave out 10 to 50 samples. What so few outputs do not
tell of a state, its covariance over the training data does.
"""

from __future__ import annotations

from dataclasses import replace

from lfrtorch.records import Record

WINDOW = 50
"""Samples that a start is fitted to, and a score leaves out."""

PART = 5
"""The record over the window, at least."""

WARM_UP, LONGEST = 1 / 20, 1 / 3
"""Part of a record from rest that is left out, and the longest transient that is: beyond it,
leaving it out costs more than it helps."""


def score_window(samples: int) -> int:
    """Samples at the beginning of an estimated record that are not scored.

    Example:
        >>> from lfrtorch.score_window import score_window
        >>> [score_window(samples) for samples in (1000, 100, 4, 1)]
        [50, 20, 1, 0]
    """
    return min(WINDOW, max(1, samples // PART), samples - 1)


def warm_up(samples: int, settling: int) -> int:
    """Samples at the beginning of a record from rest that are neither fitted nor scored.

    Args:
        samples: of the record.
        settling: samples that the output takes to settle to what a periodic input makes; 0 if it
            need not, or the input does not repeat.

    Example:
        >>> from lfrtorch.score_window import warm_up
        >>> warm_up(400, 0), warm_up(400, 100)
        (20, 100)
    """
    return settling if 0 < settling <= LONGEST * samples else round(WARM_UP * samples)


def with_window(record: Record) -> Record:
    """The record as it is scored; one that skips samples says itself which they are.

    Example:
        >>> from lfrtorch.score_window import with_window
        >>> with_window(lfrtorch.Record(u[100:], y[100:], start="estimated"))
        Record('record': u -> y, 300 samples at 1 Hz, start estimated, skip 50)
    """
    if record.start != "estimated" or record.skip:
        return record
    return replace(record, skip=score_window(record.samples))


def fitted(record: Record) -> Record:
    """The record as it is fitted: an estimated start looks at all samples."""
    return replace(record, skip=0) if record.start == "estimated" else record
