"""Callbacks of an identification, for progress, notes and monitors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from lfrtorch.data.dataset import Dataset
from lfrtorch.fitting.live_line import LiveLine, ProgressLine, StartsLine
from lfrtorch.fitting.multistart import line_of, schedule
from lfrtorch.fitting.settings import Settings
from lfrtorch.fitting.trainer import FitResult, Monitor, Round
from lfrtorch.linear.model import LinearModel
from lfrtorch.model.model import Model


class Watching(NamedTuple):
    """Callbacks of a fit; see :func:`lfrtorch.fit`.

    Args:
        monitors: a list for each start, called after each of its iterations.
        watch: called after each round of several starts.
    """

    monitors: Sequence[Sequence[Monitor]]
    watch: Callable[[Round], None]


class Observer:
    """Receives a report of every step of :func:`lfrtorch.identify`; this class ignores them all.

    Example:
        >>> observer = lfrtorch.Observer()  # for identify(..., observer=observer)
        >>> observer.say("nobody hears this")
    """

    def say(self, text: str) -> None:
        """Receive a sentence or a table."""

    def searching(self) -> Monitor | None:
        """Monitor of every iteration before the final fit; None: a line on a terminal."""
        return lambda model, progress: None

    def begin(
        self, dataset: Dataset, settings: Settings, linear: LinearModel, models: Sequence[Model]
    ) -> Watching:
        """Receive the starts of the fit, and return its callbacks; settings have chosen sizes."""
        return Watching([()] * len(models), lambda _: None)

    def end(self, result: FitResult) -> None:
        """Receive the result of the fit."""

    def close(self) -> None:
        """End the reports; also called if an error or Ctrl-C ends the identification."""


class LineObserver(Observer):
    """Shows the progress of an identification in one line on a terminal or in a notebook.

    Elsewhere nothing is shown. :class:`lfrtorch.reporting.Console` prints all reports.

    Example:
        >>> from lfrtorch.fitting.observer import LineObserver
        >>> LineObserver().say("sizes: 2 starts of 50 iterations for each model")
    """

    def __init__(self) -> None:
        self._said = LiveLine()
        self._fit: ProgressLine | StartsLine | None = None

    def say(self, text: str) -> None:
        """Show the first line of a text until the next one."""
        self._said.show(text.split("\n", 1)[0])

    def searching(self) -> Monitor | None:
        """Show the iterations in a line."""
        self._said.close(keep=False)
        return None

    def begin(
        self, dataset: Dataset, settings: Settings, linear: LinearModel, models: Sequence[Model]
    ) -> Watching:
        """Show the iterations of the fit in the line."""
        self._said.close(keep=False)
        planned = schedule(len(models), settings.trainer.limit, settings.average)
        self._fit = line_of(models, planned)
        return Watching([[self._fit]] * len(models), lambda _: None)

    def close(self) -> None:
        """End the line."""
        for line in (self._said, self._fit):
            if line is not None:
                line.close()
