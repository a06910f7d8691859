"""An observer that prints: sentences, and a progress line while the fit runs."""

from __future__ import annotations

from collections.abc import Sequence

from lfrtorch.dataset import Dataset
from lfrtorch.fitting.observer import Observer, Watching
from lfrtorch.fitting.settings import Settings
from lfrtorch.fitting.trainer import FitResult
from lfrtorch.linear.model import LinearModel
from lfrtorch.model import Model
from lfrtorch.reporting.monitor import ProgressLine, StartsLine


class Console(Observer):
    """Prints what :func:`lfrtorch.identify` finds, step by step.

    Example:
        >>> from lfrtorch.reporting.console import Console
        >>> Console().say("note: the input is constant")
        note: the input is constant
    """

    def say(self, text: str) -> None:
        """Print it."""
        print(text, flush=True)

    def begin(
        self, dataset: Dataset, settings: Settings, linear: LinearModel, models: Sequence[Model]
    ) -> Watching:
        """Show a line that follows the iterations, or for several starts a line a round."""
        if len(models) > 1:
            lines = StartsLine(len(models), models[0].outputs[0].unit)
            return Watching([[lines]] * len(models), lines.round)
        self._line = ProgressLine()
        return Watching([[self._line]], lambda _: None)

    def end(self, result: FitResult) -> None:
        """End the line."""
        if not result.starts or len(result.starts) == 1:
            self._line.close()
