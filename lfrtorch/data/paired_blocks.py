"""Comparison of models by their errors on the same samples, in pairs.

The one-standard-error rule takes the smallest model whose error is within one standard error of the
best. All models are scored on the same samples and share their noise, so that only the difference
of their squared errors matters. The standard error is that of the mean of this difference. The
difference is correlated in time, but its means over ten blocks count as independent; they are, if a
block is long compared with the system's memory. The usual rule, with the standard error of the best
model's own error, misses differences if noise is large. Over 2600 samples, a mean square larger by
1.4 % was three standard errors of the difference, but half a standard error of the error itself. If
two models are equally good, the smaller one is taken in 83 % of cases.

Long records resolve differences that are not worth a parameter: on the Silverbox 25 neurons are
better than 5 by 0.6 %, which is two standard errors. So a model within 1 % of the best counts as
equally good. If a few resonances or impacts make up most of the error, one standard error can be a
fifth of it, and the smallest model within it leaves out just these. So no model more than 5 % above
the best counts as equally good.

References:
    Hastie, Tibshirani and Friedman, "The Elements of Statistical Learning", 2nd ed., 2009, section
    7.10 (the rule).
    Schmeiser, "Batch size effects in the analysis of simulation output", Operations Research 30(3),
    1982 (10 to 30 blocks).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, inf, log, sqrt

import numpy as np

from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array, Booleans, Integers

MARGIN = 0.01
"""Relative excess of the rms error up to which a model counts as equally good as the best."""

_MOST = 1.05
"""Largest ratio of rms errors at which a model counts as equally good as the best."""

BLOCKS = 10
"""Smallest number of blocks of time, over all records."""


@dataclass(frozen=True, eq=False)
class Judge:
    """Comparison of models by their errors: orders, sizes, starts, an NL-LFR and its linear model.

    Args:
        squares: sums of squared errors of each model in each block of time; infinite if it
            diverges.
        counts: samples of each block.

    Shape:
        squares: (C, B), counts: (B,).
    """

    squares: Array
    counts: Integers

    @classmethod
    def of(cls, errors: Sequence[Sequence[Array]]) -> Judge:
        """Judge from the errors (T, ny) of models on each record."""
        blocks = in_blocks([e[:, 0] for e in errors[0]])
        counts = np.array([len(block) for block in blocks])
        return cls(np.array([squares_in_blocks(each) for each in errors]), counts)

    def as_good(self) -> Booleans:
        """Mask of the models that are as good as the best.

        Either the rms error is within ``MARGIN`` of the smallest. Or the mean square is within one
        standard error of the smallest, and the rms error at most ``_MOST`` times it.
        """
        means = self.squares.sum(axis=1)
        near = self.above() <= 1.0
        near &= means <= _MOST**2 * means.min()
        return near | (means <= (1.0 + MARGIN) ** 2 * means.min())

    def first_good(self) -> int:
        """First model that is as good as the best."""
        return int(np.argmax(self.as_good()))

    def above(self) -> Array:
        """Excess of the mean squares of models over the smallest one, in standard errors."""
        best = int(np.argmin(self.squares.sum(axis=1)))
        with np.errstate(invalid="ignore", divide="ignore"):
            difference, error = blocked_mean(self.squares - self.squares[best], self.counts)
            above = np.where(difference == 0.0, 0.0, difference / error)
        return np.where(np.isfinite(above), above, inf)

    def ratio(self) -> tuple[float, float]:
        """Ratio of the second model's rms error to the first one's, and its standard error."""
        base, squares = self.squares
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            ratio = sqrt(squares.sum() / base.sum()) if base.any() else 1.0
            # d ratio = d (squares - ratio² base) / (2 ratio mean base).
            level = base.sum() / self.counts.sum() or 1.0
            _, spread = blocked_mean((squares - ratio**2 * base) / level, self.counts)
        return ratio, float(spread) / (2.0 * ratio) if ratio > 0 else 0.0

    def middle(self, most: float, least_error: float) -> tuple[float, float]:
        """Mean log ratio of the second model's errors over the blocks; also in standard errors.

        A ratio beyond ``most`` counts as ``most``, so that a block in which a model diverges has
        little weight.
        """
        base, squares = self.squares
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            logs = 0.5 * np.log(squares / base)
        logs = np.clip(np.nan_to_num(logs), -log(most), log(most))
        error = max(float(logs.std(ddof=1)) / sqrt(len(logs)), least_error)
        return float(logs.mean()), float(logs.mean()) / error


def no_progress(errors: Sequence[float], last: int) -> bool:
    """Tell if none of the last few rms errors is below the earlier ones by ``MARGIN``."""
    earlier = errors[:-last]
    return bool(earlier) and min(errors[-last:]) > min(earlier) / (1.0 + MARGIN)


def blocked_mean(sums: Array, counts: Integers) -> tuple[Array, Array]:
    """Return the mean of a signal from its sums (..., B) over blocks, and its standard error."""
    B, samples = len(counts), counts.sum()
    mean = sums.sum(axis=-1) / samples
    rest = sums - mean[..., None] * counts
    largest = np.abs(rest).max(axis=-1)
    parts = rest / np.where(largest > 0.0, largest, 1.0)[..., None]  # their squares do not overflow
    return mean, largest * np.sqrt(B / (B - 1.0) * (parts**2).sum(axis=-1)) / samples


def squares_in_blocks(errors: Sequence[Array]) -> Array:
    """Return sums of squared errors over each block of time; infinite if one is not finite.

    The errors of each record are (T, ny); squares are averaged over the outputs.
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
