"""Choice of a record's start, rest or motion: the one by which a linear model predicts better.

A file does not say it, and an identification decides it once, of the records that train.
Two models are estimated from the first three quarters of the record, one from rest and one with an
estimated start state. The last quarter, simulated from the record's start as well, judges them.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np
import torch

from lfrtorch._support.errors import InputError
from lfrtorch._support.tables import percent
from lfrtorch.data.dataset import Dataset
from lfrtorch.data.metrics import rms
from lfrtorch.data.records import Record
from lfrtorch.data.score_window import SHORTEST, warm_up
from lfrtorch.distributed import agreed
from lfrtorch.linear.order_scan import scan_orders

_LONGEST = 3000
"""Samples that are looked at: a start is forgotten after some time constants."""

_JUDGED = 1 / 4
"""Their part that judges."""

_TRIED = 3
"""Most training records that tell whether all begin in motion: a trial takes some seconds."""

_ORDERS = range(1, 5)
_ITERATIONS = 15
"""Enough to rank the two starts: on two measured records, 200 gave the same ranking."""

_CLEARLY = 0.95
"""Rest has to lower the judging error by 5 %. An estimated start costs little where a record begins
at rest (linear models of planted records, error on 20000 new samples: at most 1.02 times as large),
and rest where it begins in motion costs up to 1.33 times, for an NL-LFR twice."""


class StartTrial(NamedTuple):
    """Errors of linear models by start, relative to the output's deviation.

    Args:
        zero, estimated: rms where they judge, of a model from rest and of one with an estimated
            start.
    """

    zero: float
    estimated: float

    @property
    def chosen(self) -> Literal["zero", "estimated"]:
        """The start that a fit should have: an estimated one, unless rest is clearly better."""
        return "zero" if self.zero < _CLEARLY * self.estimated else "estimated"

    @property
    def in_motion(self) -> bool:
        """Tell whether rest is clearly worse."""
        return self.estimated < _CLEARLY * self.zero

    def __str__(self) -> str:
        """A sentence with both errors."""
        alike = min(self) >= _CLEARLY * max(self)
        return (
            f"a linear model validates at {percent(self.zero)} of the output's deviation from rest "
            f"and at {percent(self.estimated)} with an estimated start"
            f"{', which does no harm at rest either' * alike}: start is {self.chosen}"
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

    def error(start: str) -> float:
        e = judges[start].errors(models[start].simulate(judges[start]))
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
    # Rounding differs between processes, and the choice must not.
    errors = torch.tensor([error("zero"), error("estimated")], dtype=torch.float64)
    return StartTrial(*agreed(errors).tolist())


def decided(dataset: Dataset) -> Dataset:
    """Begin training records at rest that are undecided and clearly better so; notes say it."""
    if not dataset.undecided:
        return dataset
    open_, resting, notes = dataset.undecided, [], []
    for one in open_[:_TRIED]:
        name = f"{one.record.name}: " if len(dataset.train) > 1 else ""
        try:
            trial = try_starts(one.record[: one.seen])
        except InputError:
            notes.append(f"{name}start is zero: no linear model tells how it begins")
            resting.append(one)
        else:
            notes.append(f"{name}{trial}")
            resting += [one] * (trial.chosen == "zero")
    if len(open_) > _TRIED:
        all_rest = len(resting) == _TRIED
        resting += open_[_TRIED:] * all_rest
        start = "zero" if all_rest else "estimated"
        notes.append(f"start is {start} for the records after the first {_TRIED}, too")
    uses = {
        "train": [*dataset.train],
        "validation": [*dataset.validation],
        "test": [*dataset.tests],
    }
    for one in resting:
        for use, i in one.places.items():
            skip = one.skip if use == "train" else uses[use][i].skip
            uses[use][i] = replace(uses[use][i], start="zero", skip=skip)
    train, validation, tests = uses.values()
    said = (*dataset.notes, *notes)
    return replace(
        dataset, train=train, validation=validation, tests=tests, notes=said, undecided=()
    )
