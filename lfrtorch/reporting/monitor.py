"""What a user sees while a fit runs, a progress line and TensorBoard, and what is left of it."""

from __future__ import annotations

import copy
import io
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from time import monotonic
from typing import TextIO

from matplotlib.figure import Figure
from PIL import Image
from tensorboard.compat.proto.summary_pb2 import Summary
from torch.utils.tensorboard import SummaryWriter

from lfrtorch.engine.simulation import spectral_radius
from lfrtorch.fitting.multistart import ROUNDS, Round
from lfrtorch.fitting.trainer import Progress
from lfrtorch.model import Model
from lfrtorch.records import Record
from lfrtorch.reporting import plots


class ProgressLine:
    """One live line on a terminal; elsewhere a line now and then.

    Args:
        every: iterations between lines if the output is not a terminal.
        stream: where to write; Default: standard output.

    Example:
        >>> from lfrtorch.reporting.monitor import ProgressLine
        >>> line, trainer = ProgressLine(every=2), lfrtorch.LevenbergMarquardt(max_iter=3)
        >>> result = lfrtorch.fit(model, record, trainer=trainer, monitors=[line])
        0/3  train ...
        2/3  train ...
        >>> line.close()
        3/3  train ...
    """

    def __init__(self, every: int = 10, stream: TextIO | None = None) -> None:
        self.every = every
        self.stream = sys.stdout if stream is None else stream
        self._unseen = ""

    def __call__(self, model: Model, progress: Progress) -> None:
        """Show the progress."""
        live = self.stream.isatty()
        text = progress_text(progress, model.outputs[0].unit)
        shown = live or progress.iteration % self.every == 0
        self._unseen = "" if shown else text + "\n"
        if shown:
            self.stream.write(f"\r{text}\033[K" if live else text + "\n")
            self.stream.flush()

    def close(self) -> None:
        """End the live line; elsewhere show the last iteration."""
        self.stream.write("\n" if self.stream.isatty() else self._unseen)


def progress_text(progress: Progress, unit: str) -> str:
    """Iteration, errors (a star marks the best so far), optimiser's scalars, time left."""
    parts = [
        f"{progress.iteration:>{len(str(progress.limit))}}/{progress.limit}",
        f"train {progress.train:.3e} {unit}".rstrip(),
    ]
    if not math.isnan(progress.validation):
        star = "*" if progress.best else " "
        parts.append(f"validation {progress.validation:.3e} {unit}".rstrip() + star)
    shown = {"damping": "damping", "gain_ratio": "gain", "gradient_norm": "|gradient|"}
    for key, label in shown.items():
        if key in progress.report and math.isfinite(progress.report[key]):
            parts.append(f"{label} {progress.report[key]:.2g}")
    if progress.iteration:
        parts.append(f"{progress.seconds_left:.0f} s left")
    return "  ".join(parts)


class StartsLine:
    """A line for each round of several starts; on a terminal the count of iterations between.

    Args:
        starts: how many there are.
        unit: of the errors.
        stream: where to write; Default: standard output.

    Example:
        >>> from lfrtorch.reporting.monitor import StartsLine
        >>> models = [lfrtorch.initialise(bla, record, nz=1, nw=1, nn=4, seed=i) for i in range(4)]
        >>> line, trainer = StartsLine(4), lfrtorch.LevenbergMarquardt(max_iter=16)
        >>> result = lfrtorch.fit(
        ...     models, record, trainer=trainer, monitors=[[line]] * 4, watch=line.round
        ... )
        round 1 of 3: 4 start(s) to iteration 1, best ...
        round 2 of 3: 2 start(s) to iteration 2, best ...
        round 3 of 3: 2 start(s) to iteration 16, best ...
    """

    def __init__(self, starts: int, unit: str = "", stream: TextIO | None = None) -> None:
        self.starts, self.unit, self._count = starts, unit, 0
        self.stream = sys.stdout if stream is None else stream

    def __call__(self, model: Model, progress: Progress) -> None:
        """Count an iteration of any of the starts."""
        self._count += 1
        if self.stream.isatty():
            self.stream.write(f"\r{self._count} iterations of {self.starts} starts\033[K")
            self.stream.flush()

    def round(self, ended: Round) -> None:
        """Show a round that has ended."""
        judged = [(s.selection, s.validation, s.train) for s in ended.starts]
        errors = [next(e for e in each if not math.isnan(e)) for each in judged]
        numbers = {"best": errors[0], "median": median(errors), "worst": max(errors)}
        text = (
            f"round {ended.number} of {ended.count}: {len(errors)} start(s) to iteration "
            f"{max(s.iterations for s in ended.starts)}, "
            + ", ".join(f"{name} {value:.3e}" for name, value in numbers.items())
        )
        text = f"{text} {self.unit}".rstrip() + f", {ended.seconds:.0f} s"
        self.stream.write(f"\r{text}\033[K\n" if self.stream.isatty() else text + "\n")
        self.stream.flush()


class TensorBoard:
    """Scalars of every iteration, and figures of the validation record now and then.

    The file is made at the first iteration that is written. It replaces what earlier files in the
    folder have of this and later iterations: a fit that goes on has each of them once.

    Args:
        folder: of the event file.
        record: record whose output and static map are drawn, usually the validation record; left
            out for scalars alone.
        y_linear: output of the linear model on it, (T, ny), for the error beside ours.
        every: iterations between figures; they cost about half a second.
        finalist: whether nothing is written before the last round of a fit from several starts, so
            that starts that others end leave no run.

    Example:
        >>> from lfrtorch.reporting.monitor import TensorBoard
        >>> board, trainer = TensorBoard("board"), lfrtorch.LevenbergMarquardt(max_iter=2)
        >>> result = lfrtorch.fit(model, record, trainer=trainer, monitors=[board])
        >>> board.close()  # tensorboard --logdir board
    """

    def __init__(
        self,
        folder: str | Path,
        record: Record | None = None,
        y_linear: plots.Array | None = None,
        every: int = 50,
        *,
        finalist: bool = False,
    ) -> None:
        self.folder, self.finalist = Path(folder), finalist
        self.record, self.y_linear, self.every = record, y_linear, every
        self._writer: SummaryWriter | None = None
        self._waiting: list[tuple[Progress, float]] = []

    @property
    def begun(self) -> bool:
        """Whether something is written."""
        return self._writer is not None

    def history(self, history: Sequence[Progress]) -> None:
        """Log iterations of the past."""
        for progress in history:
            writer, step = self._from(progress.iteration), progress.iteration
            writer.add_scalar("rmse/train", progress.train, step)
            if not math.isnan(progress.validation):
                writer.add_scalar("rmse/validation", progress.validation, step)
            for name, value in progress.report.items():
                writer.add_scalar(f"search/{name}", value, step)

    def __call__(self, model: Model, progress: Progress) -> None:
        """Log one iteration."""
        step = progress.iteration
        self._waiting.append((progress, float(spectral_radius(model.lfr.cell.A.detach()))))
        if self.finalist and step <= math.ceil(ROUNDS[-1] * progress.limit):
            return
        for one, radius in self._waiting:
            self.history([one])
            self._from(step).add_scalar("stability/spectral_radius_A", radius, one.iteration)
        self._waiting = []
        if self.record is not None and self.y_linear is not None and step % self.every == 0:
            y_hat, signals = model.simulate(self.record), model.signals(self.record)
            self.figure("signals/response", plots.response(self.record, self.y_linear, y_hat), step)
            drawn = plots.static_map(signals.z[0].numpy(), signals.w[0].numpy())
            self.figure("signals/static_map", drawn, step)

    def figure(self, name: str, figure: Figure, step: int) -> None:
        """Add a figure."""
        self.image(name, plots.png(figure), step)

    def image(self, name: str, png: bytes, step: int) -> None:
        """Add a figure that is drawn already."""
        width, height = Image.open(io.BytesIO(png)).size
        image = Summary.Image(
            encoded_image_string=png, width=width, height=height, colorspace=len("RGB")
        )
        summary = Summary(value=[Summary.Value(tag=name, image=image)])
        file = self._from(step).file_writer
        assert file is not None
        file.add_summary(summary, step)

    def text(self, name: str, text: str, step: int = 0) -> None:
        """Add a text in a fixed-width font."""
        shown = "\n".join("    " + line for line in text.splitlines())
        self._from(step).add_text(name, shown, step)

    def close(self) -> None:
        """Write what is pending."""
        if self._writer is not None:
            self._writer.close()

    def _from(self, step: int) -> SummaryWriter:
        """The writer, made at the first step."""
        if self._writer is None:
            self._writer = SummaryWriter(str(self.folder), purge_step=step)
        return self._writer


class Checkpoint:
    """The best iterate so far as a checkpoint on disk: what is left of a run that is killed.

    One may be called by several starts of a fit: it keeps the best of all.

    Args:
        folder: of the checkpoint.
        every: least seconds between two of them, the first is that of the start.
        least: score that an iterate must beat, that of the checkpoint there.

    Example:
        >>> from lfrtorch.reporting.monitor import Checkpoint
        >>> keep, trainer = Checkpoint("best", every=0), lfrtorch.LevenbergMarquardt(max_iter=5)
        >>> result = lfrtorch.fit(model, record, trainer=trainer, monitors=[keep])
        >>> np.array_equal(lfrtorch.load("best").simulate(record), model.simulate(record))
        True
    """

    def __init__(self, folder: str | Path, every: float = 5.0, least: float = math.inf) -> None:
        self.folder, self.every = Path(folder), every
        self._due, self._least = -math.inf, least
        self._unwritten: Model | None = None

    def __call__(self, model: Model, progress: Progress) -> None:
        """Keep the iterate if it is the best; write the best one when it is time."""
        if progress.best and progress.score < self._least:
            self._unwritten, self._least = copy.deepcopy(model), progress.score
        if self._unwritten is not None and monotonic() >= self._due:
            self._unwritten.save(self.folder)
            self._unwritten, self._due = None, monotonic() + self.every
