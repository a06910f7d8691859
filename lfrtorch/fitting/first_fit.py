"""The first iterations of a fit, on a part of the training samples, where they cost less."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from lfrtorch._support.reasons import CUT_SHORT
from lfrtorch._support.tables import quantity
from lfrtorch.distributed import current
from lfrtorch.fitting.multistart import fit
from lfrtorch.fitting.settings import Settings
from lfrtorch.fitting.stage import Stage
from lfrtorch.fitting.trainer import StoppedError
from lfrtorch.model import Model
from lfrtorch.records import Record, common_unit


def begun_on_part(stage: Stage, models: list[Model]) -> tuple[Settings, list[Model]]:
    """The best start, or those of a mean, after iterations on a part of the records."""
    dataset, settings, observer = stage.dataset, stage.settings, stage.observer
    if settings.first_part == 1.0:
        return settings, models
    train = dataset.train
    part = first_records(stage)
    samples, all_samples = (sum(r.samples for r in records) for records in (part, train))
    if max(len(models), len(part)) < current().world or samples == all_samples:
        observer.say(
            f"note: first_part is {settings.first_part}, and there are {len(train)} training "
            "record(s): all are fitted from the first iteration"
        )
        return settings, models
    trainer: Any = settings.trainer
    monitor = observer.searching()
    result = fit(
        models,
        part,
        dataset.validation,
        dataset.selection,
        monitors=None if monitor is None else [[monitor]] * len(models),
        average=settings.average,
        **{**stage.options, "trainer": replace(trainer, max_iter=settings.first_iterations)},
    )
    if result.reason in CUT_SHORT:
        raise StoppedError("stopped during the first iterations, on a part of the records")
    best = result.starts[0].number if result.starts else 0
    seed = settings.seeds[best]
    chosen = result.history[result.chosen_iteration]
    unit = common_unit(result.model.outputs)
    observer.say(
        f"first {result.iterations} iterations on {samples} of {all_samples} training samples: "
        f"{quantity(result.seconds, 's')}, error {quantity(chosen.train, unit)}, "
        f"seed {seed}"
    )
    if result.members:
        return replace(settings, starts=len(result.members)), list(result.members)
    return replace(settings, seed=seed, starts=1), [result.model]


def first_records(stage: Stage) -> list[Record]:
    """The training records that the first iterations fit."""
    return part_of(stage.dataset.train, stage.settings.first_part)


def cost_in_full(settings: Settings) -> int:
    """How many iterations on all records cost as much as the first ones."""
    part = settings.first_part
    return round(part * settings.first_iterations) if part < 1.0 else 0


def part_of(records: Sequence[Record], part: float) -> list[Record]:
    """Records with a part of all samples: the shortest, or the beginning of each."""
    # Of records of one length some are taken, spread evenly. If even the shortest record has more
    # samples than the part, that is the beginning of each record, unless it is in steady state.
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
    """What is skipped, and a part of the other samples."""
    end = record.skip + math.ceil(part * (record.samples - record.skip))
    return record.part(slice(end), start=record.start, skip=record.skip, period=None)
