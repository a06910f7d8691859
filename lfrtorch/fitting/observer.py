"""Callbacks of an identification: progress, notes, monitors."""

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
    """Callback of a fit, see :func:`lfrtorch.fit`.

    Args:
        monitors: a list for each start, called after each of its iterations.
        watch: called after each round of several starts.
    """

    monitors: Sequence[Sequence[Monitor]]
    watch: Callable[[Round], None]


class Observer:
    """Is told of every step of :func:`lfrtorch.identify`. This one keeps quiet.

    Example:
        >>> observer = lfrtorch.Observer()  # for identify(..., observer=observer)
        >>> observer.say("nobody hears this")
    """

    def say(self, text: str) -> None:
        """Take a sentence or a table, when it is known."""

    def searching(self) -> Monitor | None:
        """Monitors of every iteration of the search for sizes; None: a line on a terminal."""
        return lambda model, progress: None

    def begin(
        self, dataset: Dataset, settings: Settings, linear: LinearModel, models: Sequence[Model]
    ) -> Watching:
        """Look at what a fit starts from; the settings have the sizes that were chosen."""
        return Watching([()] * len(models), lambda _: None)

    def end(self, result: FitResult) -> None:
        """Look at the fit."""

    def close(self) -> None:
        """Stop looking on; also if an error or Ctrl-C ended the identification."""


class LineObserver(Observer):
    """Shows how far an identification is in one line of a terminal or a notebook.

    Elsewhere nothing is shown. :class:`lfrtorch.reporting.Console` prints all that there is to say.

    Example:
        >>> from lfrtorch.fitting.observer import LineObserver
        >>> LineObserver().say("sizes: 2 starts of 50 iterations for each model")
    """

    def __init__(self) -> None:
        self._said = LiveLine()
        self._fit: ProgressLine | StartsLine | None = None

    def say(self, text: str) -> None:
        """Show its first line until there is more to say."""
        self._said.show(text.split("\n", 1)[0])

    def searching(self) -> Monitor | None:
        """Show a line."""
        self._said.close(keep=False)
        return None

    def begin(
        self, dataset: Dataset, settings: Settings, linear: LinearModel, models: Sequence[Model]
    ) -> Watching:
        """Follow the iterations."""
        self._said.close(keep=False)
        planned = schedule(len(models), settings.trainer.limit, settings.average)
        self._fit = line_of(models, planned)
        return Watching([[self._fit]] * len(models), lambda _: None)

    def close(self) -> None:
        """End the line."""
        for line in (self._said, self._fit):
            if line is not None:
                line.close()
