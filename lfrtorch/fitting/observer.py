"""Who looks on while a model is identified."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from lfrtorch.dataset import Dataset
from lfrtorch.fitting.multistart import Round
from lfrtorch.fitting.settings import Settings
from lfrtorch.fitting.trainer import FitResult, Monitor
from lfrtorch.linear.model import LinearModel
from lfrtorch.model import Model


class Watching(NamedTuple):
    """What a fit calls, see :func:`lfrtorch.fit`.

    Args:
        monitors: a list for each start, called after each of its iterations.
        watch: called after each round of several starts.
    """

    monitors: Sequence[Sequence[Monitor]]
    watch: Callable[[Round], None]


class Observer:
    """Is told of every step of :func:`lfrtorch.identify`. This one keeps quiet."""

    def say(self, text: str) -> None:
        """Take a sentence or a table, when it is known."""

    def begin(
        self, dataset: Dataset, settings: Settings, linear: LinearModel, models: Sequence[Model]
    ) -> Watching:
        """Look at what a fit starts from; the settings have the sizes that were chosen."""
        return Watching([()] * len(models), lambda _: None)

    def end(self, result: FitResult) -> None:
        """Look at the fit."""
