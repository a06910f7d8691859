"""One line that follows a fit, rewritten in place."""

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
from lfrtorch.fitting.trainer import Progress, Round
from lfrtorch.model import Model
from lfrtorch.records import common_unit

DIGITS = 4
"""Significant digits of errors, of which an iteration often moves the fourth alone."""


def is_notebook(stream: TextIO | None) -> bool:
    """Whether the stream is the output of a cell."""
    return type(stream).__module__.startswith("ipykernel.")


def is_live(stream: TextIO | None) -> bool:
    """Whether a line can be rewritten there: on a terminal, if it is not dumb, and in a notebook.

    Example:
        >>> import io
        >>> from lfrtorch.fitting.live_line import is_live
        >>> is_live(io.StringIO())
        False
    """
    if stream is None:  # a program without a console
        return False
    return is_notebook(stream) or (stream.isatty() and os.environ.get("TERM") != "dumb")


class LiveLine:
    """A line that the next text replaces; nothing is shown if the stream cannot rewrite a line.

    Args:
        stream: where to write. Default: standard output.

    Example:
        >>> from lfrtorch.fitting.live_line import LiveLine
        >>> line = LiveLine()
        >>> line.show("1/3  train 0.5 V")  # which is seen on a terminal
        >>> line.say("the fit has converged")
        the fit has converged
    """

    def __init__(self, stream: TextIO | None = None) -> None:
        self.stream = sys.stdout if stream is None else stream
        self.live, self._length, self._cell = is_live(self.stream), 0, None

    def show(self, text: str) -> None:
        """Replace the line; parts that are too many for the terminal's width are left out."""
        if not self.live:
            return
        if is_notebook(self.stream):
            self._show_in_cell(text)
            return
        width = shutil.get_terminal_size().columns - 1  # a full line would break
        while len(text) > width and "  " in text.rstrip():
            text = text.rstrip().rpartition("  ")[0]
        self._write(f"\r{text[:width].ljust(self._length)}")
        self._length = len(text[:width])

    def say(self, text: str) -> None:
        """Replace the line by one that stays."""
        start = "\r" if self._length else ""
        self._write(f"{start}{text.ljust(self._length)}\n")
        self._length = 0

    def clear(self) -> None:
        """Take the line away, for another one."""
        if self._length:
            self._write(f"\r{' ' * self._length}\r")
        self._length, self._cell = 0, None

    def close(self) -> None:
        """End the line, if there is one, so that what is printed next has its own."""
        if self._length:
            self._write("\n")
        self._length, self._cell = 0, None

    def _write(self, text: str) -> None:
        if self.stream is not None:
            self.stream.write(text)
            self.stream.flush()

    def _show_in_cell(self, text: str) -> None:
        """In place of the text before: of a stream a saved notebook would keep all of them."""
        display = import_module("IPython.display").display  # there is a notebook
        shown = {"text/plain": text}
        if self._cell is None:
            self._cell = display(shown, raw=True, display_id=True)
        else:
            self._cell.update(shown, raw=True)


class ProgressLine:
    """A line that follows a fit, or a line now and then if the stream cannot rewrite one.

    Args:
        every: iterations between lines if none can be rewritten; ``None`` for none at all.
        stream: where to write. Default: standard output.

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
        self.every, self._line, self._unseen = every, LiveLine(stream), ""

    def __call__(self, model: Model, progress: Progress) -> None:
        """Show the progress."""
        text = progress_text(progress, common_unit(model.outputs))
        self._line.show(text)
        if self._line.live or self.every is None:
            return
        self._unseen = text
        if progress.iteration % self.every == 0:
            self._say()

    def close(self) -> None:
        """End the line; if the stream cannot rewrite one, show the last iteration."""
        self._line.close()
        self._say()

    def _say(self) -> None:
        if self._unseen:
            self._line.say(self._unseen)
        self._unseen = ""


def progress_text(progress: Progress, unit: str) -> str:
    """Iteration, errors (a star marks the best so far), time left, optimiser's scalars."""
    parts = [
        f"{progress.iteration:>{len(str(progress.limit))}}/{progress.limit}",
        *errors(progress.train, progress.validation, unit, best=progress.best),
    ]
    if progress.iteration:
        parts.append(f"{duration(progress.seconds_left)} left")
    shown = {"damping": "damping", "gain_ratio": "gain", "gradient_norm": "|gradient|"}
    for key, label in shown.items():
        if key in progress.report and math.isfinite(progress.report[key]):
            parts.append(f"{label} {progress.report[key]:.2g}")
    return "  ".join(parts)


def errors(train: float, validation: float, unit: str, *, best: bool = False) -> list[str]:
    """The errors on training and, if there is one, validation; a star marks the best so far."""
    shown = quantities([train, validation], unit, DIGITS)
    parts = [f"train {shown[0]}"]
    if not math.isnan(validation):
        parts.append(f"validation {shown[1]}" + ("*" if best else ""))
    return parts


def duration(seconds: float) -> str:
    """A time for people.

    Example:
        >>> from lfrtorch.fitting.live_line import duration
        >>> duration(45.2), duration(312.0), duration(7500.0)
        ('45 s', '5 min', '2 h 05 min')
    """
    minutes = round(seconds / 60)
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"


class StartsLine:
    """A line that follows all iterations of several starts, and a line for each of their rounds.

    Args:
        starts: how many there are.
        unit: of the errors.
        stream: where to write. Default: standard output.
        iterations: of all starts together, for the time left.
        rounds: whether a round gets a line that stays.

    Example:
        >>> from lfrtorch.fitting.live_line import StartsLine
        >>> models = [lfrtorch.initialise(bla, record, nz=1, nw=1, nn=4, seed=i) for i in range(4)]
        >>> line, trainer = StartsLine(4), lfrtorch.LevenbergMarquardt(max_iter=16)
        >>> result = lfrtorch.fit(
        ...     models, record, trainer=trainer, monitors=[[line]] * 4, watch=line.round
        ... )
        round 1 of 3: 4 start(s) to iteration 1, best ...
        round 2 of 3: 2 start(s) to iteration 2, best ...
        round 3 of 3: 2 start(s) to iteration 16, best ...
    """

    def __init__(
        self,
        starts: int,
        unit: str = "",
        stream: TextIO | None = None,
        *,
        iterations: int | None = None,
        rounds: bool = True,
    ) -> None:
        self.starts, self.unit, self.iterations, self.rounds = starts, unit, iterations, rounds
        self._line, self._clock = LiveLine(stream), monotonic()
        self._iterations: dict[int, int] = {}
        self._best: Progress | None = None

    def __call__(self, model: Model, progress: Progress) -> None:
        """Count the iterations of all starts."""
        self._iterations[id(model)] = progress.iteration
        count = sum(self._iterations.values())
        if self._best is None or progress.score < self._best.score:
            self._best = progress
        total = "" if self.iterations is None else f"/{self.iterations}"
        parts = [f"{count}{total} iterations of {self.starts} starts"]
        parts += errors(self._best.train, self._best.validation, self.unit)
        if self.iterations is not None and 0 < count < self.iterations:
            each = (monotonic() - self._clock) / count
            parts.append(f"{duration(each * (self.iterations - count))} left")
        self._line.show("  ".join(parts))

    def round(self, ended: Round) -> None:
        """Show a round that has ended."""
        if not self.rounds:
            return
        judged = [(s.selection, s.validation, s.train) for s in ended.starts]
        found = [next(e for e in each if not math.isnan(e)) for each in judged]
        numbers = {"best": found[0]}
        if len(found) > 2:
            numbers["median"] = median(found)
        if len(found) > 1:
            numbers["worst"] = max(found)
        shown = quantities(list(numbers.values()), self.unit, DIGITS)
        text = (
            f"round {ended.number} of {ended.count}: {len(found)} start(s) to iteration "
            f"{max(s.iterations for s in ended.starts)}, "
            + ", ".join(f"{name} {value}" for name, value in zip(numbers, shown, strict=True))
        )
        self._line.say(f"{text}, {ended.seconds:.0f} s")

    def close(self) -> None:
        """End the line, if there is one."""
        self._line.close()
