"""A last fit to all records, after held-out records have chosen the model.

The fit goes on from the chosen model. If K iterations over n samples were best on validation, m
additional samples get K m / n iterations, but no more than the limit of the first fit. A sample of
weight 2, a mean of two periods, counts twice. Many more iterations would fit the noise of short
records, which stopping at K prevents. A fit from the first start for K iterations could end in
another minimum, and no record would be left to notice.
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
    """Go on with a fit on its training records and its held-out records together.

    If the model is a mean, each of its members is fitted and the mean is taken again. Errors on the
    held-out records are then no longer validation errors: report those of ``result``.

    Args:
        result: result of :func:`lfrtorch.fit`; its model is copied.
        train: records that the first fit was fitted to.
        held_out: records that chose its iterate. A record whose skipped samples are the end of a
            training record, as in parts of one measurement, is joined to that record.
        trainer, ridge, noise, horizon: as in the first fit; ridge pulls towards the chosen model.
        iterations: number of iterations that were best on validation. Default: that of ``result``.
        monitor: called after every iteration. Default: a line on a terminal or in a notebook.
        stop: see :func:`lfrtorch.fit`.

    Returns:
        The fit to all records. If the start was best on validation, the models do not change.

    Raises:
        ValueError: records whose channels are not those of the model.
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
    """Records of a second fit: all but the test records."""
    return all_records(dataset.train, [*dataset.validation, *dataset.selection])


def all_records(train: Sequence[Record], held_out: Sequence[Record]) -> list[Record]:
    """Training and held-out records; a record that continues a training record is joined to it."""
    found = list(train)
    for record in held_out:
        at = next((i for i, other in enumerate(found) if _continues(record, other)), None)
        if at is None:
            found.append(record)
            continue
        found[at] = found[at].joined(record)
    return found


def _continues(record: Record, other: Record) -> bool:
    """Tell if the samples that a record skips are the last samples of another record."""
    count = min(record.skip, other.samples)
    if not count or "periodic" in (record.start, other.start):
        return False
    window = slice(record.skip - count, record.skip)
    same = np.array_equal(measured_signals(record)[window], measured_signals(other)[-count:])
    return same and bool(np.ptp(record.y[window]))  # records at rest may be equal by chance
