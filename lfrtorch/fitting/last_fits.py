"""Stages after a fit: a mean without poor starts, and a fit to all estimation records."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import cast

import torch

from lfrtorch._support.reasons import CUT_SHORT, Reason
from lfrtorch._support.tables import quantity
from lfrtorch.analysis.amplitude_margin import largest_stable_amplitude
from lfrtorch.data.records import Record, common_unit
from lfrtorch.distributed import agreed
from lfrtorch.fitting.first_fit import cost_in_full
from lfrtorch.fitting.forgetting import forgets
from lfrtorch.fitting.means import mean_model
from lfrtorch.fitting.prediction import predicting
from lfrtorch.fitting.refit import refit
from lfrtorch.fitting.stage import Job, Stage
from lfrtorch.fitting.state_scaling import scale_states
from lfrtorch.fitting.trainer import FitResult, StoppedError
from lfrtorch.least_squares.problem import Problem
from lfrtorch.least_squares.ridge import Ridge
from lfrtorch.linear.model import LinearModel

_AVERAGED = 3
"""Largest number of starts in a mean that no held-out record has judged. It is above 1, as the
start with the least training error may be overfitted (``benchmarks/first_try.md``)."""

_POOR = 2.0
"""Largest ratio of a start's training error to the least one, for starts in such a mean."""


class MeanOfGood(Stage):
    """The mean of a few starts with the least training errors, for a model of chosen sizes."""

    def when(self, job: Job) -> bool:
        """Tell if no held-out record has judged a mean."""
        return job.choice is not None and bool(job.result.members)

    def run(self, job: Job) -> Job:
        """Leave out poor starts."""
        simulated = job.settings.noise == "output" and job.settings.horizon is None
        linear = job.linear if simulated else None
        return replace(job, result=without_poor_starts(job.result, job.dataset.train, linear))


class Refit(Stage):
    """A last fit to all estimation records."""

    def when(self, job: Job) -> bool:
        """Tell if a refit is asked for, and records were held out."""
        if not job.settings.refit or job.result.reason in CUT_SHORT:
            return False
        if not (job.given.validation or job.given.selection):
            job.observer.say(
                "note: refit: there are no validation records, so all were fitted before"
            )
            return False
        return True

    def run(self, job: Job) -> Job:
        """Add the fit to all records; the chosen model stays if that fit makes it unstable."""
        # If this fit is interrupted, "interrupted" becomes the reason of the fit before. Records
        # here have no score window: all samples that need not be skipped are fitted.
        settings, dataset, result = job.settings, job.given, job.result
        held_out = [*dataset.validation, *dataset.selection]
        again = _whole_or_cut(
            result,
            partial(
                refit,
                result,
                dataset.train,
                held_out,
                trainer=settings.trainer,
                ridge=cast(Ridge, settings.ridge),
                noise=settings.noise,
                horizon=settings.horizon,
                iterations=result.chosen_iteration + cost_in_full(settings),
                monitor=job.observer.searching(),
                stop=job.stop,
            ),
        )
        if again.reason in CUT_SHORT:
            return replace(job, result=again)
        records = [*dataset.train, *held_out]
        margins = torch.tensor(
            [largest_stable_amplitude(m, records) for m in (again.model, result.model)]
        )
        if bool(torch.lt(*agreed(margins))):
            job.observer.say(
                "note: refit: the refitted model is unstable on louder inputs; the model before "
                "it is kept"
            )
            return job
        before, after = (again.history[i].train for i in (0, again.chosen_iteration))
        unit = common_unit(again.model.outputs)
        job.observer.say(
            f"refit to all estimation records: {again.iterations} iterations, "
            f"{quantity(again.seconds, 's')}, error on these records {quantity(before, unit)} -> "
            f"{quantity(after, unit)}; validation errors are those before the refit"
        )
        return replace(job, again=again)


def without_poor_starts(
    result: FitResult, train: Sequence[Record], linear: LinearModel | None = None
) -> FitResult:
    """The fit whose mean is taken over a few starts with the least training errors.

    If any starts forget where they began as fast as a linear model does, the others are left out.
    """
    forget = [m for m in result.members if linear and forgets(m, train, linear).right]
    members = (forget or list(result.members))[:_AVERAGED]
    predicts = result.model.K is not None  # the mean of models has no gain of its own
    models, data = predicting(members, train) if predicts else (members, train)
    assert isinstance(models, list)
    judges = [Problem.judge(model, data) for model in models]
    costs = torch.tensor([j.evaluate(j.theta).cost for j in judges], dtype=torch.float64)
    costs = agreed(costs.nan_to_num(torch.inf))  # the simulation of some may run away
    near = int((costs <= _POOR**2 * costs.min()).sum())
    if near == len(result.members):
        return result
    order = costs.argsort(stable=True)[:near].tolist()
    mean = models[order[0]] if near == 1 else mean_model([models[i] for i in order])
    given = any(record.start == "given" for record in data)
    scale_states(mean, data, keep_coordinates=given)
    mean = mean.innovation_form() if predicts else mean
    kept = tuple(members[i] for i in order) if near > 1 else ()
    return replace(result, model=mean, averaged=near, members=kept)


def _whole_or_cut(before: FitResult, again: Callable[[], FitResult]) -> FitResult:
    """A second fit, or the fit before it, with the reason, if the second was cut short."""
    try:
        result = again()
    except (KeyboardInterrupt, StoppedError):
        return replace(before, reason=Reason.INTERRUPTED)
    if result.reason in CUT_SHORT:
        return replace(before, reason=result.reason, detail=result.detail)
    return result
