"""The records of a fit with their inputs as they act, after the delay of each."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch

from lfrtorch._support.errors import InputError
from lfrtorch.data.dataset import Dataset
from lfrtorch.data.delayed_records import Delay, delayed_records, resting_level
from lfrtorch.distributed import agreed
from lfrtorch.fitting.linear_start import linear_records, of_linear_model
from lfrtorch.fitting.stage import Job, Stage
from lfrtorch.fitting.trainer import FitResult
from lfrtorch.fitting.windows import begins_at_outputs
from lfrtorch.linear.delay_search import find_delay


class ActingInputs(Stage):
    """The records with later inputs, so that the fits need not know of a delay.

    The models get their delay when they are scored.
    """

    def check(self, job: Job) -> None:
        """Refuse a number of delays that is not that of the inputs."""
        given, nu = job.settings.delay, len(job.given.train[0].inputs) if job.given.train else 0
        if isinstance(given, tuple) and nu and len(given) != nu:
            raise InputError(
                f"delay has {len(given)} numbers, and the records have {nu} input(s); give one "
                "number for each, or one for all."
            )

    def when(self, job: Job) -> bool:
        """Tell if inputs may be delayed."""
        start = job.settings.init_from
        return job.settings.delay != 0 or (start is not None and any(start.delay))

    def run(self, job: Job) -> Job:
        """Find the delay, and shift the inputs of all records."""
        settings, train = job.settings, job.dataset.train
        delay, start = _delay(job), settings.init_from
        if start is not None:
            settings = replace(settings, init_from=start.delayed(0))
        if not any(delay):
            return replace(job, settings=replace(settings, delay=0))
        level = np.zeros(len(delay))
        if settings.linear.get("offset", True):
            level = resting_level(train, delay)
        whole = job.given.with_windows(delay)
        return replace(
            job,
            settings=replace(settings, delay=delay),
            delay=delay,
            whole=whole,
            given=_shifted(job.given, delay, level),
            dataset=_shifted(whole, delay, level),
        )


def acting(job: Job) -> Job:
    """The job with its inputs as they act, for a linear model alone."""
    stage = ActingInputs()
    stage.check(job)
    return stage.run(job) if stage.when(job) else job


def _delay(job: Job) -> Delay:
    """The delay that is given, that of the model to start from, or the one that is found."""
    settings, train = job.settings, job.dataset.train
    nu, given = len(train[0].inputs), settings.delay
    if settings.init_from is not None and given in (0, "auto"):
        return settings.init_from.delay
    if given == "auto":
        own = of_linear_model(settings)
        nx = None if own.nx == "auto" else own.nx
        if begins_at_outputs(train):
            nx = len(train[0].outputs)
            train = [replace(record, start="estimated") for record in train]
        records, watch = linear_records(train, own, job.observer), job.observer.say
        found = find_delay(records, nx, watch=watch, **own.linear)
        # Rounding may differ between processes, so the first process decides.
        return tuple(agreed(torch.tensor(found)).tolist())
    each = given if isinstance(given, tuple) else (given,) * nu
    return tuple(math.ceil(float(one)) for one in each)


def _shifted(dataset: Dataset, delay: Delay, level: np.ndarray) -> Dataset:
    uses = ("train", "validation", "selection", "tests", "leaderboard")
    return replace(
        dataset, **{use: delayed_records(getattr(dataset, use), delay, level) for use in uses}
    )


def with_delay(result: FitResult, delay: Delay) -> FitResult:
    """The result with models of the records as they were measured."""
    model, *members = (one.delayed(delay) for one in (result.model, *result.members))
    return replace(result, model=model, members=tuple(members))
