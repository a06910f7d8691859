"""The training loop of all fits: step, log, keep the iterate that is best on validation, stop."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol, Self

import numpy as np
import torch
from torch import Tensor

from lfrtorch._support.errors import InputError, LfrtorchError
from lfrtorch._support.reasons import Reason, told
from lfrtorch._support.threads import spread_by_hand
from lfrtorch.data.delayed_records import delayed_records
from lfrtorch.data.records import Record, as_records
from lfrtorch.distributed import ProcessLostError
from lfrtorch.fitting import state_file
from lfrtorch.fitting.fit_state import FitState, Progress
from lfrtorch.fitting.windows import windows
from lfrtorch.least_squares.guarantee import Name, guarantee_of
from lfrtorch.least_squares.levenberg_marquardt import LevenbergMarquardt
from lfrtorch.least_squares.problem import Problem
from lfrtorch.least_squares.residual import Point
from lfrtorch.least_squares.ridge import Ridge
from lfrtorch.least_squares.search import Search
from lfrtorch.least_squares.shared_problem import problem_of
from lfrtorch.model.model import Model

EXPLOSION = 100.0
"""A step is refused if it raises the squared validation error by more than this factor, and to
more than the error at the start."""


class StartDivergesError(InputError):
    """All models diverge on the training records before the first iteration."""


class Trainer(Protocol):
    """A search in steps: Levenberg-Marquardt or Adam.

    The states of a search are plain values. They have ``point`` (θ and the simulations there),
    ``iteration``, ``reason`` (empty while the search goes on) and ``report`` (scalars of the last
    step, for monitors).
    """

    @property
    def limit(self) -> int:
        """Largest number of iterations."""
        ...

    @property
    def guarantee(self) -> Name | None:
        """Property enforced at every iteration: a stable A, or contraction."""
        ...

    def init(self, problem: Any, theta: Tensor, point: Point | None = None) -> Any:
        """State at the start θ; ``point`` is the evaluation there, if it is known."""
        ...

    def step(self, problem: Any, state: Any) -> Any:
        """Next state."""
        ...

    def refused(self, before: Any, after: Any) -> Any:
        """State to go on from after a step whose model explodes on validation."""
        ...

    def prolonged(self, state: Any) -> Any:
        """State to go on from; a search that used up its iterations goes on if the limit rises."""
        ...


Monitor = Callable[[Model, Progress], None]
"""Called at the start and after each iteration, with the model at this iterate."""

Stop = Callable[[], bool]
"""Called before each iteration; True ends the fit there, and the best iterate is kept."""

Keep = Callable[["Fit", bool], None]
"""Called with a fit and False after each iteration, and with True when the fit pauses."""


@dataclass(frozen=True)
class RestartSummary:
    """Progress of one of several starts.

    Args:
        number: index of the start in the order given, from 0.
        train, validation: errors of its best iterate, output unit.
        selection: its error on all records that choose among starts; NaN if there are none.
        reason: why the start ended: a :class:`lfrtorch.Reason`, or a text with the detail if a
            process was lost.
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
        starts: the starts that took part in it, the best first.
        seconds: time since the beginning of the fit.
    """

    number: int
    count: int
    starts: tuple[RestartSummary, ...]
    seconds: float


@dataclass(frozen=True)
class FitResult:
    """Outcome of a fit; the best iterate is in ``model``.

    Args:
        model: the fitted model: the start itself, changed in place, unless it is a mean or has K.
        history: one entry for each iteration, the start first.
        chosen_iteration: the iterate that ``model`` holds.
        seconds: duration of the whole fit. If the fit went on from snapshots, the time before the
            interruption is included.
        seconds_per_iteration: median over the accepted iterations except the first, which may
            include compilation.
        reason: why the search ended, a :class:`lfrtorch.Reason`.
        detail: further remark on a lost process, or on a slope that is not finite.
        starts: all starts if there were several, the best first.
        averaged: number of starts whose mean is ``model``; ``history`` and ``chosen_iteration`` are
            those of the best start.
        members: the models that were averaged; empty if ``model`` is not a mean.

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

    @property
    def iterations(self) -> int:
        """Number of iterations."""
        return self.history[-1].iteration

    @property
    def outcome(self) -> str:
        """The reason with its detail, as a text."""
        return str(told(self.reason, self.detail))


class StoppedError(LfrtorchError):
    """A fit or a search was stopped before there was a model to keep."""


class Fit:
    """A fit that advances by as many iterations as it is asked for, and keeps the best iterate."""

    # Each process has its own ``stop``; if one of them returns True, all processes end.

    def __init__(
        self,
        model: Model,
        train: Record | Sequence[Record],
        validation: Record | Sequence[Record] = (),
        *,
        trainer: Trainer | None = None,
        ridge: Ridge = 0.0,
        horizon: int | None = None,
        keep: Keep = lambda fit, paused: None,
        stop: Stop | None = None,
    ) -> None:
        self.model, self.keep, self._stop = model, keep, stop
        self.trainer = LevenbergMarquardt() if trainer is None else trainer
        acting = partial(delayed_records, delay=model.delay, level=model.scaler.u_offset)
        train, validation = acting(as_records(train)), acting(validation and as_records(validation))
        model = model.delayed(0) if any(model.delay) else model
        longest = max(record.samples for record in train)
        guarantee = partial(guarantee_of, self.trainer.guarantee, longest)
        if horizon is not None:
            nx = model.lfr.cell.nx
            cut = partial(windows, horizon=horizon, nx=nx, y_scale=model.scaler.y_scale)
            train, validation = cut(train), cut(validation, fitted=False)
        self.problem = problem_of(model, train, ridge=ridge, guarantee=guarantee)
        self.judge = Problem.judge(model, validation) if validation else None
        self.at: FitState | None = None
        """State of the fit; None before the first call of ``advance``."""
        self.note_end(Reason.NO_ITERATIONS)
        theta = self.problem.theta
        self._start: Point | None = self.problem.evaluate(theta)
        if not math.isfinite(self._start.cost):
            self.note_end(Reason.START_DIVERGES)
            limit = self.trainer.limit
            lost = Progress(0, limit, math.inf, math.nan, 0.0, False, {}, math.inf)
            self.at = FitState(None, (), theta, (lost,))

    @property
    def state(self) -> Any:
        """State of the trainer; None before the first call of ``advance``."""
        return None if self.at is None else self.at.search

    @property
    def history(self) -> tuple[Progress, ...]:
        """One entry for each iterate, the start first; empty before the first ``advance``."""
        return () if self.at is None else self.at.history

    @property
    def best(self) -> float:
        """Normalised squared error of the best iterate, on validation records if there are any."""
        return math.inf if self.at is None else self.at.kept.score

    @property
    def seconds(self) -> float:
        """Time of all iterations, including those before an interruption."""
        return 0.0 if self.at is None else self.at.history[-1].seconds

    @property
    def diverges(self) -> bool:
        """True if the model diverges on the training records before the first iteration."""
        return self.reason == Reason.START_DIVERGES

    @property
    def kept(self) -> Progress:
        """The best iterate."""
        assert self.at is not None
        return self.at.kept

    @property
    def over(self) -> bool:
        """True if the fit has ended."""
        if self.at is None or self.diverges:
            return self.diverges
        return bool(self.state.reason) or self.state.iteration >= self.trainer.limit

    def short_of(self, until: int) -> bool:
        """Tell if the fit has not reached an iteration, has not ended and is not asked to stop."""
        return not self.over and self.state.iteration < until and not self.stopped()

    def note_end(self, reason: str, detail: str = "") -> None:
        """Note why the fit is over."""
        self.reason, self.detail = reason, detail

    def stopped(self) -> bool:
        """Tell if the fit is asked to end here; if so, note that as the reason."""
        asked = self._stop is not None and bool(self.problem.total(torch.tensor(int(self._stop()))))
        if asked:
            self.note_end(Reason.INTERRUPTED)
        return asked

    @spread_by_hand()
    def advance(self, until: int | None = None, monitors: Sequence[Monitor] = ()) -> Self:
        """Go on to an iteration (default: the trainer's last); the model keeps the best iterate."""
        until = self.trainer.limit if until is None else until
        try:
            if not self.history:
                self.begin(monitors)
            while self.short_of(until):
                clock = time.perf_counter()
                after = Search(self.problem, self.trainer, self.state).step()
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
        """Put the best iterate into the model, and free memory."""
        self._write_best()
        self.problem.release()
        if not self.diverges:
            self.keep(self, True)

    def save(self, path: Path) -> None:
        """Write the state to a file; after ``restore`` the fit goes on to bit-identical results."""
        whole = {"at": self.at, "problem": self.problem.state_dict()}
        state_file.write(path, *state_file.packed(whole))

    def restore(self, path: Path) -> None:
        """Take over the state of a fit of the same model, records and trainer."""
        found, tensors = state_file.read(path)
        tensors = {name: tensor.to(self.problem.theta.device) for name, tensor in tensors.items()}
        like: dict[str, Any] = {"at": self._begun(), "problem": {}}
        try:
            whole = state_file.unpacked(like, found, tensors)
        except (TypeError, KeyError):
            raise InputError(
                f"'{path}' was written with another trainer than {type(self.trainer).__name__}; "
                "continue with the trainer of the interrupted run."
            ) from None
        self.problem.load_state_dict(whole["problem"])
        at: FitState = whole["at"]
        state = at.search
        if state.iteration > self.trainer.limit:
            raise InputError(
                f"the fit that is continued has had {state.iteration} iterations, more than "
                f"max_iter, which is {self.trainer.limit}; give a larger max_iter."
            )
        state = self.problem.of_own_records(state)  # the file is of the first process's records
        self.at = replace(at, search=self.trainer.prolonged(state))
        self.reason = self.state.reason
        self._write_best()

    def begin(self, monitors: Sequence[Monitor] = ()) -> None:
        """Evaluate the start, and call the monitors."""
        self.at = self._begun()
        self._show(self.state.theta, self.at.history[0], monitors)

    def _begun(self) -> FitState:
        """State at the start."""
        clock = time.perf_counter()
        start = Search(self.problem, self.trainer).begin(self.problem.theta, self._start)
        self._start = None  # the state holds its trajectories now
        at = FitState(start, (), start.theta, ())
        return self._entered(at, start, time.perf_counter() - clock)

    def take(self, after: Any, seconds: float, monitors: Sequence[Monitor] = ()) -> None:
        """Go on from the trainer's next state, which took ``seconds`` to find."""
        # If the model there explodes on validation, the search goes back and takes smaller steps.
        assert self.at is not None
        before, last, first = self.state, self.at.score, self.at.history[0].score
        at = self._entered(self.at, after, seconds)
        if after.theta is not before.theta:
            at = replace(at, durations=(*at.durations, seconds))
        if math.isfinite(last) and not at.score <= max(EXPLOSION * last, first):
            at = replace(at, search=self.trainer.refused(before, after), score=last)
        self.at, self.reason = at, after.reason
        self._show(after.theta, at.history[-1], monitors)
        self.keep(self, False)

    def show_last(self, monitors: Sequence[Monitor]) -> None:
        """Call monitors with the latest iterate; afterwards the model is the best iterate again."""
        self._show(self.state.theta, self.history[-1], monitors)
        self._write_best()

    def result(self) -> FitResult:
        """Result of the fit."""
        assert self.at is not None
        usual = self.at.durations[1:] or self.at.durations
        return FitResult(
            model=self.model,
            history=list(self.at.history),
            chosen_iteration=self.at.chosen,
            seconds=self.seconds,
            seconds_per_iteration=float(np.median(usual)) if usual else 0.0,
            reason=self.reason,
            detail=self.detail,
        )

    def _entered(self, at: FitState, search: Any, seconds: float) -> FitState:
        """State after another iterate, which took ``seconds`` to find, with its errors."""
        clock, problem = time.perf_counter(), self.problem
        train_rmse, validation_rmse = problem.rmse_at(search.point), float("nan")
        score, judged = search.point.cost, ()
        if self.judge is not None:
            theta = search.theta[: problem.errors.parameters.own]  # the judge fits start states
            near = Point(theta, theta, 0.0, at.judged) if at.judged else None
            point = self.judge.evaluate(theta, near)  # every output counts alike
            # All processes simulate all of these records, but their rounding errors differ.
            score = float(self.problem.agreed(torch.tensor(point.cost, dtype=torch.float64)))
            validation_rmse, judged = self.judge.rmse_at(point), point.seen
        better = score < (at.kept.score if at.history else math.inf)  # False for NaN
        seconds += (at.history[-1].seconds if at.history else 0.0) + time.perf_counter() - clock
        progress = Progress(
            search.iteration, self.trainer.limit, train_rmse, validation_rmse, seconds, better,
            search.report, score,
        )  # fmt: skip
        return at.entered(search, judged, progress)

    def _write_best(self) -> None:
        """Put the best iterate into the model."""
        self.problem.write(self.problem.theta if self.at is None else self.at.best)

    def _show(self, theta: Tensor, progress: Progress, monitors: Sequence[Monitor]) -> None:
        """Call the monitors, with the weights of this iterate in the model."""
        if monitors:
            self.problem.write(theta)
        for monitor in monitors:
            monitor(self.model, progress)
