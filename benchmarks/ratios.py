"""Times of two versions in pairs: the median ratio with an interval, and a table of them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.stats import binom

from lfrtorch._support.types import Array

LIMIT = 1.03
"""Largest ratio: what is slower by more is a change that someone should have meant."""
CONFIDENCE = 0.95
PAIRS, LEAST_PAIRS = 60, 6
"""Short timings in many pairs: other work on the machine comes and goes within seconds. With fewer
than 6 pairs not even the smallest and the largest ratio make an interval of 95 %."""


class Ratio(NamedTuple):
    """Today's time over the baseline's: the median of the pairs, and an interval for it."""

    median: float
    low: float
    high: float

    @property
    def verdict(self) -> str:
        """Whether the limit is kept, as far as the interval tells."""
        if self.low > LIMIT:
            return "**not met**"
        return "met" if self.high <= LIMIT else "open: more pairs tell"


def ratio(seconds: Array) -> Ratio:
    """The median ratio, with a distribution-free interval by order statistics.

    The number of ratios below the true median is binomial.

    Shape:
        seconds: (pairs, 2), baseline and today.
    """
    ratios = np.sort(seconds[:, 1] / seconds[:, 0])
    outside = max(0, int(binom.ppf((1 - CONFIDENCE) / 2, len(ratios), 0.5)) - 1)
    return Ratio(float(np.median(ratios)), float(ratios[outside]), float(ratios[-1 - outside]))


def show(timed: Mapping[str, Array]) -> int:
    """Print the table of all cases; 1 if the whole interval of one lies beyond the limit."""
    found = {case: ratio(seconds) for case, seconds in timed.items()}
    print("\n| case | baseline, ms | today, ms | ratio | 95 % interval | required | |")
    print("|---|---|---|---|---|---|---|")
    for case, value in found.items():
        before, now = 1e3 * np.median(timed[case], axis=0)
        interval = f"{value.low:.3f} .. {value.high:.3f}"
        print(
            f"| {case} | {before:.3g} | {now:.3g} | {value.median:.3f} | {interval} "
            f"| ≤ {LIMIT} | {value.verdict} |"
        )
    return int(any(value.low > LIMIT for value in found.values()))
