"""The one training loop: step, log, keep the best on validation, stop."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol, Self

import numpy as np
import torch
from torch import Tensor

from lfrtorch._support.errors import InputError, LfrtorchError
from lfrtorch._support.reasons import Reason, told
from lfrtorch._support.threads import spread_by_hand
from lfrtorch.distributed import ProcessLostError, Ranks
from lfrtorch.fitting import state_file
from lfrtorch.fitting.exclusions import refuse_together
from lfrtorch.fitting.windows import windows
from lfrtorch.least_squares.guarantee import Name
from lfrtorch.least_squares.levenberg_marquardt import LevenbergMarquardt, Point
from lfrtorch.least_squares.problem import Problem
from lfrtorch.least_squares.ridge import Ridge
from lfrtorch.model import Model
from lfrtorch.records import Record, as_records

EXPLOSION = 100.0
"""Growth of the squared validation error, beyond the start's, in a step that is taken back."""

_KEPT = ("best", "_chosen", "_first", "_score", "_seconds", "_durations")
"""Numbers of a fit that are saved with it."""


class StartDivergesError(InputError):
    """All models diverge on the training records at the start."""


class Trainer(Protocol):
    """A search in steps: Levenberg-Marquardt or Adam.

    Its states are values: ``point`` (θ and what the problem found there), ``iteration``, ``reason``
    (empty while it goes on), and ``report``, scalars of the last step for monitors.
    """

    @property
    def limit(self) -> int:
        """Most iterations."""
        ...

    @property
    def guarantee(self) -> Name | None:
        """What every model on the way keeps: a stable A, or contraction."""
        ...

    def init(self, problem: Any, theta: Tensor) -> Any:
        """State at the start."""
        ...

    def step(self, problem: Any, state: Any) -> Any:
        """Next state."""
        ...

    def refused(self, before: Any, after: Any) -> Any:
        """State to go on from after a step to a model that explodes on validation."""
        ...

    def prolonged(self, state: Any) -> Any:
        """State to go on from if all iterations were spent and more are allowed now."""
        ...


@dataclass(frozen=True)
class Progress:
    """One line of the history.

    Args:
        iteration: 0 is the start.
        limit: most iterations.
        train, validation: root mean squared simulation errors, output unit (normalised if outputs
            have several); validation is NaN if there is no validation record or the model diverges
            on it.
        seconds: since the start of the fit.
        best: whether this iterate is the best so far, on validation if there is one.
        report: scalars of the trainer.
        score: normalised squared error that chooses: on validation, or on training without it.
    """

    iteration: int
    limit: int
    train: float
    validation: float
    seconds: float
    best: bool
    report: dict[str, float]
    score: float

    @property
    def seconds_left(self) -> float:
        """Time that the remaining iterations would take."""
        return self.seconds / max(1, self.iteration) * (self.limit - self.iteration)


Monitor = Callable[[Model, Progress], None]
"""Called at the start and after each iteration, the iterate in the model's weights."""

Stop = Callable[[], bool]
"""Asked before each iteration; True ends the fit there, and the best iterate is kept."""

Keep = Callable[["Fit", bool], None]
"""Called with a fit after each iteration, and when it pauses (then with True)."""


@dataclass(frozen=True)
class RestartSummary:
    """How far one of several starts came.

    Args:
        number: its place in the order given, from 0.
        train, validation: errors of its best iterate, output unit.
        selection: its error on all records that choose among starts; NaN if there are none.
        reason: why it ended, a :class:`lfrtorch.Reason` or, if a process was lost, a text with the
            detail.
    """

    number: int
    iterations: int
    train: float
    validation: float
    selection: float
    reason: str


@dataclass(frozen=True)
class Round:
    """A round that has ended.

    Args:
        number, count: its number, from 1, and the number of all rounds.
        starts: that took part in it, the best first.
        seconds: since the beginning.
    """

    number: int
    count: int
    starts: tuple[RestartSummary, ...]
    seconds: float


@dataclass(frozen=True)
class FitResult:
    """Outcome of a fit; the best iterate is in ``model``.

    Args:
        model: the fitted model, the object that was given.
        history: one entry an iteration, the start first.
        chosen_iteration: the iterate that ``model`` holds.
        seconds: duration of the whole fit. If it went on from snapshots, those that its starts had
            taken before are added.
        seconds_per_iteration: median over the accepted iterations but the first, which may compile.
        reason: why the search ended, a :class:`lfrtorch.Reason`.
        detail: what else is known of a process that was lost, or a slope that is not finite.
        starts: all starts if there were several, the best first.
        averaged: number of starts that the model is the mean of; history and iterate are those
            of the best one.
        members: the models of these starts; none if it is no mean.
        distilled: number of starts whose mean the model stands for, see :func:`lfrtorch.distil`; 0
            if it does not.

    Example:
        >>> result = lfrtorch.fit(model, record, trainer=lfrtorch.LevenbergMarquardt(max_iter=3))
        >>> result.iterations, result.outcome, len(result.history)
        (3, 'maximum number of iterations', 4)
        >>> result.model is model
        True
    """

    model: Model
    history: list[Progress] = field(repr=False)
    chosen_iteration: int
    seconds: float
    seconds_per_iteration: float
    reason: str
    starts: tuple[RestartSummary, ...] = ()
    averaged: int = 1
    detail: str = ""
    members: tuple[Model, ...] = field(default=(), repr=False)
    distilled: int = 0

    @property
    def iterations(self) -> int:
        """Number of iterations."""
        return self.history[-1].iteration

    @property
    def outcome(self) -> str:
        """The reason, with its detail, as people read it."""
        return str(told(self.reason, self.detail))


class StoppedError(LfrtorchError):
    """A fit or a search was stopped before there was anything to keep."""


class Fit:
    """A fit that goes on for as many iterations as it is asked for, and keeps the best iterate."""

    # Each process has its own ``stop``, and one that says so ends all.

    def __init__(
        self,
        model: Model,
        train: Record | Sequence[Record],
        validation: Record | Sequence[Record] = (),
        *,
        trainer: Trainer | None = None,
        ridge: Ridge = 0.0,
        simulation: float = 0.0,
        horizon: int | None = None,
        ranks: Ranks | None = None,
        keep: Keep = lambda fit, paused: None,
        stop: Stop | None = None,
    ) -> None:
        self.model, self.keep, self._stop = model, keep, stop
        self.trainer = LevenbergMarquardt() if trainer is None else trainer
        self.ranks = ranks = Ranks() if ranks is None else ranks
        with torch.no_grad():
            for p in model.lfr.parameters() if ranks.world > 1 else ():
                p.copy_(ranks.first(p.detach()))
        guarantee = self.trainer.guarantee
        refuse_together(structure=model.lfr.cell.structure, guarantee=guarantee)
        longest = max(record.samples for record in as_records(train))
        if horizon is not None:
            nx = model.lfr.cell.nx
            cut = partial(windows, horizon=horizon, nx=nx, y_scale=model.scaler.y_scale)
            train = cut(as_records(train))
            if validation:
                validation = cut(as_records(validation), fitted=False)
        if simulation:
            self.problem = Problem.of_predictor(model, train, simulation, ridge=ridge, ranks=ranks)
        else:
            self.problem = Problem.of(
                model,
                train,
                ridge=ridge,
                guarantee=guarantee,
                longest=longest,
                ranks=ranks,
            )
        self.judge = self.judge_of(model, validation) if validation else None
        self._judged: Point | None = None  # the latest iterate, as the judge sees it
        self.state: Any = None
        """The trainer's; None before the first call of ``advance``."""
        self.history: list[Progress] = []
        self.note_end(Reason.NO_ITERATIONS)
        self.best = math.inf
        """Normalised squared error of the best iterate, on validation if there is one."""
        self._theta_best, self._chosen = self.problem.theta, 0
        self._first = self._score = math.inf
        self._seconds = 0.0
        self._durations: list[float] = []
        if not math.isfinite(self.problem.evaluate(self.problem.theta).cost):
            self.note_end(Reason.START_DIVERGES)
            self.history.append(
                Progress(0, self.trainer.limit, math.inf, math.nan, 0.0, False, {}, math.inf)
            )

    def judge_of(self, model: Model, records: Record | Sequence[Record]) -> Problem:
        """Return the problem of a model's errors on records that are not fitted."""
        return Problem.judge(model, records, like=self.problem)

    @property
    def seconds(self) -> float:
        """Time of all iterations, those before it went on included."""
        return self._seconds

    @property
    def diverges(self) -> bool:
        """Whether the model diverges on the training records at the start."""
        return self.reason == Reason.START_DIVERGES

    @property
    def kept(self) -> Progress:
        """The best iterate."""
        return self.history[self._chosen]

    @property
    def over(self) -> bool:
        """Whether there is no more to come."""
        if not self.history or self.diverges:
            return self.diverges
        return bool(self.state.reason) or self.state.iteration >= self.trainer.limit

    def short_of(self, until: int) -> bool:
        """Return whether it goes on to an iteration, and is not asked to stop."""
        return not self.over and self.state.iteration < until and not self.stopped()

    def note_end(self, reason: str, detail: str = "") -> None:
        """Note why the fit is over."""
        self.reason, self.detail = reason, detail

    def stopped(self) -> bool:
        """Whether the fit is asked to end here, which then is its reason."""
        asked = self._stop is not None and bool(self.ranks.sum(torch.tensor(int(self._stop()))))
        if asked:
            self.note_end(Reason.INTERRUPTED)
        return asked

    @spread_by_hand()
    def advance(self, until: int | None = None, monitors: Sequence[Monitor] = ()) -> Self:
        """Go on to an iteration (default: the trainer's last); the best is in the model."""
        until = self.trainer.limit if until is None else until
        try:
            if not self.history:
                self.begin(monitors)
            while self.short_of(until):
                clock = time.perf_counter()
                after = self.trainer.step(self.problem, self.state)
                self.take(after, time.perf_counter() - clock, monitors)
        except KeyboardInterrupt:
            if not self.history:
                raise
            self.note_end(Reason.INTERRUPTED)
        except ProcessLostError as lost:
            if not self.history:
                raise
            self.note_end(Reason.PROCESS_LOST, lost.detail)
        finally:
            self.pause()
        return self

    def pause(self) -> None:
        """Put the best iterate into the model, and let go of memory."""
        self.problem.write(self._theta_best)
        self.problem.release()
        if not self.diverges:
            self.keep(self, True)

    def save(self, path: Path) -> None:
        """Write the state of the fit to a file, from which ``restore`` goes on to the same bits."""
        state, tensors = state_file.packed(self.state)
        problem = self.problem.state_dict()
        tensors |= {f"problem.{name}": tensor for name, tensor in problem.items()}
        if self._judged is not None:
            tensors |= state_file.leaves(self._judged.seen, "judged")
        numbers = {
            "state": state,
            "history": [asdict(progress) for progress in self.history],
            **{name: getattr(self, name) for name in _KEPT},
        }
        state_file.write(path, numbers, tensors | {"best": self._theta_best})

    def restore(self, path: Path) -> None:
        """Take over the state of a fit of the same model, records and trainer."""
        numbers, tensors = state_file.read(path)
        device = self.problem.theta.device
        like = self.trainer.init(self.problem, self.problem.theta)
        tensors = {name: tensor.to(device) for name, tensor in tensors.items()}
        self.problem.load_state_dict(state_file.within("problem.", tensors))
        try:
            state = state_file.unpacked(like, numbers["state"], tensors)
        except (TypeError, KeyError):
            raise InputError(
                f"'{path}' was left by another trainer than {type(self.trainer).__name__}; go "
                "on with the one that the run had."
            ) from None
        if state.iteration > self.trainer.limit:
            raise InputError(
                f"the fit that is to go on has had {state.iteration} iterations, more than the "
                f"{self.trainer.limit} asked for; ask for more."
            )
        if self.ranks.world > 1:  # what was kept is the first process's part
            point = self.problem.evaluate(state.theta)
            state = replace(state, residual=point.residual, seen=point.seen)
        if self.judge is not None:
            own = self.problem.errors.parameters.own
            self._judged = self.judge.evaluate(state.theta[:own])
            seen = state_file.refilled(self._judged.seen, "judged", tensors)
            self._judged = self._judged._replace(seen=seen)
        self.state = self.trainer.prolonged(state)
        self.reason = self.state.reason
        self.history = [Progress(**entry) for entry in numbers["history"]]
        self._theta_best = tensors["best"]
        for name in _KEPT:
            setattr(self, name, numbers[name])
        self.problem.write(self._theta_best)

    def begin(self, monitors: Sequence[Monitor] = ()) -> None:
        """Judge the start."""
        clock = time.perf_counter()
        start = self.trainer.init(self.problem, self.problem.theta)
        progress = self._progress(start, time.perf_counter() - clock)
        self._first = progress.score
        self._enter(start, progress)
        self._show(start.theta, progress, monitors)

    def take(self, after: Any, seconds: float, monitors: Sequence[Monitor] = ()) -> None:
        """Go on from the trainer's next state, which took ``seconds`` to find."""
        # If the model there explodes on validation, the search goes back and takes smaller steps.
        before, last = self.state, self._score
        progress = self._progress(after, seconds)
        if after.theta is not before.theta:
            self._durations.append(seconds)
        self._enter(after, progress)
        self.reason = after.reason
        if math.isfinite(last) and not progress.score <= max(EXPLOSION * last, self._first):
            self.state, self._score = self.trainer.refused(before, after), last
        self._show(after.theta, progress, monitors)
        self.keep(self, False)

    def show_last(self, monitors: Sequence[Monitor]) -> None:
        """Call monitors with the latest iterate; the best is in the model again after that."""
        self._show(self.state.theta, self.history[-1], monitors)
        self.problem.write(self._theta_best)

    def result(self) -> FitResult:
        """What was found."""
        usual = self._durations[1:] or self._durations
        return FitResult(
            model=self.model,
            history=self.history,
            chosen_iteration=self._chosen,
            seconds=self._seconds,
            seconds_per_iteration=float(np.median(usual)) if usual else 0.0,
            reason=self.reason,
            detail=self.detail,
        )

    def _progress(self, state: Any, seconds: float) -> Progress:
        """The errors of an iterate, as a line of the history; it took ``seconds`` to find."""
        clock, problem = time.perf_counter(), self.problem
        train_rmse, validation_rmse = problem.rmse_at(state.point), float("nan")
        score = state.point.cost
        if self.judge is not None:
            theta = state.theta[: problem.errors.parameters.own]  # the judge finds initial states
            self._judged = self.judge.evaluate(theta, self._judged)  # every output counts alike
            # Each process has all of these records, and its own rounding errors.
            score = torch.tensor(self._judged.cost, dtype=torch.float64)
            score = float(self.ranks.first(score))
            validation_rmse = self.judge.rmse_at(self._judged)
        better = score < self.best  # False for the NaN of a model that diverges on validation
        seconds += self._seconds + time.perf_counter() - clock
        return Progress(
            state.iteration, self.trainer.limit, train_rmse, validation_rmse, seconds, better,
            state.report, score,
        )  # fmt: skip

    def _enter(self, state: Any, progress: Progress) -> None:
        """Note an iterate, and keep it if it is the best."""
        if progress.best:
            self._theta_best, self.best = state.theta, progress.score
            self._chosen = len(self.history)
        self.state, self._score, self._seconds = state, progress.score, progress.seconds
        self.history.append(progress)

    def _show(self, theta: Tensor, progress: Progress, monitors: Sequence[Monitor]) -> None:
        """Call the monitors, with the iterate in the model."""
        if monitors:
            self.problem.write(theta)
        for monitor in monitors:
            monitor(self.model, progress)
