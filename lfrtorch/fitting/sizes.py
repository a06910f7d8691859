"""The choice of sizes and ridge before the fit, on all records but the test records."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any, cast

from lfrtorch.data.records import Record
from lfrtorch.fitting.choice import Choice, choose_sizes
from lfrtorch.fitting.exclusions import allowed
from lfrtorch.fitting.first_fit import part_of
from lfrtorch.fitting.from_outputs import with_measured_states
from lfrtorch.fitting.given_entries import with_given
from lfrtorch.fitting.known_start import fitted_equations, with_learned
from lfrtorch.fitting.linear_start import approximation, linear_records, of_linear_model, tell
from lfrtorch.fitting.observer import Observer
from lfrtorch.fitting.refit import estimation_records
from lfrtorch.fitting.settings import Settings
from lfrtorch.fitting.stage import Job, Stage
from lfrtorch.fitting.start_models import STARTS_OF_CHOSEN, starting_model
from lfrtorch.fitting.windows import begins_at_outputs
from lfrtorch.linear.model import LinearModel
from lfrtorch.model.model import Model

_CHOOSING = 20_000
"""Largest number of training samples that sizes are chosen on."""

_MORE = 2
"""States beyond the order that one validation part chose, which cross-validation may add. The
linear model of a measured CD player's arm has 0.206 of the outputs' standard deviation on new data
with it, and 0.247 without (``benchmarks/wild.py``)."""

_ITERATIONS = 75
"""Largest number of iterations of the fit after the choice, which has no validation records: about
as many as its ridge was chosen with."""


class Sizes(Stage):
    """Chooses the sizes and the ridge that are ``"auto"`` by cross-validation."""

    def when(self, job: Job) -> bool:
        """Tell if any of them is ``"auto"``."""
        return bool(job.settings.searched)

    def run(self, job: Job) -> Job:
        """Choose, and estimate the linear models again from all records but the test records."""
        train = estimation_records(job.dataset)
        dataset = replace(job.dataset, train=train, validation=[], selection=[])
        choice = _choice(replace(job, dataset=dataset))
        settings = _of_choice(job.settings, choice)
        records = linear_records(train, settings, Observer())
        estimate = partial(approximation, records, settings=settings)
        linear = estimate(choice.nx)
        same = settings.known is not None or settings.nx == choice.nx
        begun = linear if same else estimate(cast(int, settings.nx))
        tell(linear, job.observer)
        found = {"linear": linear, "begun": begun, "choice": choice}
        return replace(job, dataset=dataset, settings=settings, **found)


def _of_choice(settings: Settings, choice: Choice) -> Settings:
    """The settings with the chosen values; the fit has no validation records."""
    trainer: Any = settings.trainer
    sizes = {name: choice.chosen.sizes[name] for name in settings.size_names}
    if settings.known is None:
        sizes["nx"] = choice.chosen.sizes["nx"]
    averages = settings.averages and allowed("average", STARTS_OF_CHOSEN, vars(settings))
    return replace(
        settings,
        **sizes,
        ridge=choice.chosen.ridge,
        average=STARTS_OF_CHOSEN if settings.static == "network" and averages else 1,
        refit=False,
        trainer=replace(trainer, max_iter=min(trainer.limit, _ITERATIONS)),
    )


def _choice(job: Job) -> Choice:
    """Choose the sizes that are ``"auto"``, and the ridge, by cross-validation."""
    dataset, settings, observer = job.dataset, job.settings, job.observer
    samples = sum(record.samples for record in dataset.train)
    part = min(1.0, _CHOOSING / samples)
    records = dataset.train if part == 1.0 else part_of(dataset.train, part)
    if part < 1.0:
        some = sum(record.samples for record in records)
        observer.say(f"sizes are chosen on {some} of {samples} training samples")
    orders = job.order_scan.orders if job.order_scan else ()
    asked = {**settings.sizes, "nx": of_linear_model(settings).nx}
    given = {name: size for name, size in asked.items() if isinstance(size, int)}
    equations = dict[int, Job]()  # known model fitted without a stretch, by its linear model's id
    approximated = linear_records(records, settings, Observer())
    at_outputs = begins_at_outputs(records)

    def start(bla: LinearModel, train: Sequence[Record], sizes: dict[str, int], seed: int) -> Model:
        if settings.known is not None:
            if id(bla) not in equations:
                equations[id(bla)] = fitted_equations(job, bla, train)
            fitted = equations[id(bla)]
            own = replace(fitted.settings, **sizes)
            return with_learned(fitted.models[0], train, own, seed)
        begun = starting_model(train, replace(settings, nx=bla.nx, **sizes), bla, seed)
        begun = with_measured_states(begun) if at_outputs else begun
        return with_given(begun, settings.fixed)[0]

    searched = settings.nx == "auto"
    choice = choose_sizes(
        records,
        [nx for nx in orders if nx <= job.linear.nx + _MORE] if searched else [job.linear.nx],
        partial(approximation, approximated, settings=settings),
        start,
        given=given,
        ridge=0.0 if settings.ridge == "auto" else settings.ridge,
        last=settings.size_names[-1],
        seed=settings.seed,
        guarantee="stable" if settings.trainer.guarantee == "stable" else None,
        horizon=settings.horizon,
        watch=observer.say,
        stop=job.stop,
    )
    observer.say(choice.table())
    return choice
