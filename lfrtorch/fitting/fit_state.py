"""The state of a fit as a value: what its next iteration depends on, and what it has found."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

from torch import Tensor


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
        best: True if this iterate is the best so far, on validation if there is one.
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


@dataclass(frozen=True)
class FitState:
    """Where a fit stands after an iteration.

    Args:
        search: the trainer's state that the next step goes on from.
        judged: trajectories of the latest iterate on validation records.
        best: θ of the best iterate.
        chosen: its place in the history.
        history: values of all iterates, the start first.
        score: normalised squared error of the iterate that the search goes on from.
        durations: seconds of each accepted iteration.
    """

    search: Any
    judged: tuple[Any, ...]
    best: Tensor
    history: tuple[Progress, ...]
    chosen: int = 0
    score: float = math.inf
    durations: tuple[float, ...] = ()

    @property
    def kept(self) -> Progress:
        """The best iterate."""
        return self.history[self.chosen]

    def entered(self, search: Any, judged: tuple[Any, ...], progress: Progress) -> FitState:
        """State after another iterate, which is kept if it is the best."""
        found = replace(
            self,
            search=search,
            judged=judged,
            score=progress.score,
            history=(*self.history, progress),
        )
        if not progress.best:
            return found
        return replace(found, best=search.theta, chosen=len(self.history))
