"""Whether a record begins at rest or in motion: the start by which a linear model predicts better.

Two models are estimated from the first three quarters of the record, one from rest and one with an
estimated start state. The last quarter, simulated from the record's start as well, judges them.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np

from lfrtorch._support.errors import InputError
from lfrtorch._support.tables import percent
from lfrtorch.linear.model import LinearModel
from lfrtorch.linear.order_scan import scan_orders
from lfrtorch.metrics import rms
from lfrtorch.records import Record
from lfrtorch.score_window import SHORTEST, warm_up

_LONGEST = 3000
"""Samples that are looked at: a start is forgotten after some time constants."""

_JUDGED = 1 / 4
"""Their part that judges."""

_ORDERS = range(1, 5)
_ITERATIONS = 15
"""Enough to rank the two starts: on two measured records, 200 gave the same ranking."""

_CLEARLY = 0.95
"""An estimated start has parameters of its own: it must lower the judging error by 5 %."""

_UNEXPLAINED = 1.25
"""And from rest the same model must have an error in the beginning that is larger by this."""

_PLAINLY, _NO_WORSE = 10.0, 1.05
"""If it is larger by this, the record is in motion unless an estimated start judges worse: a short
record from rest got a slow pole for the motion, which drifts elsewhere (planted 5 and 10 of
``benchmarks/first_try.md``: error over the output's deviation 6.8 -> 0.056, 2.6 -> 0.24)."""


class StartTrial(NamedTuple):
    """Errors of linear models by start, relative to the output's deviation.

    Args:
        zero, estimated: rms where they judge, of a model from rest and of one with an estimated
            start.
        unexplained: rms in the beginning of the second model from rest, over that from its start.
    """

    zero: float
    estimated: float
    unexplained: float

    @property
    def chosen(self) -> Literal["zero", "estimated"]:
        """The start that a fit should have: rest, unless the estimated one is clearly better."""
        most = _NO_WORSE if self.unexplained > _PLAINLY else _CLEARLY
        moving = self.unexplained > _UNEXPLAINED and self.estimated < most * self.zero
        return "estimated" if moving else "zero"

    def __str__(self) -> str:
        """A sentence with both errors."""
        clearly = self.estimated < _CLEARLY * self.zero
        reason = {
            ("zero", True): ", and rest explains the beginning",
            ("estimated", False): ", and rest does not explain the beginning",
        }
        return (
            f"a linear model validates at {percent(self.zero)} of the output's deviation from rest "
            f"and at {percent(self.estimated)} with an estimated start"
            f"{reason.get((self.chosen, clearly), '')}: start is {self.chosen}"
        )


def try_starts(record: Record) -> StartTrial:
    """Validate linear models of a record from rest and with an estimated start.

    Raises:
        ValueError: a record that is too short, or that excites too little.
    """
    seen = replace(record[:_LONGEST], reference=None, period=None)
    first = seen.samples - round(_JUDGED * seen.samples)
    if seen.samples - first < SHORTEST:
        raise InputError(
            f"record '{record.name}' has {seen.samples} samples; {round(SHORTEST / _JUDGED)} tell "
            "whether it begins at rest."
        )
    judges = {start: replace(seen, start=start, skip=first) for start in ("zero", "estimated")}
    skipped = {"zero": warm_up(first, 0), "estimated": 0}

    def error(record: Record, model: LinearModel, first: int, last: int | None = None) -> float:
        e = replace(record, skip=first).errors(model.simulate(record))[:last]
        return float(rms(e / np.std(seen.y, axis=0)))

    models = {
        start: scan_orders(
            replace(seen[:first], start=start, skip=skipped[start]),
            _ORDERS,
            validation=judge,
            max_iter=_ITERATIONS,
        ).best
        for start, judge in judges.items()
    }
    beginning = max(SHORTEST, warm_up(seen.samples, 0))
    resting, moving = (error(judge, models["estimated"], 0, beginning) for judge in judges.values())
    return StartTrial(
        *(error(judge, models[start], first) for start, judge in judges.items()),
        unexplained=resting / moving if moving else 1.0,
    )
