"""The state of a fit as a plain value: what its next iteration needs, and its history."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

from torch import Tensor


@dataclass(frozen=True)
class Progress:
    """One line of the history.

    Args:
        iteration: number of the iteration; 0 is the start.
        limit: largest number of iterations.
        train, validation: root mean squared simulation errors in the output unit (normalised if
            outputs have several units). ``validation`` is NaN if there is no validation record or
            the model diverges on one.
        seconds: time since the start of the fit.
        best: True if this iterate has the smallest ``score`` so far.
        report: scalars of the trainer.
        score: normalised squared error that chooses the iterate: on the validation records, or on
            the training records if there are no validation records.
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
        """Time that the remaining iterations would take at the mean rate so far."""
        return self.seconds / max(1, self.iteration) * (self.limit - self.iteration)


@dataclass(frozen=True)
class FitState:
    """Where a fit stands after an iteration.

    Args:
        search: the trainer's state that the next step goes on from.
        judged: trajectories of the latest iterate on validation records.
        best: θ of the best iterate.
        chosen: index of the best iterate in ``history``.
        history: one entry for each iterate, the start first.
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
