"""An observer that prints sentences, and a progress line while the fit runs."""

from __future__ import annotations

from collections.abc import Sequence

from lfrtorch._support.tables import in_lines
from lfrtorch.data.dataset import Dataset
from lfrtorch.data.records import common_unit
from lfrtorch.fitting.live_line import ProgressLine, StartsLine
from lfrtorch.fitting.multistart import iterations_of, schedule
from lfrtorch.fitting.observer import Observer, Watching
from lfrtorch.fitting.settings import Settings
from lfrtorch.fitting.trainer import FitResult
from lfrtorch.linear.model import LinearModel
from lfrtorch.model.model import Model


class Console(Observer):
    """Prints what :func:`lfrtorch.identify` finds, step by step."""

    def __init__(self) -> None:
        self._line: ProgressLine | StartsLine | None = None

    def say(self, text: str) -> None:
        """Print a sentence."""
        print(in_lines(text), flush=True)

    def searching(self) -> None:
        """Show a progress line during the search for sizes."""

    def begin(
        self, dataset: Dataset, settings: Settings, linear: LinearModel, models: Sequence[Model]
    ) -> Watching:
        """Show a progress line; with several starts, one line for each round stays."""
        count = len(models)
        if count == 1:
            self._line = ProgressLine()
            return Watching([[self._line]], lambda _: None)
        planned = schedule(count, settings.trainer.limit, settings.average)
        unit = common_unit(models[0].outputs)
        self._line = lines = StartsLine(count, unit, iterations=iterations_of(planned))
        return Watching([[lines]] * count, lines.round)

    def end(self, result: FitResult) -> None:
        """End the progress line."""
        self.close()

    def close(self) -> None:
        """End the progress line, if there is one."""
        if self._line is not None:
            self._line.close()
        self._line = None
