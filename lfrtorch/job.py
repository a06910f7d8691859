"""The whole job: records -> linear model -> sizes -> starts -> fit -> scores and advice."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import closing
from copy import deepcopy
from dataclasses import fields, replace
from functools import partial
from inspect import signature
from typing import Any, cast

import torch

from lfrtorch._support.arguments import typed
from lfrtorch._support.errors import InputError
from lfrtorch._support.frames import is_frame
from lfrtorch._support.tables import number, percent, quantity
from lfrtorch._support.threads import each_alone
from lfrtorch.analysis.physical_parameters import physical_parameters
from lfrtorch.dataset import Dataset
from lfrtorch.distributed import Ranks, agreed, using
from lfrtorch.files.split import cut
from lfrtorch.fitting.choice import Choice, choose_sizes
from lfrtorch.fitting.exclusions import allowed
from lfrtorch.fitting.first_fit import begun_on_part, part_of
from lfrtorch.fitting.forgetting import forgets
from lfrtorch.fitting.from_outputs import (
    begins_at_outputs,
    begun_on_short_windows,
    in_windows,
    with_measured_states,
)
from lfrtorch.fitting.given_entries import checked, shapes, with_given
from lfrtorch.fitting.known_start import known_starts
from lfrtorch.fitting.last_fits import refitted, without_poor_starts
from lfrtorch.fitting.multistart import cheap_starts, fit
from lfrtorch.fitting.observer import LineObserver, Observer
from lfrtorch.fitting.plain_settings import PlainSettings
from lfrtorch.fitting.refit import estimation_records
from lfrtorch.fitting.settings import Settings
from lfrtorch.fitting.snapshots import Snapshots
from lfrtorch.fitting.stage import Stage
from lfrtorch.fitting.starts import initialise
from lfrtorch.fitting.trainer import FitResult, Stop
from lfrtorch.fitting.windows import windows
from lfrtorch.linear.bla import estimate_bla
from lfrtorch.linear.frf import FRF
from lfrtorch.linear.measured_states import measured_states_model
from lfrtorch.linear.model import LinearModel
from lfrtorch.linear.order_scan import OrderScan, scan_orders
from lfrtorch.linear.requirements import excited_directions
from lfrtorch.model import Model, check_channels
from lfrtorch.records import Record
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
from lfrtorch.reporting.scores import metrics
from lfrtorch.reporting.verdict import REMEMBERS, judge, judge_predictions

_CUT = 0.2, 0.2
"""Parts of a record for validation and test."""

_CHOOSING = 20_000
"""Training samples that sizes are chosen with, at most."""

_STARTS = 4
"""Of a model of chosen sizes, at least; all go to the end, where it shows which are good."""

_ITERATIONS = 75
"""Of a fit that no validation record ends: about as many as its ridge was chosen with."""

SLOW_SAMPLES = 5000
"""Training samples from which a static map that is not compiled is worth a note."""


@typed("dataset")
def identify(
    dataset: Dataset | Record | Sequence[Record],
    settings: Settings,
    *,
    observer: Observer | None = None,
    snapshots: Snapshots | None = None,
    ranks: Ranks | None = None,
    stop: Stop | None = None,
) -> Run:
    """Identify a nonlinear LFR model, from records to scores.

    Args:
        dataset: records by use. One record, or several, are cut in time as a file is: the first
            0.6 of each for the fit, 0.2 that choose the iterate, and the last 0.2 as a test.
        settings: sizes, starts and trainer.
        observer: who is told of every step. Default: a line on a terminal or in a notebook shows
            how far it is. :class:`lfrtorch.reporting.Console` prints every step,
            :class:`Observer` nothing.
        snapshots: where the starts are kept, for a program that goes on with them.
        ranks: processes that share the starts or the training records, see :func:`lfrtorch.fit`.
        stop: asked before each iteration; the fit ends there if it returns True, and the best
            iterate so far is kept.

    Returns:
        The models, their scores and all that was chosen on the way. If the fit was interrupted, or
        a process was lost, it is that of the best iterate so far, and ``run.fit.reason`` says so.

    Raises:
        ValueError: settings or records that do not fit together.
        StoppedError: by ``stop`` or Ctrl-C during the search for sizes.
        ProcessLostError: one of the processes was lost before the fit itself.

    Example:
        >>> u = np.random.default_rng(0).standard_normal(600)
        >>> y = np.zeros(600)
        >>> for k in range(599):
        ...     y[k + 1] = 0.7 * y[k] + np.tanh(u[k])
        >>> parts = [lfrtorch.Record(u[p], y[p], name=name, skip=20) for name, p in
        ...     (("train", slice(0, 400)), ("test", slice(400, 600)))]
        >>> dataset = lfrtorch.Dataset("saturation", parts[:1], [], parts[1:])
        >>> settings = lfrtorch.Settings(nx=1, nz=1, nn=4,
        ...     trainer=lfrtorch.LevenbergMarquardt(max_iter=20))
        >>> run = lfrtorch.identify(dataset, settings)
        >>> score = run.metrics["scores"]["test"]
        >>> score["rmse"] < score["lti_rmse"]
        True
    """
    dataset = _by_use(dataset)
    with using(ranks) as all_of_them:
        if observer is None:
            observer = LineObserver() if all_of_them.rank == 0 else Observer()
        with closing(observer):
            return _identified(Stage(dataset, settings, observer, stop), snapshots)


def _by_use(given: Any) -> Dataset:
    """A dataset as it is, or of records each cut in time."""
    if isinstance(given, Dataset):
        return given
    records = [given] if isinstance(given, Record) else given
    if (
        not isinstance(records, list | tuple)
        or not records
        or not all(isinstance(record, Record) for record in records)
    ):
        means = "; lfrtorch.load_records(df, inputs=..., outputs=...) makes one of a frame"
        raise InputError(
            "identify takes a Record, or a Dataset('mine', train=[...], validation=[...], "
            f"tests=[...]), and not {type(given).__name__}{means if is_frame(given) else ''}."
        )
    parts = [cut(record, *_CUT) for record in records]
    found = {use: [part[use] for part in parts] for use in ("train", "validation", "test")}
    if len(records) == 1:
        found = {use: [replace(part, name=use) for part in own] for use, own in found.items()}
    return Dataset(records[0].name, found["train"], found["validation"], found["test"])


def _identified(given: Stage, snapshots: Snapshots | None) -> Run:
    """Run all stages."""
    dataset, settings, observer = given.dataset, given.settings, given.observer
    if settings.init_from is not None:
        check_channels(settings.init_from, dataset.train[0])
    if settings.fixed:
        nu, ny = len(dataset.train[0].inputs), len(dataset.train[0].outputs)
        checked(settings.fixed, shapes(settings.states, nu, ny, settings.nz, settings.nw))
    dataset = dataset.with_windows()
    stage = replace(given, dataset=dataset)
    linearly = of_linear_model(settings)
    from_outputs = begins_at_outputs(dataset.train)
    if from_outputs:
        linear, order_scan = measured_states_model(dataset.train), None
        tell(linear, observer)
        settings = _of_outputs(settings, dataset)
        stage = replace(stage, settings=settings)
    else:
        approximated = linear_records(dataset.train, linearly, observer)
        linear, order_scan = linear_model(
            approximated, linearly, dataset.validation, observer=observer
        )
    begun = linear
    choice = None
    if settings.searched:
        dataset = _all_estimation(dataset)
        stage = replace(stage, dataset=dataset)
        choice = _choice(stage, linear, order_scan)
        settings = _of_choice(settings, choice)
        records = linear_records(dataset.train, settings, Observer())
        estimate = partial(estimate_bla, records, **settings.linear)
        linear = estimate(choice.nx)
        begun = linear if settings.nx == choice.nx else estimate(cast(int, settings.nx))
        tell(linear, observer)
    else:
        settings = settings if settings.known_states else replace(settings, nx=linear.nx)
    stage = replace(stage, settings=settings)
    if settings.known is not None:
        settings, models = known_starts(stage, linear)
    else:
        settings, models = starting_models(
            in_windows(stage), settings, begun, observer, chosen=choice is not None
        )
        if from_outputs and settings.init_from is None:
            stage = replace(stage, settings=settings)
            models = [with_measured_states(model) for model in models]
            settings, models = begun_on_short_windows(stage, models)
    if settings.fixed:
        found = [with_given(model, settings.fixed) for model in models]
        models = [model for model, _ in found]
        observer.say(
            "fixed: the start differed from what is given by "
            f"{percent(max(apart for _, apart in found))} of a matrix's largest entry at most"
        )
    settings, models = begun_on_part(replace(stage, settings=settings), models)
    samples = sum(record.samples for record in dataset.train)
    if samples >= SLOW_SAMPLES and models[0].lfr.cell.map.code is None:
        observer.say(
            "note: the static map is a module of your own, which is not compiled: an iteration "
            "takes some ten times as long as with a network or a polynomial"
        )
    observer.say(
        f"{dataset.name}: {samples} training samples, "
        f"{models[0].parameter_count} parameters "
        f"({models[0].net_parameter_count} without the gauge directions), {len(models)} start(s)"
    )
    monitors, watch = observer.begin(dataset, settings, linear, models)
    result = fit(
        models,
        dataset.train,
        dataset.validation,
        dataset.selection,
        average=settings.average,
        monitors=monitors,
        watch=watch,
        snapshots=snapshots,
        **stage.options,
    )
    observer.end(result)
    if choice is not None:
        result = without_poor_starts(stage, result)
    again = None
    if settings.refit:
        result, again = refitted(replace(given, settings=settings), result)
    return scored_run(
        stage, settings, linear, result, order_scan=order_scan, choice=choice, again=again
    )


def _of_outputs(settings: Settings, dataset: Dataset) -> Settings:
    """The settings of a model whose states are the outputs; refuse what cannot be scored so."""
    ny, horizon = len(dataset.train[0].outputs), settings.horizon or 0
    for record in (*dataset.train, *dataset.validation, *dataset.selection, *dataset.tests):
        if record.samples <= horizon:
            raise InputError(
                f"record '{record.name}' has {record.samples} samples and horizon is {horizon}; "
                "give a longer record or a shorter horizon."
            )
    if settings.searched:
        raise InputError(
            f"{', '.join(settings.searched)}: auto, and sizes are not searched with "
            "start='measured' yet; give numbers."
        )
    if settings.known_states or settings.nx == ny:
        return settings
    if settings.nx != "auto":
        raise InputError(
            f"nx is {settings.nx}, and with start='measured' the {ny} outputs are the states; give "
            f"nx={ny} or nx='auto'."
        )
    return replace(settings, nx=ny)


def _all_estimation(dataset: Dataset) -> Dataset:
    """The dataset with all records but the tests for training."""
    train = estimation_records(dataset)
    return replace(dataset, train=train, validation=[], selection=[])


def _of_choice(settings: Settings, choice: Choice) -> Settings:
    """The settings with what was chosen; the fit has no validation records."""
    trainer: Any = settings.trainer
    mean = settings.static == "network" and allowed("average", _STARTS, vars(settings))
    return replace(
        settings,
        **choice.chosen.sizes,
        ridge=choice.chosen.ridge,
        average=_STARTS if mean else 1,
        refit=False,
        trainer=replace(trainer, max_iter=min(trainer.limit, _ITERATIONS)),
    )


def scored_run(
    stage: Stage,
    settings: Settings,
    linear: LinearModel,
    result: FitResult,
    *,
    order_scan: OrderScan | None,
    choice: Choice | None,
    again: FitResult | None = None,
) -> Run:
    """Score all records, the tests by the model fitted again; add verdict and advice."""
    dataset = stage.dataset
    in_turn = choice is not None and not dataset.tests  # what was left out judges
    scan = None if in_turn else order_scan
    opposed = linear_opponents(dataset, settings, linear, scan, stage.observer)
    samples = sum(record.samples for record in dataset.train)
    fitted_to = f"{dataset.name}: {len(dataset.train)} record(s), {samples} samples"
    model = replace(result.model, fitted_to=fitted_to).reaching(dataset.train)
    result = replace(result, model=model)
    if again is not None:
        fitted_to += " and all other estimation records"
        known = [*dataset.train, *dataset.validation, *dataset.selection]
        again = replace(again, model=replace(again.model, fitted_to=fitted_to).reaching(known))
    evaluation = Evaluation(
        dataset=dataset,
        linear=opposed[None],
        predictors=opposed,
        model=result.model,
        refitted=None if again is None else again.model,
        own=linear_models_of_tests(dataset, settings),
        horizon=settings.horizon,
        left_out=() if choice is None else cross_validated(choice.left_out),
    )
    judged = simulations = evaluation.simulations
    ahead = settings.horizon if begins_at_outputs(dataset.train) else None
    opponent = opposed[None]
    memory = None
    if settings.noise == "output" and settings.horizon is None:
        seen = dataset.train if again is None else estimation_records(dataset)
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
    known = None
    if model.known_states:
        of = dataset.train if again is None else estimation_records(dataset)
        ridge = 0.0 if isinstance(settings.ridge, Mapping | str) else settings.ridge
        if begins_at_outputs(of) and settings.horizon is not None:
            of = windows(of, settings.horizon, model.lfr.cell.nx, y_scale=model.scaler.y_scale)
        known = physical_parameters((again or result).model, of, ridge=ridge)
    numbers = metrics(
        result,
        evaluation,
        settings=settings,
        choice=choice,
        verdict=verdict,
        refit=again,
        residuals=residuals,
        parameters=known,
        memory=memory,
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
        memory=memory,
        metrics=numbers,
        verdict=verdict,
        advice=advise(found),
    )


def linear_opponents(
    dataset: Dataset,
    settings: Settings,
    linear: LinearModel,
    scan: OrderScan | None,
    observer: Observer,
) -> Opponents:
    """The linear models that the NL-LFR is compared with, of the order that a scan chose."""
    ahead = () if settings.noise == "output" else HORIZONS
    if begins_at_outputs(dataset.train):
        return dict.fromkeys((None, *ahead), linear)
    nx = linear.nx if scan is None else scan.chosen
    records = linear_records(dataset.train, replace(of_linear_model(settings), nx=nx), Observer())
    found = opponents(linear, records, dataset, nx=nx, options=settings.linear, ahead=ahead)
    others = {id(model): model for model in found.values() if model is not linear}
    for model in others.values():
        observer.say("another linear model does better than the start; it is the one compared with")
        tell(model, observer)
    return found


def of_linear_model(settings: Settings) -> Settings:
    """The settings with the order of the linear model that a known one is compared with."""
    if not settings.known_states:
        return settings
    nx = settings.known_states + cast(int, settings.nx)
    return replace(settings, known=None, init_from=None, nx=nx, nz=1, nw=1, nn=1)


def linear_model(
    data: Sequence[Record] | FRF,
    settings: Settings,
    validation: Sequence[Record] = (),
    *,
    observer: Observer,
) -> tuple[LinearModel, OrderScan | None]:
    """The best linear approximation, and the scan that chose its order if nx is ``"auto"``."""
    if not isinstance(data, FRF) and not data:
        raise InputError(
            "no record is left to fit; give a smaller validation and test, or more of train."
        )
    scan: OrderScan | None = None
    if settings.nx == "auto":
        orders = range(1, settings.nx_max + 1)
        scan = scan_orders(
            data, orders, validation=validation, watch=observer.say, **settings.linear
        )
        observer.say(scan.table())
        for note in scan.notes:
            observer.say(f"note: {note}")
        # Rounding may differ from machine to machine, and the order must not.
        chosen = int(agreed(torch.tensor(scan.chosen)))
        linear = scan.models[scan.orders.index(chosen)]
    else:
        linear = estimate_bla(data, cast(int, settings.nx), **settings.linear)
    tell(linear, observer)
    return linear, scan


def tell(linear: LinearModel, observer: Observer) -> None:
    """Say what a linear model is."""
    found = linear.fit
    assert found is not None
    observer.say(
        f"BLA: order {linear.nx}, {found.criterion} error {number(found.rmse)} (normalised), "
        f"{found.iterations} iterations, {found.reason}, {quantity(found.seconds, 's')}"
    )
    for note in found.notes:
        observer.say(f"note: {note}")


def linear_records(
    train: Sequence[Record], settings: Settings, observer: Observer
) -> Sequence[Record]:
    """Return the records that the linear model is estimated from: those in steady state, or all."""
    # A best linear approximation is that of one kind of signal, and takes a fraction of the work in
    # steady state. If those records excite too little for the order, all are taken.
    steady = [record for record in train if record.start == "periodic"]
    if len(steady) in (0, len(train)):
        return train
    order = settings.nx_max if settings.nx == "auto" else cast(int, settings.nx)
    excited, wanted = excited_directions(steady, order)
    if excited < wanted:
        return train
    observer.say(f"linear model: from the {len(steady)} training record(s) in steady state alone")
    return steady


def _choice(stage: Stage, linear: LinearModel, scan: OrderScan | None) -> Choice:
    """Choose the sizes that are ``"auto"``, and the ridge, by cross-validation."""
    dataset, settings, observer = stage.dataset, stage.settings, stage.observer
    samples = sum(record.samples for record in dataset.train)
    part = min(1.0, _CHOOSING / samples)
    records = dataset.train if part == 1.0 else part_of(dataset.train, part)
    if part < 1.0:
        some = sum(record.samples for record in records)
        observer.say(f"sizes are chosen on {some} of {samples} training samples")
    orders = scan.orders if scan else ()
    given = {name: size for name, size in settings.sizes.items() if isinstance(size, int)}

    approximated = linear_records(records, settings, Observer())

    def approximation(nx: int) -> LinearModel:
        return estimate_bla(approximated, nx, **settings.linear)

    def start(bla: LinearModel, train: Sequence[Record], sizes: dict[str, int], seed: int) -> Model:
        begun = starting_model(train, replace(settings, nx=bla.nx, **sizes), bla, seed)
        return with_given(begun, settings.fixed)[0]

    choice = choose_sizes(
        records,
        [nx for nx in orders if nx <= linear.nx] if settings.nx == "auto" else [linear.nx],
        approximation,
        start,
        given=given,
        ridge=0.0 if settings.ridge == "auto" else settings.ridge,
        last=settings.size_names[-1],
        seed=settings.seed,
        guarantee="stable" if settings.trainer.guarantee == "stable" else None,
        watch=observer.say,
        stop=stage.stop,
    )
    observer.say(choice.table())
    return choice


def starting_models(
    train: Sequence[Record],
    settings: Settings,
    linear: LinearModel,
    observer: Observer,
    *,
    chosen: bool,
) -> tuple[Settings, list[Model]]:
    """The settings with the number of starts, and their models; that of ``init_from`` alone."""
    if settings.init_from is not None:
        if settings.starts not in (1, "auto"):
            observer.say("note: starts is 1: the fit starts from the model of init_from alone")
        model = deepcopy(settings.init_from)
        model.lfr.to(device=settings.device, dtype=settings.dtype)
        return replace(settings, starts=1), [model]
    first = starting_model(train, settings, linear, settings.seed)
    count = settings.starts
    if count == "auto":
        rows = sum(record.y.size for record in train)
        count = cheap_starts(rows, first.parameter_count, settings.trainer.limit)
    if chosen:
        count = max(_STARTS, count)
        settings = replace(settings, average=count if settings.average > 1 else 1)
    settings = replace(settings, starts=count)
    more = [starting_model(train, settings, linear, seed) for seed in settings.seeds[1:]]
    return settings, [first, *more]


def starting_model(
    train: Sequence[Record], settings: Settings, linear: LinearModel, seed: int
) -> Model:
    """The model that one start begins with."""
    names = {one.name for one in fields(PlainSettings)} & {*signature(initialise).parameters}
    options = {name: getattr(settings, name) for name in names}
    with torch.random.fork_rng(devices=[]):  # maps draw their weights as torch modules do
        torch.manual_seed(seed)
        options |= settings.static_map()
    model = initialise(linear, train, **options | {"method": settings.init, "seed": seed})
    model.lfr.to(device=settings.device, dtype=settings.dtype)
    return model


def linear_models_of_tests(dataset: Dataset, settings: Settings) -> dict[str, LinearModel]:
    """Linear models of single tests, if ``dataset.linear`` asks for them, by the test's name."""
    options = {**settings.linear}
    if settings.noise == "output" and options.get("refine") == "prediction":
        options["refine"] = None  # simulations are judged
    records = {record.name: record for record in dataset.train}
    # Tests that share their records share the model.
    of = list(dict.fromkeys(dataset.linear.values()))
    estimate = partial(estimate_bla, nx=cast(int, of_linear_model(settings).nx), **options)
    models = each_alone(estimate, [[records[name] for name in names] for names in of])
    by_records = dict(zip(of, models, strict=True))
    return {test: by_records[names] for test, names in dataset.linear.items()}
