"""A first fit to a part of the records, which chooses a start at a fraction of the cost."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from lfrtorch._support.tables import quantity
from lfrtorch.data.records import Record, common_unit
from lfrtorch.distributed import current
from lfrtorch.fitting.settings import Settings
from lfrtorch.fitting.stage import Data, Job, Stage, best_start
from lfrtorch.fitting.trainer import FitResult, Trainer


class FirstPart(Stage):
    """The first iterations, on a part of the training samples."""

    name = "the first iterations, on a part of the records"

    def when(self, job: Job) -> bool:
        """Tell if only a part of the training samples is fitted first."""
        if job.settings.first_part == 1.0:
            return False
        part, train = self.data(job).train, job.dataset.train
        if max(len(job.models), len(part)) < current().world or _samples(part) == _samples(train):
            job.observer.say(
                f"note: first_part is {job.settings.first_part}, and {len(train)} training "
                "record(s) give no such part: all are fitted from the first iteration"
            )
            return False
        return True

    def data(self, job: Job) -> Data:
        """That part of the training records, and the validation and selection records."""
        train = part_of(job.dataset.train, job.settings.first_part)
        return Data.of(job.dataset)._replace(train=train)

    def trainer(self, job: Job) -> Trainer:
        """The trainer of the job, limited to the first iterations."""
        base: Any = job.settings.trainer
        return replace(base, max_iter=job.settings.first_iterations)

    def keep(self, job: Job, result: FitResult) -> Job:
        """The best start, or all starts if the model is to be a mean."""
        settings, models = best_start(job, result)
        kept = f"seed {settings.seed}"
        if job.settings.average > 1:
            settings, models, kept = job.settings, job.models, f"all {len(job.models)} starts"
        chosen = result.history[result.chosen_iteration]
        part = _samples(self.data(job).train)
        job.observer.say(
            f"first {result.iterations} iterations on {part} of {_samples(job.dataset.train)} "
            f"training samples: {quantity(result.seconds, 's')}, error "
            f"{quantity(chosen.train, common_unit(result.model.outputs))}, {kept}"
        )
        return replace(job, settings=settings, models=models)


def _samples(records: Sequence[Record]) -> int:
    return sum(record.samples for record in records)


def cost_in_full(settings: Settings) -> int:
    """Number of iterations on all records that cost as much as the first iterations."""
    part = settings.first_part
    return round(part * settings.first_iterations) if part < 1.0 else 0


def part_of(records: Sequence[Record], part: float) -> list[Record]:
    """A part of the samples of all records: the shortest records, or the beginning of each."""
    # Among records of equal length, the records that are taken are spread evenly. If even the
    # shortest record is longer than the part, the beginning of each record is taken, unless a
    # record is in steady state.
    room, found = part * sum(record.samples for record in records), []
    if room < min(r.samples for r in records) and all(r.start != "periodic" for r in records):
        return [_beginning(record, part) for record in records]
    for samples in sorted({record.samples for record in records}):
        alike = [record for record in records if record.samples == samples]
        count = min(len(alike), max(int(not found), round(room / samples)))
        found += [alike[i * len(alike) // count] for i in range(count)]
        room -= count * samples
        if count < len(alike):
            break
    return found


def _beginning(record: Record, part: float) -> Record:
    """The skipped samples of a record, and a part of its other samples."""
    end = record.skip + math.ceil(part * (record.samples - record.skip))
    return record.part(slice(end), start=record.start, skip=record.skip, period=None)
