"""Decide whether a record starts at rest or in motion, by the errors of two linear models.

A file does not say how its record starts. An identification decides this once, on the training
records. Two linear models are estimated from the first three quarters of a record, one that starts
at rest and one with an estimated start state. Both are then simulated from the record's start, and
their errors in the last quarter are compared.
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
"""At most so many samples are used: a start is forgotten after some time constants."""

_JUDGED = 1 / 4
"""Part of these samples, at the end, on which the errors are compared."""

_TRIED = 3
"""At most so many training records are tried, as a trial takes some seconds. If each of them should
start at rest, the other records do, too."""

_ORDERS = range(1, 5)
_ITERATIONS = 15
"""Iterations of a linear fit, enough to rank the two starts: on two measured records, 200 ranked
them alike."""

_CLEARLY = 0.95
"""A start at rest is chosen if it lowers the error in the last quarter by 5 %. If a record starts
at rest, an estimated start costs little: for linear models of simulated records, the error on 20000
new samples was at most 1.02 times as large. If it starts in motion, a start at rest raises the
error up to 1.33 times, and twice for an NL-LFR."""


class StartTrial(NamedTuple):
    """Errors of linear models by their start, relative to the output's standard deviation.

    Args:
        zero, estimated: rms error in the last quarter, of the model that starts at rest and of the
            model with an estimated start state.
    """

    zero: float
    estimated: float

    @property
    def chosen(self) -> Literal["zero", "estimated"]:
        """The start that a fit should have: an estimated one, unless rest is clearly better."""
        return "zero" if self.zero < _CLEARLY * self.estimated else "estimated"

    @property
    def in_motion(self) -> bool:
        """Tell whether an estimated start is clearly better than a start at rest."""
        return self.estimated < _CLEARLY * self.zero

    def __str__(self) -> str:
        """A sentence with both errors."""
        alike = min(self) >= _CLEARLY * max(self)
        return (
            f"a linear model errs by {percent(self.zero)} of the output's standard deviation if it "
            f"starts at rest, and by {percent(self.estimated)} with an estimated start"
            f"{', which does no harm at rest either' * alike}: start is {self.chosen}"
        )


def try_starts(record: Record) -> StartTrial:
    """Compare a linear model of a record that starts at rest to one with an estimated start.

    Raises:
        ValueError: a record that is too short, or whose input excites too little.
    """
    seen = replace(record[:_LONGEST], reference=None, period=None)
    first = seen.samples - round(_JUDGED * seen.samples)
    if seen.samples - first < SHORTEST:
        raise InputError(
            f"record '{record.name}' has {seen.samples} samples; to tell whether it begins at rest "
            f"takes {round(SHORTEST / _JUDGED)}."
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
    # Rounding differs between processes, but they must make the same choice.
    errors = torch.tensor([error("zero"), error("estimated")], dtype=torch.float64)
    return StartTrial(*agreed(errors).tolist())


def decided(dataset: Dataset) -> Dataset:
    """Decide the start of undecided records: at rest if that is clearly better; notes say why."""
    if not dataset.undecided:
        return dataset
    open_, resting, notes = dataset.undecided, [], []
    for one in open_[:_TRIED]:
        name = f"{one.record.name}: " if len(dataset.train) > 1 else ""
        try:
            trial = try_starts(one.record[: one.seen])
        except InputError:
            notes.append(f"{name}start is zero: too little data or excitation to compare starts")
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
