"""The scores, verdict and advice of an identification."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import cast

from lfrtorch._support.errors import InputError
from lfrtorch._support.threads import each_alone
from lfrtorch.analysis.confidence_bands import uncertainty
from lfrtorch.analysis.dead_times import DeadTime, dead_times
from lfrtorch.analysis.physical_parameters import PhysicalParameters, physical_parameters
from lfrtorch.data.dataset import Dataset
from lfrtorch.data.records import Record
from lfrtorch.fitting.acting_inputs import with_delay
from lfrtorch.fitting.forgetting import forgets
from lfrtorch.fitting.information import informed
from lfrtorch.fitting.linear_start import linear_records, of_linear_model, tell
from lfrtorch.fitting.observer import Observer
from lfrtorch.fitting.refit import estimation_records
from lfrtorch.fitting.settings import Settings
from lfrtorch.fitting.stage import Job
from lfrtorch.fitting.windows import begins_at_outputs, windows
from lfrtorch.linear.bla import estimate_bla
from lfrtorch.linear.model import LinearModel
from lfrtorch.linear.order_scan import OrderScan
from lfrtorch.model.model import Model
from lfrtorch.reporting.advice import advise
from lfrtorch.reporting.diagnosis import evidence
from lfrtorch.reporting.evaluation import (
    HORIZONS,
    Evaluation,
    cross_validated,
    worst_residuals,
)
from lfrtorch.reporting.opponent import Opponents, opponents
from lfrtorch.reporting.run import Run
from lfrtorch.reporting.verdict import REMEMBERS, judge, judge_predictions


def scored_run(job: Job) -> Run:
    """Score all records, the tests by a refitted model if there is one; add verdict and advice."""
    dataset, settings, linear, result = job.dataset, job.settings, job.linear, job.result
    order_scan, choice, again = job.order_scan, job.choice, job.again
    in_turn = choice is not None and not dataset.tests  # cross-validation judges
    scan = None if in_turn else order_scan
    opposed = linear_opponents(dataset, settings, linear, scan, job.observer)
    samples = sum(record.samples for record in dataset.train)
    fitted_to = f"{dataset.name}: {len(dataset.train)} record(s), {samples} samples"
    model = replace(result.model, fitted_to=fitted_to).reaching(dataset.train)
    if again is None:
        model = informed(model, dataset.train, settings.horizon)
    result = replace(result, model=model)
    if again is not None:
        fitted_to += " and all other estimation records"
        told = replace(again.model, fitted_to=fitted_to).reaching(
            [*dataset.train, *dataset.validation, *dataset.selection]
        )
        again = replace(again, model=informed(told, estimation_records(dataset), settings.horizon))
    own = linear_models_of_tests(dataset, settings)
    seen = dataset.train if again is None else estimation_records(dataset)
    known = _known_parameters((again or result).model, seen, settings)
    times = _dead_times((again or result).model, job, seen)
    if job.whole is not None:  # from here on all records are as they were measured
        dataset, linear = job.whole, replace(linear, delay=job.delay)
        result = with_delay(result, job.delay)
        again = None if again is None else with_delay(again, job.delay)
        opposed = {ahead: replace(one, delay=job.delay) for ahead, one in opposed.items()}
        own = {name: replace(one, delay=job.delay) for name, one in own.items()}
    evaluation = Evaluation(
        dataset=dataset,
        linear=opposed[None],
        predictors=opposed,
        model=result.model,
        refitted=None if again is None else again.model,
        own=own,
        horizon=settings.horizon,
        left_out=() if choice is None else cross_validated(choice.left_out),
    )
    judged = simulations = evaluation.simulations
    ahead = settings.horizon if begins_at_outputs(dataset.train) else None
    opponent = opposed[None]
    memory = None
    if settings.noise == "output" and settings.horizon is None:
        seen = dataset.train if again is None else estimation_records(dataset)  # as measured
        memory = forgets((again or result).model, seen, opponent)
    refusals = [REMEMBERS] if memory is not None and not memory.right else []
    if settings.noise == "output" or in_turn:
        error = "error" if ahead is None else f"error {ahead} samples ahead"
        verdict = judge(result, simulations, linear_nx=opponent.nx, error=error, refusals=refusals)
    else:
        opponent = opposed[HORIZONS[0]]
        judged = evaluation.predictions[HORIZONS[0]]
        verdict = judge_predictions(result, evaluation.predictions, linear_nx=opponent.nx)
    residuals = worst_residuals(judged)
    found = evidence(
        result,
        judged,
        bla=linear,
        noise_rms=dataset.noise_rms,
        continued=settings.init_from is not None,
        ridge=settings.ridge != 0.0,
        searched=choice is not None or ahead is not None,
        trainer=settings.trainer,
        verdict=verdict,
        residuals=residuals,
    )
    return Run(
        dataset=dataset,
        settings=settings,
        linear=opponent,
        order_scan=order_scan,
        choice=choice,
        fit=result,
        refit=again,
        evaluation=evaluation,
        residuals=residuals,
        parameters=known,
        dead_times=times,
        memory=memory,
        verdict=verdict,
        advice=advise(found),
    )


def _known_parameters(
    model: Model, records: Sequence[Record], settings: Settings
) -> PhysicalParameters | None:
    """The parameters of the known model, if there is one."""
    if not model.known_states:
        return None
    ridge = 0.0 if isinstance(settings.ridge, Mapping | str) else settings.ridge
    if begins_at_outputs(records) and settings.horizon is not None:
        cut = partial(windows, horizon=settings.horizon, nx=model.lfr.cell.nx)
        records = cut(records, y_scale=model.scaler.y_scale)
    return physical_parameters(model, records, ridge=ridge)


def _dead_times(model: Model, job: Job, records: Sequence[Record]) -> tuple[DeadTime, ...]:
    """Dead times of delayed inputs by the model at rest and a linear one with a state more."""
    if not job.delay:
        return ()
    found, own = [job.linear], of_linear_model(job.settings)
    with suppress(InputError):  # it has a gain K, or no rest
        found = [uncertainty(model, records).linearise()]
    if not begins_at_outputs(records):
        with suppress(InputError):  # too few data for another state
            found.append(estimate_bla(records, job.linear.nx + 1, **own.linear))
    return dead_times([replace(one, delay=job.delay) for one in found])


def linear_opponents(
    dataset: Dataset,
    settings: Settings,
    linear: LinearModel,
    scan: OrderScan | None,
    observer: Observer,
) -> Opponents:
    """The linear models that the NL-LFR is compared with, with the order that a scan chose."""
    ahead = () if settings.noise == "output" else HORIZONS
    if begins_at_outputs(dataset.train):
        return dict.fromkeys((None, *ahead), linear)
    nx = linear.nx if scan is None else scan.chosen
    records = linear_records(dataset.train, replace(of_linear_model(settings), nx=nx), Observer())
    found = opponents(linear, records, dataset, nx=nx, options=settings.linear, ahead=ahead)
    others = {id(model): model for model in found.values() if model is not linear}
    for model in others.values():
        observer.say("another linear model beats the start; the NL-LFR is compared with it")
        tell(model, observer)
    return found


def linear_models_of_tests(dataset: Dataset, settings: Settings) -> dict[str, LinearModel]:
    """Linear models for single tests by the test's name, if ``dataset.linear`` asks for them."""
    options = {**settings.linear}
    if settings.noise == "output" and options.get("refine") == "prediction":
        options["refine"] = None  # simulations are judged
    records = {record.name: record for record in dataset.train}
    # Tests with the same records share a model.
    of = list(dict.fromkeys(dataset.linear.values()))
    estimate = partial(estimate_bla, nx=cast(int, of_linear_model(settings).nx), **options)
    models = each_alone(estimate, [[records[name] for name in names] for names in of])
    by_records = dict(zip(of, models, strict=True))
    return {test: by_records[names] for test, names in dataset.linear.items()}
