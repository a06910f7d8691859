"""The one training loop: step, log, keep the best on validation, stop."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from torch import Tensor
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from lfrtorch.levenberg_marquardt import LevenbergMarquardt
from lfrtorch.model import Model
from lfrtorch.ranks import ProcessLost, Ranks
from lfrtorch.records import Record
from lfrtorch.residual import Ridge, SimulationError
from lfrtorch.threads import spread_by_hand

INTERRUPTED = "interrupted"


class OptimiserState(Protocol):
    """What the loop reads of an optimiser's state."""

    @property
    def theta(self) -> Tensor:
        """Parameters (P,)."""
        ...

    @property
    def residual(self) -> Tensor:
        """r (M,) at θ."""
        ...

    @property
    def iteration(self) -> int:
        """Steps so far."""
        ...

    @property
    def reason(self) -> str:
        """Why the search is over; empty while it is not."""
        ...

    @property
    def report(self) -> dict[str, float]:
        """Scalars of the last step, for the monitors."""
        ...


class Optimiser(Protocol):
    """A search in steps: Levenberg-Marquardt or Adam."""

    @property
    def limit(self) -> int:
        """Most iterations."""
        ...

    def init(self, problem: Any, theta: Tensor) -> Any:
        """State at the start."""
        ...

    def step(self, problem: Any, state: Any) -> Any:
        """Next state."""
        ...


@dataclass(frozen=True)
class Progress:
    """One line of the history.

    Args:
        iteration: 0 is the start.
        limit: most iterations.
        train, validation: root mean squared simulation errors, output unit; validation is NaN
            where there is no validation record or the model diverges on it.
        seconds: since the start of the fit.
        best: whether this iterate is the best so far, on validation where there is one.
        report: scalars of the optimiser.
    """

    iteration: int
    limit: int
    train: float
    validation: float
    seconds: float
    best: bool
    report: dict[str, float]

    @property
    def seconds_left(self) -> float:
        """Time that the remaining iterations would take."""
        return self.seconds / max(1, self.iteration) * (self.limit - self.iteration)


Monitor = Callable[[Model, Progress], None]
"""Called at the start and after each iteration, the iterate in the model's weights."""


@dataclass(frozen=True)
class FitResult:
    """Outcome of a fit; the best iterate is in ``model``.

    Args:
        model: the fitted model, the object that was given.
        history: one entry an iteration, the start first.
        chosen_iteration: the iterate that ``model`` holds.
        seconds: duration of the whole fit.
        seconds_per_iteration: median over the accepted iterations but the first, which may compile.
        reason: why the search ended.
    """

    model: Model
    history: list[Progress] = field(repr=False)
    chosen_iteration: int
    seconds: float
    seconds_per_iteration: float
    reason: str

    @property
    def iterations(self) -> int:
        """Number of iterations."""
        return self.history[-1].iteration


@spread_by_hand()
def fit(
    model: Model,
    train: Record | Sequence[Record],
    validation: Record | Sequence[Record] = (),
    *,
    optimiser: Optimiser | None = None,
    ridge: Ridge = 0.0,
    monitors: Sequence[Monitor] = (),
    ranks: Ranks | None = None,
) -> FitResult:
    """Minimise the simulation error of a model over records.

    The iterate with the smallest error on the validation records (without them: on the training
    records) is kept, also when the search is interrupted by Ctrl-C, or one of the processes that
    share the records is lost: ``reason`` then begins with "a process was lost".

    Args:
        model: where to start; its weights are changed in place.
        train: records that are fitted.
        validation: records that choose among the iterates.
        optimiser: Levenberg-Marquardt with its defaults where left out.
        ridge: weight of |θ - θ_start|², see ``SimulationError``.
        monitors: called with the model and its progress after every iteration. Each process calls
            its own: give those that print or write files to the first alone.
        ranks: the processes that share the training records, ``distributed.connect()``; each calls
            this function with the same arguments, starts from the first one's weights and returns
            the same fit.

    Raises:
        ValueError: the model diverges on the training records at the start, or there are fewer
            records than processes.
        ProcessLost: before there was an iterate to keep.
    """
    optimiser = LevenbergMarquardt() if optimiser is None else optimiser
    ranks = Ranks() if ranks is None else ranks
    if ranks.world > 1:
        weights = parameters_to_vector(model.lfr.parameters())
        vector_to_parameters(ranks.first(weights), model.lfr.parameters())
    problem = SimulationError(model, train, ridge=ridge, ranks=ranks)
    judge = SimulationError(model, validation, solved_starts=True) if validation else None
    if not math.isfinite(problem.cost(problem.residual(problem.theta))):
        raise ValueError(
            "the model diverges on the training records at the start; start from a stable model."
        )
    begin = time.perf_counter()
    history: list[Progress] = []
    durations: list[float] = []
    theta_best, best, chosen, reason = problem.theta, float("inf"), 0, "no iterations asked for"

    def record(state: OptimiserState) -> None:
        nonlocal theta_best, best, chosen
        train_rmse, validation_rmse = problem.rmse(state.theta), float("nan")
        score = problem.cost(state.residual)
        if judge is not None:
            problem.write(state.theta)
            theta = judge.theta
            score = judge.cost(judge.residual(theta))  # normalised: every output counts alike
            validation_rmse = judge.rmse(theta)
        better = score < best  # False for the NaN of a model that diverges on validation
        if better:
            theta_best, best, chosen = state.theta, score, state.iteration
        elapsed = time.perf_counter() - begin
        progress = Progress(
            state.iteration, optimiser.limit, train_rmse, validation_rmse, elapsed, better,
            state.report,
        )  # fmt: skip
        history.append(progress)
        problem.write(state.theta)
        for monitor in monitors:
            monitor(model, progress)

    try:
        state = optimiser.init(problem, problem.theta)
        record(state)
        while state.iteration < optimiser.limit:
            before, clock = state.theta, time.perf_counter()
            state = optimiser.step(problem, state)
            if state.theta is not before:
                durations.append(time.perf_counter() - clock)
            record(state)
            reason = state.reason
            if reason:
                break
    except KeyboardInterrupt:
        if not history:
            raise
        reason = INTERRUPTED
    except ProcessLost as lost:
        if not history:
            raise
        reason = str(lost)
    finally:
        problem.write(theta_best)
    usual = durations[1:] or durations
    return FitResult(
        model=model,
        history=history,
        chosen_iteration=chosen,
        seconds=time.perf_counter() - begin,
        seconds_per_iteration=float(np.median(usual)) if usual else 0.0,
        reason=reason,
    )
