"""Which of several models do as well as the best: errors on the same samples, compared in pairs.

By the one-standard-error rule the smallest model is taken whose error is within one standard error
of the best. All models are scored on the same samples and share their noise, which says nothing of
one against another; what tells two apart is the difference of their squared errors, and the
standard error is that of its mean. That difference is correlated in time, so its means over ten
blocks are taken as independent: they are if a block is long against the system's memory.
The usual form, with the standard error of the best model's own error, is blind if noise is
large: a mean square above it by 1.4 %, three standard errors of the difference over 2600 samples,
is half of one of its own. Of two models that are equally good the smaller is taken in 83 % of
cases.

Long records tell apart what is not worth a parameter (on the Silverbox 25 neurons are better than 5
by 0.6 % and two standard errors), so a model within 1 % of the best does as well. Where a few
resonances or impacts make up most of the error, one standard error can be a fifth of it, and the
smallest model that is so near leaves out just these; so by default no model more than 5 % above
the best does as well.

References:
    Hastie, Tibshirani and Friedman, "The Elements of Statistical Learning", 2nd ed., 2009, section
    7.10 (the rule).
    Schmeiser, "Batch size effects in the analysis of simulation output", Operations Research 30(3),
    1982 (10 to 30 blocks).
"""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil, inf

import numpy as np

from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array, Booleans, Integers

MARGIN = 0.01
"""A model does as well as the best if its rms error exceeds that one's by at most this part."""

BLOCKS = 10
"""Least number of blocks of time, over all records."""


def as_good(
    squares: Sequence[Array] | Array, counts: Integers, *, errors: float = 1.0, most: float = 1.05
) -> Booleans:
    """Return which models do as well as the best.

    Their mean squares are within so many standard ``errors`` of the least and their rms errors at
    most ``most`` times as large, or within ``MARGIN``.
    """
    means = np.asarray(squares).sum(axis=1)
    near = standard_errors_above(squares, counts) <= errors
    near &= means <= most**2 * means.min()
    return near | (means <= (1.0 + MARGIN) ** 2 * means.min())


def no_progress(errors: Sequence[float], last: int) -> bool:
    """Return whether none of the last few rms errors is below the earlier ones by ``MARGIN``."""
    earlier = errors[:-last]
    return bool(earlier) and min(errors[-last:]) > min(earlier) / (1.0 + MARGIN)


def standard_errors_above(squares: Sequence[Array] | Array, counts: Integers) -> Array:
    """Return how far the mean squares of models are above the least, in its standard errors.

    Args:
        squares: sums of squared errors in each block of time (C, B); infinite if one diverges.
        counts: samples of each block (B,).
    """
    sums = np.asarray(squares)
    best = int(np.argmin(sums.sum(axis=1)))
    with np.errstate(invalid="ignore", divide="ignore"):
        difference, error = blocked_mean(sums - sums[best], counts)
        above = np.where(difference == 0.0, 0.0, difference / error)
    return np.where(np.isfinite(above), above, inf)


def blocked_mean(sums: Array, counts: Integers) -> tuple[Array, Array]:
    """Return the mean of a signal from its sums (..., B) over blocks, and its standard error."""
    B, samples = len(counts), counts.sum()
    mean = sums.sum(axis=-1) / samples
    rest = sums - mean[..., None] * counts
    largest = np.abs(rest).max(axis=-1)
    parts = rest / np.where(largest > 0.0, largest, 1.0)[..., None]  # whose squares are numbers
    return mean, largest * np.sqrt(B / (B - 1.0) * (parts**2).sum(axis=-1)) / samples


def squares_in_blocks(errors: Sequence[Array]) -> Array:
    """Return sums of squared errors over each block of time; infinite if one is not finite.

    The errors of each record are (T, ny); the outputs' mean counts.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        blocks = in_blocks([np.mean(error**2, axis=1) for error in errors])
        sums = np.array([block.sum() for block in blocks])
    return sums if np.isfinite(sums).all() else np.full(len(sums), inf)


def in_blocks(signals: Sequence[Array], count: int = BLOCKS) -> list[Array]:
    """Cut signals (T,) into blocks of about equal length, ``count`` of them or a few more."""
    samples = sum(map(len, signals))
    if samples < count:
        raise InputError(
            f"the validation records have {samples} scored samples; sizes are chosen with "
            f"{count} at least. Give longer records, or set the sizes."
        )
    return [
        block
        for signal in signals
        for block in np.array_split(signal, ceil(count * len(signal) / samples))
    ]
