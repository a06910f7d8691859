"""Default scored samples of a record: those that its start does not affect.

A record from rest leaves out the samples in which its output settles. An estimated start state is
fitted to the first 50 samples, or the first fifth of a shorter record, and the rest is scored. This
holds for all models alike. Published scores of measured records leave out 10 to 50 samples. So few
outputs are supplemented by the covariance of the states over the training data.
"""

from __future__ import annotations

from dataclasses import replace

from lfrtorch.data.records import Record

WINDOW = 50
"""Samples to which an estimated start is fitted, and which a score leaves out."""

PART = 5
"""Smallest length of a record, relative to the window."""

SHORTEST = 10
"""Smallest number of scored samples of a part of a record."""

# Part of a record from rest that is left out, and the longest transient that is left out, as a part
# of the record: leaving out a longer one costs more than it helps.
_WARM_UP, _LONGEST = 1 / 20, 1 / 3


def score_window(samples: int) -> int:
    """Number of samples at the beginning of an estimated record that are not scored."""
    return min(WINDOW, max(1, samples // PART), samples - 1)


def warm_up(samples: int, settling: int) -> int:
    """Number of samples at the beginning of a record from rest that are left out.

    ``settling`` is the number of samples until the output has settled under a periodic input; 0 if
    it has settled from the beginning, or if the input does not repeat.
    """
    return settling if 0 < settling <= _LONGEST * samples else round(_WARM_UP * samples)


def with_window(record: Record, later: int = 0) -> Record:
    """Return the record as it is scored; a record that skips samples stays as it is.

    Inputs before the record act on the first ``later`` samples, and the window begins after them.
    """
    if record.start != "estimated" or record.skip:
        return record
    return replace(record, skip=min(later + score_window(record.samples), record.samples - 1))


def fitted(record: Record) -> Record:
    """Return the record as it is fitted: an estimated start uses all samples."""
    return replace(record, skip=0) if record.start == "estimated" else record
