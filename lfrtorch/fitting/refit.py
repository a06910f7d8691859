"""A last fit to all records, once those that were held out have chosen the model.

The fit goes on from the model that was chosen, for as many iterations as the new samples are worth:
if K iterations over n samples were best on validation, m samples more get K m / n, and no more than
the fit was allowed. A sample of weight 2, a mean of two periods, counts twice. Many more iterations
would spoil short records, as K itself stops the fit before it learns their noise. A fit from the
first start, for K iterations, may end in another minimum, and nothing is left to tell.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import replace
from math import ceil
from typing import Any

import numpy as np

from lfrtorch._support.arguments import typed
from lfrtorch.data.dataset import Dataset
from lfrtorch.data.records import Record, as_records, measured_signals
from lfrtorch.distributed import current, using
from lfrtorch.fitting.multistart import fit
from lfrtorch.fitting.plain_settings import Noise
from lfrtorch.fitting.trainer import FitResult, Monitor, Stop, Trainer
from lfrtorch.least_squares.levenberg_marquardt import LevenbergMarquardt
from lfrtorch.least_squares.ridge import Ridge


@typed()
def refit(
    result: FitResult,
    train: Record | Sequence[Record],
    held_out: Record | Sequence[Record],
    *,
    trainer: Trainer | None = None,
    ridge: Ridge = 0.0,
    noise: Noise = "output",
    horizon: int | None = None,
    iterations: int | None = None,
    monitor: Monitor | None = None,
    stop: Stop | None = None,
) -> FitResult:
    """Go on with a fit on its training records and those that were held out to choose.

    Each model of a mean is fitted, and the mean taken again. The errors on the records
    that were held out are no validation any more: quote those of ``result``.

    Args:
        result: result of :func:`lfrtorch.fit`; its model is copied.
        train: records that it was fitted to.
        held_out: records that chose its iterate. One that begins in a training record, as the
            parts of a measurement do, continues that record.
        trainer, ridge, noise, horizon: as in the fit; ridge pulls towards the chosen model.
        iterations: that were chosen. Default: those of the fit, without what came before it.
        monitor: called after every iteration. Default: a line on a terminal or in a notebook.
        stop: see :func:`lfrtorch.fit`.

    Returns:
        The fit to all records; that of the models as they are if no iteration was chosen.

    Raises:
        ValueError: records of other channels than the model's.
        ProcessLostError, StoppedError: before there was an iterate to keep.

    Example:
        >>> trainer = lfrtorch.LevenbergMarquardt(max_iter=8)
        >>> train, validation = record[:300], record[300:]
        >>> result = lfrtorch.fit(model, train, validation, trainer=trainer)
        >>> again = lfrtorch.refit(result, train, validation, trainer=trainer)
        >>> again.history[-1].train <= again.history[0].train
        True
    """
    train, held_out = as_records(train), as_records(held_out)
    seen, new = (
        sum(float(np.mean(r.weight)) * (r.samples - r.skip) for r in records)
        for records in (train, held_out)
    )
    base: Any = LevenbergMarquardt() if trainer is None else trainer
    chosen = result.chosen_iteration if iterations is None else iterations
    limit = min(ceil(chosen * new / seen), base.limit)
    models = [deepcopy(model) for model in result.members or (result.model,)]
    records = all_records(train, held_out)
    with using(current().enough_for(max(len(models), len(records)))):
        return fit(
            models,
            records,
            trainer=replace(base, max_iter=limit),
            ridge=ridge,
            noise=noise,
            horizon=horizon,
            average=len(models),
            monitors=None if monitor is None else [[monitor]] * len(models),
            stop=stop,
        )


def estimation_records(dataset: Dataset) -> list[Record]:
    """Records of a second fit: all but the tests."""
    return all_records(dataset.train, [*dataset.validation, *dataset.selection])


def all_records(train: Sequence[Record], held_out: Sequence[Record]) -> list[Record]:
    """Training records and others; one that begins in a training record continues that one."""
    found = list(train)
    for record in held_out:
        at = next((i for i, other in enumerate(found) if _continues(record, other)), None)
        if at is None:
            found.append(record)
            continue
        found[at] = found[at].joined(record)
    return found


def _continues(record: Record, other: Record) -> bool:
    """Tell if the samples that a record skips are the last ones of another."""
    count = min(record.skip, other.samples)
    if not count or "periodic" in (record.start, other.start):
        return False
    window = slice(record.skip - count, record.skip)
    same = np.array_equal(measured_signals(record)[window], measured_signals(other)[-count:])
    return same and bool(np.ptp(record.y[window]))  # records at rest may be equal by chance
