"""A line that shows the progress of a fit and is rewritten in place."""

from __future__ import annotations

import math
import os
import shutil
import sys
from importlib import import_module
from statistics import median
from time import monotonic
from typing import TextIO

from lfrtorch._support.tables import quantities
from lfrtorch.data.records import common_unit
from lfrtorch.fitting.trainer import Progress, Round
from lfrtorch.model.model import Model

_DIGITS = 4  # significant digits of errors: an iteration often changes only the fourth digit


class LiveLine:
    """A line on a terminal or in a notebook that the next text replaces; elsewhere nothing."""

    def __init__(self, stream: TextIO | None = None) -> None:
        self.stream = sys.stdout if stream is None else stream  # None without a console
        self._in_cell = type(self.stream).__module__.startswith("ipykernel.")
        clever = os.environ.get("TERM") != "dumb"
        terminal = clever and self.stream is not None and self.stream.isatty()
        self.live = self._in_cell or terminal
        self._length, self._cell = 0, None

    def show(self, text: str) -> None:
        """Replace the line; the last parts are left out if the terminal is too narrow."""
        if self._in_cell:
            # Texts written to a stream would all stay in a saved notebook.
            display = import_module("IPython.display").display
            if self._cell is None:
                self._cell = display({"text/plain": text}, raw=True, display_id=True)
            else:
                self._cell.update({"text/plain": text}, raw=True)
        elif self.live:
            width = shutil.get_terminal_size().columns - 1  # a line of full width would wrap
            while len(text) > width and "  " in text.rstrip():
                text = text.rstrip().rpartition("  ")[0]
            self._write(f"\r{text[:width].ljust(self._length)}")
            self._length = len(text[:width])

    def say(self, text: str) -> None:
        """Replace the line by a text that stays."""
        start = "\r" if self._length else ""
        self._write(f"{start}{text.ljust(self._length)}\n")
        self._length = 0

    def close(self, *, keep: bool = True) -> None:
        """End the line, if there is one, or erase it if ``keep`` is False."""
        if self._length:
            self._write("\n" if keep else f"\r{' ' * self._length}\r")
        self._length, self._cell = 0, None

    def _write(self, text: str) -> None:
        if self.stream is not None:
            self.stream.write(text)
            self.stream.flush()


class ProgressLine:
    """A line that shows the progress of a fit, or a new line now and then if none can be rewritten.

    Args:
        every: iterations between lines on a stream that cannot rewrite them; None: no lines there.
        stream: stream to write to. Default: standard output.

    Example:
        >>> from lfrtorch.fitting.live_line import ProgressLine
        >>> line, trainer = ProgressLine(every=2), lfrtorch.LevenbergMarquardt(max_iter=3)
        >>> result = lfrtorch.fit(model, record, trainer=trainer, monitors=[line])
        0/3  train ...
        2/3  train ...
        >>> line.close()
        3/3  train ...
    """

    def __init__(self, every: int | None = 10, stream: TextIO | None = None) -> None:
        self._every, self._line, self._unseen = every, LiveLine(stream), ""
        self._best: Progress | None = None

    def __call__(self, model: Model, progress: Progress) -> None:
        """Show the progress."""
        self._best = progress if progress.best else self._best
        text = _progress_text(progress, common_unit(model.outputs), self._best)
        self._line.show(text)
        if not self._line.live and self._every is not None:
            self._unseen = text
            if progress.iteration % self._every == 0:
                self.close()

    def close(self) -> None:
        """End the line; if the stream cannot rewrite lines, show the last iteration."""
        self._line.close()
        if self._unseen:
            self._line.say(self._unseen)
        self._unseen = ""


def _progress_text(progress: Progress, unit: str, best: Progress | None = None) -> str:
    """Write iteration, errors, the best error so far, time left and scalars of the trainer."""
    limit = str(progress.limit)
    parts = [f"{progress.iteration:>{len(limit)}}/{limit}", *_errors(progress, unit)]
    if progress.best and not math.isnan(progress.validation):
        parts[-1] += "*"
    elif best is not None and not math.isnan(best.validation):
        (least,) = quantities([best.validation], unit, _DIGITS)
        parts[-1] += f" (best {least})"
    if progress.iteration:
        parts.append(f"{_duration(progress.seconds_left)} left")
    shown = {"damping": "damping", "gain_ratio": "gain", "gradient_norm": "|gradient|"}
    for key, label in shown.items():
        if math.isfinite(value := progress.report.get(key, math.nan)):
            parts.append(f"{label} {value:.2g}")
    return "  ".join(parts)


def _errors(progress: Progress, unit: str) -> list[str]:
    """Write the training error and, if there is one, the validation error."""
    train, validation = quantities([progress.train, progress.validation], unit, _DIGITS)
    if math.isnan(progress.validation):
        return [f"train {train}"]
    return [f"train {train}", f"validation {validation}"]


def _duration(seconds: float) -> str:
    """Write a duration as 45 s, 5 min or 2 h 05 min."""
    minutes = round(seconds / 60)
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"


def errors_of_round(ended: Round) -> dict[str, float]:
    """The best of the starts' errors; for several starts, also the median and the worst."""
    judged = [(s.selection, s.validation, s.train) for s in ended.starts]
    found = [next(e for e in each if not math.isnan(e)) for each in judged]
    numbers = {"best": found[0], "median": median(found), "worst": max(found)}
    kept = ["best", *["median"] * (len(found) > 2), *["worst"] * (len(found) > 1)]
    return {name: numbers[name] for name in kept}


class StartsLine:
    """A line that shows the progress of several starts, and a line for each of their rounds.

    Args:
        starts: number of starts.
        unit: unit of the errors.
        stream: stream to write to. Default: standard output.
        iterations: number of iterations of all starts together, for the time left.

    Example:
        >>> from lfrtorch.fitting.live_line import StartsLine
        >>> models = [lfrtorch.initialise(bla, record, nz=1, nw=1, nn=4, seed=i) for i in range(4)]
        >>> line, trainer = StartsLine(4, iterations=36), lfrtorch.LevenbergMarquardt(max_iter=16)
        >>> result = lfrtorch.fit(
        ...     models, record, trainer=trainer, monitors=[[line]] * 4, watch=line.round
        ... )
        round 1 of 3: 4 start(s) to iteration 1, best ...
        round 2 of 3: 2 start(s) to iteration 2, best ...
        round 3 of 3: 2 start(s) to iteration 16, best ...
    """

    def __init__(
        self, starts: int, unit: str = "", stream: TextIO | None = None, *, iterations: int
    ) -> None:
        self._starts, self._unit, self._all = starts, unit, iterations
        self._line, self._clock = LiveLine(stream), monotonic()
        self._iterations: dict[int, int] = {}
        self._best: Progress | None = None

    def __call__(self, model: Model, progress: Progress) -> None:
        """Count the iterations of all starts."""
        self._iterations[id(model)] = progress.iteration
        count = sum(self._iterations.values())
        if self._best is None or progress.score < self._best.score:
            self._best = progress
        parts = [f"{count}/{self._all} iterations of {self._starts} starts"]
        parts += _errors(progress, self._unit)
        parts.append(f"best {_errors(self._best, self._unit)[-1]}")
        if 0 < count < self._all:
            each = (monotonic() - self._clock) / count
            parts.append(f"{_duration(each * (self._all - count))} left")
        self._line.show("  ".join(parts))

    def round(self, ended: Round) -> None:
        """Show a round that has ended."""
        numbers = errors_of_round(ended)
        shown = quantities([*numbers.values()], self._unit, _DIGITS)
        errors = ", ".join(f"{name} {value}" for name, value in zip(numbers, shown, strict=True))
        self._line.say(
            f"round {ended.number} of {ended.count}: {len(ended.starts)} start(s) to iteration "
            f"{max(s.iterations for s in ended.starts)}, {errors}, {ended.seconds:.0f} s"
        )

    def close(self) -> None:
        """End the line, if there is one."""
        self._line.close()
