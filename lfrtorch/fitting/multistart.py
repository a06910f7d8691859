"""A fit from several starts: after each of the first rounds, only the better half goes on.

The first two rounds end at 1/16 and 1/8 of the iterations. A quarter of the starts, but at least
two, goes to the end: four if there are 16. The whole search then costs as much as 5 complete fits.

This is successive halving (Jamieson and Talwalkar) with early decisions. On the Bouc-Wen benchmark
(16 starts, 5 realisations, 200 iterations) early decisions lose little, as poor starts show at
once. Later decisions drop the start that would have been the best::

    starts are halved after           mean squared error of the best start   iterations
    never (all go to the end)                                             3.37         3026
    1/16 of the iterations                                                3.37         1609
    1/8                                                                   3.37         1696
    1/5                                                                   3.45
    3/10                                                                  3.48
    1/16 and 1/8 (this module)                                            3.43          926
    1/8, 1/4 and 1/2                                                      3.59          933

The mean of models that fit alike may be better than each of them: see :func:`lfrtorch.mean_model`.

References:
    Jamieson and Talwalkar, "Non-stochastic best arm identification and hyperparameter
    optimization", AISTATS 2016.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from copy import deepcopy
from dataclasses import replace
from functools import partial
from math import ceil
from threading import Event
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from lfrtorch._support.arguments import typed
from lfrtorch._support.checks import integer
from lfrtorch._support.errors import InputError
from lfrtorch._support.reasons import CUT_SHORT, Reason, told
from lfrtorch._support.threads import spread_by_hand
from lfrtorch.analysis.amplitude_margin import LOUDER, largest_stable_amplitude
from lfrtorch.analysis.static_slopes import infinite_slope
from lfrtorch.data.records import Record, as_records, common_unit
from lfrtorch.data.score_window import with_window
from lfrtorch.distributed import Ranks, current, using
from lfrtorch.fitting.exclusions import refuse_together
from lfrtorch.fitting.forgetting import forgets
from lfrtorch.fitting.live_line import ProgressLine, StartsLine
from lfrtorch.fitting.means import mean_model
from lfrtorch.fitting.over_processes import OverProcesses
from lfrtorch.fitting.plain_settings import Noise
from lfrtorch.fitting.prediction import (
    predicting,
    shown_innovation_form,
    without_gain,
)
from lfrtorch.fitting.side_by_side import Together, any_of
from lfrtorch.fitting.snapshots import Snapshots
from lfrtorch.fitting.state_scaling import scale_states
from lfrtorch.fitting.trainer import (
    Fit,
    FitResult,
    Monitor,
    RestartSummary,
    Round,
    StartDivergesError,
    Stop,
    StoppedError,
    Trainer,
)
from lfrtorch.least_squares.levenberg_marquardt import LevenbergMarquardt
from lfrtorch.least_squares.problem import Problem
from lfrtorch.least_squares.ridge import Ridge
from lfrtorch.least_squares.shared_problem import same_weights
from lfrtorch.model.model import Model

ROUNDS = (1 / 16, 1 / 8)
"""Parts of the iterations after which the worse half of the starts is dropped."""

_MINUTE = 60.0  # seconds that all starts of starts="auto" may take together on one core

AS_GOOD = 1.01
"""Ratio to the least error up to which a mean of more starts counts as equally good. A mean of few
starts may have the least error by luck: the same records chose the iterates."""


@typed("models")
@spread_by_hand()
def fit(
    models: Model | Sequence[Model],
    train: Record | Sequence[Record],
    validation: Record | Sequence[Record] = (),
    selection: Record | Sequence[Record] = (),
    *,
    trainer: Trainer | None = None,
    ridge: Ridge = 0.0,
    noise: Noise = "output",
    horizon: int | None = None,
    average: int = 1,
    monitors: Sequence[Monitor] | Sequence[Sequence[Monitor]] | None = None,
    watch: Callable[[Round], None] = lambda _: None,
    ranks: Ranks | None = None,
    snapshots: Snapshots | None = None,
    stop: Stop | None = None,
) -> FitResult:
    """Minimise the simulation error of a model over records; from several starts, keep the best.

    The iterate with the smallest error on the validation records is kept, or on the training
    records if there are no validation records. The best iterate so far is also kept if Ctrl-C
    interrupts the search, or if a process that shares the fit is lost: ``reason`` is then
    "interrupted" or "a process was lost".

    On a CPU each start is fitted on its own thread, with at most as many starts at a time as torch
    has threads. On another device the starts are fitted one after another.

    At the end the states are scaled to unit rms over the training records, and
    ``model.state_covariance`` is the covariance of the scaled states. If predictions are fitted,
    the states are those of the predictions. The states are not scaled if a record has a given
    start state x0, or if a matrix with a row or column for each state is frozen
    (``requires_grad_(False)``).

    Several processes share the starts if there are at least as many starts as processes. Otherwise
    they share the records, and the starts are fitted one after another. Shared starts end at the
    same models as on one process.

    Args:
        models: models to start from: one, or several of which the best is kept. Their weights are
            changed in place.
        train: records that are fitted.
        validation: records that choose among the iterates. If the start of a record is estimated,
            the samples that determine it are not scored; a record with too few samples is left out.
        selection: further records that choose among starts, but not among the iterates of one
            start. Best are records at amplitudes that are not fitted: starts that fit alike differ
            there (``benchmarks/starts.md``). Starts are judged on validation and selection records,
            or on the training records if there are neither.
        trainer: the search. Default: Levenberg-Marquardt.
        ridge: weight of |θ - θ_start|², see ``lfrtorch.least_squares.problem``.
        noise: where noise acts. ``"output"``: on the outputs; the simulation error is minimised.
            ``"innovation"``: also inside the system; the error of the prediction one sample ahead
            is minimised. All errors are then those of predictions, and the model of the result
            has a gain K. The given models need a K, too: ``initialise`` takes it from a linear
            model of ``estimate_bla(..., refine="prediction")``.
        horizon: samples of the windows that training records are cut into. Each window is simulated
            from a start state that is fitted with the parameters (``lfrtorch.fitting.windows``),
            or from an output if the record has a measured start. Errors are then those in windows.
            Default: whole records.
        average: largest number of starts whose mean is the model of the result
            (:func:`lfrtorch.mean_model`); at least this many go to the end. The best
            starts are averaged, as many as keep the error on validation and selection records
            within 1 % of the least; one start may be best. Without such records all are averaged.
            Starts that diverge when the training input is doubled take no part.
        monitors: called with the model and its progress after every iteration, one at a time. For
            several models, give a list of monitors for each. Each process calls the monitors it was
            given: give monitors that print or write files to the first process only. Default: a
            line on a terminal or in a notebook, and nothing elsewhere; ``[]``: nothing at all.
        watch: called after each round.
        ranks: the processes that share starts or training records. Default: those of a
            ``with distributed.connect():`` around the call. Each process calls this function with
            the same arguments, starts from the weights of the first process and returns the same
            fit. If another process fits a start, monitors see only its best and its last iterate of
            each round.
        snapshots: where the state of each start is saved. Starts go on from a saved state, to the
            same end as without an interruption (on the same machine).
        stop: called before each iteration; the fit ends there if it returns True, for example
            ``lambda: time.monotonic() > deadline``. If one of several processes returns True, all
            processes end.

    Returns:
        The fit of the best start; its ``seconds`` are the time of all starts together. For several
        models, ``starts`` lists all of them, the best first, and ``averaged`` is the number of
        models that were averaged.

    Raises:
        ValueError: no model; no model that is stable on the training records before the first
            iteration; only validation records with too few samples; fewer starts and fewer records
            than processes; a number of lists of monitors that is not the number of models;
            ``average`` above 1 with known models, or with predictors of systems that have held
            entries; a trainer with a ``guarantee`` and ``noise="innovation"``.
        ProcessLostError, StoppedError: before there was an iterate to keep.

    Example:
        >>> before = lfrtorch.rmse(record, model.simulate(record))
        >>> trainer = lfrtorch.LevenbergMarquardt(max_iter=20)
        >>> result = lfrtorch.fit(model, record, trainer=trainer)
        >>> lfrtorch.rmse(record, result.model.simulate(record)) < before / 10
        True

        From three starts:

        >>> models = [lfrtorch.initialise(bla, record, nz=1, nw=1, nn=4, seed=i) for i in range(3)]
        >>> result = lfrtorch.fit(models, record, trainer=trainer)
        >>> sorted(start.number for start in result.starts)
        [0, 1, 2]
    """
    guarantee = None if trainer is None else trainer.guarantee
    refuse_together(noise=noise, horizon=horizon, guarantee=guarantee)
    options: dict[str, Any] = {
        "trainer": LevenbergMarquardt() if trainer is None else trainer,
        "ridge": ridge,
        "horizon": horizon,
        "stop": stop,
    }
    found = partial(_fitted, average=average, watch=watch, snapshots=snapshots, options=options)
    models = models if isinstance(models, Model) else _different(models)
    with using(ranks):
        if noise == "output":
            models = without_gain(models)
            return found(models, train, validation, selection, monitors=monitors)
        starts, *data = predicting(models, train, validation, selection)
        result = found(starts, *data, monitors=shown_innovation_form(monitors))
    members = tuple(model.innovation_form() for model in result.members)
    return replace(result, model=result.model.innovation_form(), members=members)


def _different(models: Any) -> list[Model]:
    """The models as a list; refuse entries that are not a model, and models that share weights."""
    starts = list(models) if isinstance(models, list | tuple) else [models]
    for number, model in enumerate(starts):
        if not isinstance(model, Model):
            raise InputError(
                f"models[{number}] is a {type(model).__name__}; give models, as initialise and "
                "load return them."
            )
    seen: dict[int, int] = {}
    for number, model in enumerate(starts):
        first = seen.setdefault(id(model.lfr.cell.A), number)
        if first != number:
            raise InputError(
                f"models[{number}] shares its weights with models[{first}], and a fit changes them "
                "in place; give a start with another seed, or copy.deepcopy(model)."
            )
    return starts


def _fitted(
    models: Model | Sequence[Model],
    train: Record | Sequence[Record],
    validation: Record | Sequence[Record],
    selection: Record | Sequence[Record],
    *,
    average: int,
    monitors: Sequence[Monitor] | Sequence[Sequence[Monitor]] | None,
    watch: Callable[[Round], None],
    snapshots: Snapshots | None,
    options: Mapping[str, Any],
) -> FitResult:
    """Fit models to records as they are; ``options`` are keywords of ``Fit``."""
    alone = isinstance(models, Model)
    starts = [models] if alone else list(models)
    given = [monitors] if alone and monitors is not None else monitors
    watching = cast(Sequence[Sequence[Monitor]], given or ())
    _check(starts, watching, average)
    validation, selection = (
        [*map(with_window, as_records(some))] if some else [] for some in (validation, selection)
    )
    clock = time.perf_counter()
    snapshots = Snapshots() if snapshots is None else snapshots
    halt = Event()
    stop, train = options["stop"], as_records(train)
    planned = schedule(len(starts), options["trainer"].limit, average)
    sharing = current().sharing_records(len(starts))
    spread = sharing.world < current().world
    own = {"stop": any_of(halt, stop) if sharing.world == 1 else stop}
    if spread:
        same_weights(starts)
    with using(sharing):
        fits = [
            Fit(model, train, validation, **{**options, **own}, keep=snapshots.keeper(number))
            for number, model in enumerate(starts)
        ]
    if all(one.diverges for one in fits):
        which = "the model diverges" if len(fits) == 1 else "all models diverge"
        raise StartDivergesError(
            f"{which} on the training records before the first iteration; start from a stable "
            "model, or use the linear model alone (lfrtorch linear)."
        )
    snapshots.restore(fits)
    clock -= sum(fit.seconds for fit in fits)  # counts the iterations before an interruption
    unseen = [*validation, *selection]
    field, cut = fits, None
    with ExitStack() as ending:
        if monitors is None and current().rank == 0:
            line = line_of(starts, planned)
            watching = [[line]] * len(starts)
            ending.callback(line.close)
        watching = watching or [()] * len(fits)
        if spread:
            together: Together = OverProcesses(
                fits, watching, halt, stop=any_of(halt, stop), take=snapshots.take
            )
        else:
            together = Together(fits, watching, halt)
        judge = _Judge(fits, unseen if selection or average > 1 else [], together)
        begun = deepcopy(starts[0])
        for number, (_, until) in enumerate(planned, start=1):
            if number <= len(snapshots.rounds):
                field = _drop_others(field, [fits[i] for i in snapshots.rounds[number - 1]])
                continue
            together.advance(field, until)
            # This includes a start that had not begun when the fit was asked to end.
            cut = next((fit for fit in field if fit.reason in CUT_SHORT), None)
            field = judge.ranked(field)
            if not field:
                raise StoppedError("stopped before the first iterate of the fit")
            watch(Round(number, len(planned), judge.summaries(field), time.perf_counter() - clock))
            if cut is not None:
                for one in field:
                    if not one.reason:  # the start reached the end of the round
                        one.note_end(cut.reason, cut.detail)
                break
            if number < len(planned):
                kept, _ = planned[number]
                snapshots.decided([judge.numbers[id(fit)] for fit in field[:kept]])
                field = _drop_others(field, field[:kept])
    if len(fits) > 1 and options["horizon"] is None and begun.lfr.cell.of_system is None:
        judge.refuse_what_remembers(field, train, begun)
    ranked = judge.ranked(fits)
    result = ranked[0].result()
    if cut is not None:  # the best start may be complete while others were cut short
        result = replace(result, reason=cut.reason, detail=cut.detail)
    elif result.reason in (Reason.JACOBIAN_VANISHES, Reason.GRADIENT_DIVERGED) and (
        flaw := infinite_slope(result.model, train)
    ):
        result = replace(result, reason=Reason.JACOBIAN_VANISHES, detail=flaw)
    if not alone:
        result = replace(result, starts=judge.summaries(ranked))
    if average > 1:
        best = judge.stable(field, as_records(train))[:average]
        mean, count = judge.mean(best)
        if mean is not None:
            result = replace(result, model=mean, averaged=count, members=tuple(best[:count]))
    given = any(record.start == "given" for record in (*train, *unseen))
    for model in (result.model, *result.members):
        scale_states(model, train, keep_coordinates=given)
    return replace(result, seconds=time.perf_counter() - clock)


def _check(starts: Sequence[Model], watching: Sequence[Sequence[Monitor]], average: int) -> None:
    """Refuse what cannot be fitted or averaged."""
    if not starts:
        raise InputError("there is no model to start from; give one or more.")
    if watching and len(watching) != len(starts):
        raise InputError(
            f"there are {len(starts)} models and {len(watching)} lists of monitors; give each "
            "model its own."
        )
    integer("average", average, 1)
    for model in starts:
        if average > 1 and model.lfr.cell.of_system:
            raise InputError(
                f"average is {average}; a mean of predictors breaks entries that structure, fixed "
                "or integrators hold in their systems; give average=1 or noise='output'."
            )
        refuse_together(average=average, known="given" if model.known_states else None)


def schedule(starts: int, limit: int, average: int = 1) -> list[tuple[int, int]]:
    """Number of starts in each round, and the iteration at which the round ends."""
    parts = ROUNDS if starts > 1 else ()
    planned = []
    for until in sorted({ceil(part * limit) for part in parts} | {limit}):
        planned.append((starts, until))
        # At least two go to the end: the best of four starts after 25 iterations ended in a poor
        # minimum, for one of five realisations of the parallel Wiener-Hammerstein stand-in.
        starts = min(starts, max(2, average, ceil(starts / 2)))
    return planned


def cheap_starts(rows: int, parameters: int, limit: int, most: int = 8) -> int:
    """Number of starts, ``most`` or a half, a quarter, ..., that take a minute on one core."""
    # An iteration takes 20 ns for each pair of a row and a parameter (Bouc-Wen: 8192 samples, 89
    # parameters, 14 ms). If seconds were measured, the number would depend on the machine.
    work = 20e-9 * rows * parameters
    counts = (most >> halvings for halvings in range(most.bit_length() - 1))
    cheap = (n for n in counts if work * iterations_of(schedule(n, limit)) <= _MINUTE)
    return next(cheap, 1)


def iterations_of(planned: Sequence[tuple[int, int]]) -> int:
    """Iterations of all starts together."""
    ends = [0, *(until for _, until in planned)]
    return sum(count * (b - a) for (count, _), a, b in zip(planned, ends, ends[1:], strict=False))


def line_of(
    models: Sequence[Model], planned: Sequence[tuple[int, int]]
) -> ProgressLine | StartsLine:
    """The line that shows progress on a terminal or in a notebook, and nothing elsewhere."""
    if len(models) == 1:
        return ProgressLine(every=None)
    unit = common_unit(models[0].outputs)
    return StartsLine(len(models), unit, iterations=iterations_of(planned))


class _Judge:
    """Ranks starts by their best iterates."""

    # Without ``records`` the fits' own validation or training errors rank the starts; these errors
    # do not tell whether a mean is better.

    def __init__(self, fits: Sequence[Fit], records: Sequence[Record], together: Together) -> None:
        self._fits, self._records, self._together = fits, records, together
        self.numbers = {id(fit): number for number, fit in enumerate(fits)}
        self._errors = {id(fit): self._error(fit.model) for fit in fits} if records else {}
        self._refused = set[int]()

    def ranked(self, fits: Sequence[Fit]) -> list[Fit]:
        """Sort the fits that have begun, the best first, and those that are refused last."""
        begun = [fit for fit in fits if fit.history]
        scores = np.nan_to_num([self._score(fit) for fit in begun], nan=np.inf, posinf=np.inf)
        order = np.argsort(scores, kind="stable")
        return sorted((begun[i] for i in order), key=lambda fit: id(fit) in self._refused)

    def refuse_what_remembers(
        self, fits: Sequence[Fit], train: Sequence[Record], start: Model
    ) -> None:
        """Rank starts whose models do not forget their start state behind all others."""
        remember = [not forgets(fit.model, train, start).right for fit in fits]
        for fit, refused in zip(fits, self._same([*map(float, remember)]), strict=True):
            if refused:
                self._refused.add(id(fit))

    def summaries(self, fits: Sequence[Fit]) -> tuple[RestartSummary, ...]:
        """Return a summary of each start."""
        found = []
        for fit in fits:
            error, best = self._errors.get(id(fit)), fit.kept
            selection = math.nan if error is None else error.rmse(error.read())
            number, last, why = self.numbers[id(fit)], fit.history[-1], told(fit.reason, fit.detail)
            found.append(
                RestartSummary(number, last.iteration, best.train, best.validation, selection, why)
            )
        return tuple(found)

    def stable(self, fits: Sequence[Fit], train: Sequence[Record]) -> list[Model]:
        """Return the models that stay stable on louder inputs, the best first."""
        # One unstable model makes the mean unstable. Rounding may differ between processes, so the
        # first process decides.
        models = [fit.model for fit in self.ranked(fits) if id(fit) not in self._refused]
        reach = self._same([largest_stable_amplitude(model, train) for model in models])
        return [model for model, to in zip(models, reach, strict=True) if to >= max(LOUDER)]

    def mean(self, best: Sequence[Model]) -> tuple[Model | None, int]:
        """Average as many models as leave the mean about as good as the best; return both.

        The mean is None if a single start is better than all means. Without records to judge on, it
        is the mean of all models.
        """
        if not self._records:
            return (mean_model(best), len(best)) if len(best) > 1 else (None, 1)
        means = [mean_model(best[:count]) for count in range(2, len(best) + 1)]
        scores = [_cost(self._error(mean)) for mean in means]
        scores = self._same([min(map(self._score, self._fits)), *scores])
        count = 1 + int((scores <= AS_GOOD**2 * scores.nan_to_num(math.inf).min()).nonzero().max())
        return (means[count - 2], count) if count > 1 else (None, 1)

    def _error(self, model: Model) -> Problem:
        """Return the error on which starts and means are compared."""
        return Problem.judge(model, self._records)

    def _score(self, fit: Fit) -> float:
        if not math.isfinite(fit.best) or not self._records:
            return fit.best
        score = float(self._same([_cost(self._errors[id(fit)])]))
        return score if math.isfinite(score) else math.inf

    def _same(self, numbers: list[float]) -> Tensor:
        """Return the numbers of the first process."""
        return self._together.agreed(torch.tensor(numbers, dtype=torch.float64))


def _cost(error: Problem) -> float:
    return error.evaluate(error.read()).cost


def _drop_others(field: list[Fit], kept: list[Fit]) -> list[Fit]:
    """Return the starts that are kept, and end the others."""
    for fit in field:
        if not (fit.diverges or any(fit is other for other in kept)):
            fit.note_end(Reason.OTHERS_BETTER)
    return kept
