"""Starts of the fits of an identification: a given model, or a linear model with static maps."""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import fields, replace
from inspect import signature

import torch

from lfrtorch.data.records import Record
from lfrtorch.fitting.multistart import cheap_starts
from lfrtorch.fitting.plain_settings import PlainSettings
from lfrtorch.fitting.prediction import without_innovations
from lfrtorch.fitting.random_states import unsuited, with_random_states
from lfrtorch.fitting.settings import SEED_STEP, Settings
from lfrtorch.fitting.stage import Job, Stage
from lfrtorch.fitting.starts import initialise
from lfrtorch.fitting.windows import in_windows
from lfrtorch.linear.model import LinearModel
from lfrtorch.model.model import Model, check_channels

STARTS_OF_CHOSEN = 4
"""Smallest number of starts for a model of chosen sizes; all of them go to the end."""

_MOST_OF_CHOSEN = 16
"""Number of starts for a model of chosen sizes, if they take less than a minute. On some records
only about half of them forget where they began."""


class FromModel(Stage):
    """The model of ``init_from``."""

    def check(self, job: Job) -> None:
        """Refuse a model whose channels are not those of the records."""
        if job.settings.init_from is not None:
            check_channels(job.settings.init_from, job.given.train[0])

    def when(self, job: Job) -> bool:
        """Tell if a start model is given."""
        return job.settings.init_from is not None

    def run(self, job: Job) -> Job:
        """Start from this model alone."""
        settings = job.settings
        if settings.starts not in (1, "auto"):
            job.observer.say("note: starts is 1: the fit starts from the model of init_from alone")
        model = deepcopy(settings.init_from)
        assert model is not None
        model.lfr.to(device=settings.device, dtype=settings.dtype)
        return replace(job, settings=replace(settings, starts=1), models=[model])


class FromLinear(Stage):
    """The linear model with random static maps, one for each start."""

    def when(self, job: Job) -> bool:
        """Tell if neither a start model nor a known model is given."""
        return job.settings.init_from is None and job.settings.known is None

    def run(self, job: Job) -> Job:
        """Make the models."""
        settings, begun = job.settings, job.begun
        train = in_windows(job.dataset.train, settings.horizon)
        first = starting_model(train, settings, begun, settings.seed)
        count = settings.starts
        if count == "auto":
            rows = sum(record.y.size for record in train)
            most = 8 if job.choice is None else _MOST_OF_CHOSEN
            count = cheap_starts(rows, first.parameter_count, settings.trainer.limit, most)
        if job.choice is not None:
            count = max(STARTS_OF_CHOSEN, count)
            settings = replace(settings, average=count if settings.average > 1 else 1)
        settings = replace(settings, starts=count)
        more = [starting_model(train, settings, begun, seed) for seed in settings.seeds[1:]]
        return replace(job, settings=settings, models=[first, *more])


def starting_model(
    train: Sequence[Record], settings: Settings, linear: LinearModel, seed: int
) -> Model:
    """The model of one start; with ``init="auto"`` every second one has random states."""
    names = {one.name for one in fields(PlainSettings)} & {*signature(initialise).parameters}
    options = {name: getattr(settings, name) for name in names}
    with torch.random.fork_rng(devices=[]):  # a caller's module may draw from torch's generator
        torch.manual_seed(seed)
        options |= settings.static_map()
    method = "zero_output" if settings.init == "auto" else settings.init
    model = initialise(linear, train, **options | {"method": method, "seed": seed})
    second = settings.init == "auto" and (seed - settings.seed) // SEED_STEP % 2 == 1
    proven = settings.trainer.guarantee not in (None, "stable")
    if second and not (settings.fixed or proven or unsuited(model, train)):
        model = with_random_states(model, train, seed)
    if settings.noise != "output":
        model = without_innovations(model)
    model.lfr.to(device=settings.device, dtype=settings.dtype)
    return model
