"""What may follow a fit: a mean without poor starts, and a fit to all estimation records."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import torch

from lfrtorch._support.reasons import CUT_SHORT, Reason
from lfrtorch._support.tables import quantity
from lfrtorch.analysis.amplitude_margin import largest_stable_amplitude
from lfrtorch.distributed import agreed
from lfrtorch.fitting.first_fit import cost_in_full
from lfrtorch.fitting.means import mean_model
from lfrtorch.fitting.prediction import predicting
from lfrtorch.fitting.refit import refit
from lfrtorch.fitting.stage import Stage
from lfrtorch.fitting.state_scaling import scale_states
from lfrtorch.fitting.trainer import FitResult, StoppedError
from lfrtorch.least_squares.problem import Problem
from lfrtorch.records import common_unit

_AVERAGED, _POOR = 3, 2.0
"""Starts of a mean that no held-out record judges, and their training errors over the least, at
most: the start with the least may be the one that is overfitted (``benchmarks/first_try.md``)."""


def without_poor_starts(stage: Stage, result: FitResult) -> FitResult:
    """The fit whose mean is of the few starts with the least training errors."""
    members, train = list(result.members[:_AVERAGED]), stage.dataset.train
    if not members:
        return result
    predicts = result.model.K is not None  # gains of models do not make one of their mean
    models, train = predicting(members, train) if predicts else (members, train)
    assert isinstance(models, list)
    judges = [Problem.judge(model, train) for model in models]
    costs = torch.tensor([j.evaluate(j.theta).cost for j in judges], dtype=torch.float64)
    costs = agreed(costs.nan_to_num(torch.inf))  # the simulation of some may run away
    near = int((costs <= _POOR**2 * costs.min()).sum())
    if near == len(result.members):
        return result
    order = costs.argsort(stable=True)[:near].tolist()
    mean = models[order[0]] if near == 1 else mean_model([models[i] for i in order])
    given = any(record.start == "given" for record in train)
    scale_states(mean, train, keep_coordinates=given)
    mean = mean.innovation_form() if predicts else mean
    kept = tuple(members[i] for i in order) if near > 1 else ()
    return replace(result, model=mean, averaged=near, members=kept)


def refitted(stage: Stage, result: FitResult) -> tuple[FitResult, FitResult | None]:
    """The fit and that to all estimation records; None if the model that was chosen stays."""
    # A fit that was interrupted here has that for its reason. The stage has the records without
    # windows for scores: what need not be skipped is fitted.
    dataset, settings, observer = stage.dataset, stage.settings, stage.observer
    held_out = [*dataset.validation, *dataset.selection]
    if result.reason in CUT_SHORT:
        return result, None
    if not held_out:
        observer.say("note: refit: there are no validation records, so all were fitted before")
        return result, None
    again = _whole_or_cut(
        result,
        partial(
            refit,
            result,
            dataset.train,
            held_out,
            iterations=result.chosen_iteration + cost_in_full(settings),
            monitor=observer.searching(),
            **stage.options,
        ),
    )
    if again.reason in CUT_SHORT:
        return again, None
    records = [*dataset.train, *held_out]
    margins = torch.tensor(
        [largest_stable_amplitude(m, records) for m in (again.model, result.model)]
    )
    if bool(torch.lt(*agreed(margins))):
        observer.say(
            "note: refit: the model would become unstable on louder inputs; that before it stays"
        )
        return result, None
    before, after = (again.history[i].train for i in (0, again.chosen_iteration))
    unit = common_unit(again.model.outputs)
    observer.say(
        f"refit to all estimation records: {again.iterations} iterations, "
        f"{quantity(again.seconds, 's')}, their error {quantity(before, unit)} -> "
        f"{quantity(after, unit)}; validation errors are those before it"
    )
    return result, again


def _whole_or_cut(before: FitResult, again: Callable[[], FitResult]) -> FitResult:
    """A fit that follows another one; if it was cut short, the one before with that reason."""
    try:
        result = again()
    except (KeyboardInterrupt, StoppedError):
        return replace(before, reason=Reason.INTERRUPTED)
    if result.reason in CUT_SHORT:
        return replace(before, reason=result.reason, detail=result.detail)
    return result
