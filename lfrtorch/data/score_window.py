"""Which samples of a record are scored, if nobody says: those after what its start may spoil.

A record from rest leaves out what its output takes to settle. An estimated start state is fitted to
the first 50 samples, or the first fifth of a shorter record, and the rest is scored, by every model
alike. Published scores of measured records leave out 10 to 50 samples. What so few outputs do not
tell of a state, its covariance over the training data does.
"""

from __future__ import annotations

from dataclasses import replace

from lfrtorch.data.records import Record

WINDOW = 50
"""Samples that a start is fitted to, and a score leaves out."""

PART = 5
"""The record over the window, at least."""

SHORTEST = 10
"""Least scored samples of a part of a record."""

# Part of a record from rest that is left out, and the longest transient that is: beyond it, leaving
# it out costs more than it helps.
_WARM_UP, _LONGEST = 1 / 20, 1 / 3


def score_window(samples: int) -> int:
    """Return how many samples at the beginning of an estimated record are not scored."""
    return min(WINDOW, max(1, samples // PART), samples - 1)


def warm_up(samples: int, settling: int) -> int:
    """Return how many samples at the beginning of a record from rest are left out.

    ``settling`` is how many the output takes to settle to what a periodic input makes; 0 if it need
    not, or the input does not repeat.
    """
    return settling if 0 < settling <= _LONGEST * samples else round(_WARM_UP * samples)


def with_window(record: Record) -> Record:
    """Return the record as it is scored; one that skips samples says itself which they are."""
    if record.start != "estimated" or record.skip:
        return record
    return replace(record, skip=score_window(record.samples))


def fitted(record: Record) -> Record:
    """Return the record as it is fitted: an estimated start looks at all samples."""
    return replace(record, skip=0) if record.start == "estimated" else record
