"""Monitors that write while a fit runs: TensorBoard and checkpoints."""

from __future__ import annotations

import copy
import io
import math
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from time import monotonic, sleep, time
from typing import Any

from matplotlib.figure import Figure
from PIL import Image
from tensorboard.compat.proto.summary_pb2 import Summary
from torch.utils.tensorboard import FileWriter, SummaryWriter
from torch.utils.tensorboard.summary import hparams

from lfrtorch._support.errors import InputError
from lfrtorch.analysis.model_plots import static_figure
from lfrtorch.data.records import Record
from lfrtorch.engine.simulation import spectral_radius
from lfrtorch.fitting.live_line import errors_of_round
from lfrtorch.fitting.multistart import ROUNDS
from lfrtorch.fitting.trainer import Progress, Round
from lfrtorch.model.model import Model
from lfrtorch.reporting import plots


class TensorBoard:
    """Writer of the scalars of every iteration, and of figures of a record now and then."""

    # The file is made at the first iteration that is written. It replaces this and later iterations
    # of earlier files in the folder, so that a fit that goes on has each iteration once.

    def __init__(
        self,
        folder: str | Path,
        record: Record | None = None,  # its output and static map are drawn
        y_linear: plots.Array | None = None,  # the linear model's output on this record, (T, ny)
        every: int = 50,  # iterations between figures, which cost about half a second
        *,
        finalist: bool = False,  # write nothing before the last round of several starts
        say: Callable[[str], None] = warnings.warn,  # called once if the file cannot be written
    ) -> None:
        self.folder, self.finalist, self._say = Path(folder), finalist, say
        self.record, self.y_linear, self.every = record, y_linear, every
        self._writer: SummaryWriter | None = None
        self._failed = False
        self._waiting: list[tuple[Progress, float]] = []

    @property
    def begun(self) -> bool:
        """True if something is written."""
        return self._writer is not None

    def history(self, history: Sequence[Progress]) -> None:
        """Log past iterations."""
        for progress in history:
            self._write(progress.iteration, lambda writer, one=progress: _add(writer, one))

    def __call__(self, model: Model, progress: Progress) -> None:
        """Log one iteration."""
        step = progress.iteration
        self._waiting.append((progress, float(spectral_radius(model.lfr.cell.A.detach()))))
        if self.finalist and step <= math.ceil(ROUNDS[-1] * progress.limit):
            return
        for one, radius in self._waiting:
            self.history([one])
            self._scalar("stability/spectral_radius_A", radius, one.iteration)
        self._waiting = []
        if self.record is not None and self.y_linear is not None and step % self.every == 0:
            simulated = {"linear": self.y_linear, "NL-LFR": model.simulate(self.record)}
            self.figure("signals/response", plots.response(self.record, simulated), step)
            with suppress(InputError):  # a linear model, or one that diverges
                self.figure("signals/static_map", static_figure(model, self.record), step)

    def round(self, ended: Round) -> None:
        """Log the errors of several starts after a round."""
        step = max(start.iterations for start in ended.starts)
        for name, error in errors_of_round(ended).items():
            self._scalar(f"starts/{name}", error, step)

    def figure(self, name: str, figure: Figure, step: int) -> None:
        """Add a figure."""
        self.image(name, plots.png(figure), step)

    def image(self, name: str, png: bytes, step: int) -> None:
        """Add a figure that is already a PNG file."""
        width, height = Image.open(io.BytesIO(png)).size
        image = Summary.Image(
            encoded_image_string=png, width=width, height=height, colorspace=len("RGB")
        )
        summary = Summary(value=[Summary.Value(tag=name, image=image)])
        self._write(step, lambda writer: _file(writer).add_summary(summary, step))

    def text(self, name: str, text: str, step: int = 0) -> None:
        """Add a text in a fixed-width font."""
        shown = "\n".join("    " + line for line in text.splitlines())
        self._write(step, lambda writer: writer.add_text(name, shown, step))

    def hyperparameters(
        self, settings: Mapping[str, Any], found: Mapping[str, float | None], step: int
    ) -> None:
        """Add the run to the page HParams, where many runs are compared."""
        shown = {k: v for k, v in settings.items() if isinstance(v, bool | int | float | str)}
        values = {f"total/{k}": v for k, v in found.items() if v is not None}
        for summary in hparams(shown, values):
            self._write(step, lambda writer, one=summary: _file(writer).add_summary(one))
        for name, value in values.items():
            self._scalar(name, value, step)

    def close(self) -> None:
        """Write all pending events and close the file."""
        if self.begun:
            self._write(0, lambda writer: writer.close())

    def _scalar(self, name: str, value: float, step: int) -> None:
        self._write(step, lambda writer: writer.add_scalar(name, value, step))

    def _write(self, step: int, write: Callable[[SummaryWriter], None]) -> None:
        """Write with the writer, which is made at the first step; do nothing after a failure."""
        if self._failed:
            return
        try:
            if self._writer is None:
                _wait_for_a_later_name(self.folder)
                self._writer = SummaryWriter(str(self.folder), purge_step=step)
            write(self._writer)
        except OSError as error:
            self._failed = True
            self._say(
                f"TensorBoard's file in '{self.folder}' cannot be written "
                f"({error.strerror or error}); the fit goes on without it"
            )


def _wait_for_a_later_name(folder: Path) -> None:
    """Wait until the second is over in which the last file was made."""
    # TensorBoard reads files in the order of their names, which begin with the second. Within the
    # same second, file 10 of a process would come before its file 9.
    end = monotonic() + 1.5  # even if the clock is set
    while monotonic() < end and any(folder.glob(f"events.out.tfevents.{int(time())}.*")):
        sleep(0.02)


def _add(writer: SummaryWriter, progress: Progress) -> None:
    """The scalars of an iteration."""
    step = progress.iteration
    writer.add_scalar("rmse/train", progress.train, step)
    if not math.isnan(progress.validation):
        writer.add_scalar("rmse/validation", progress.validation, step)
    for name, value in progress.report.items():
        writer.add_scalar(f"search/{name}", value, step)


def _file(writer: SummaryWriter) -> FileWriter:
    """Writer of finished summaries."""
    assert writer.file_writer is not None
    return writer.file_writer


@contextmanager
def quiet_writers() -> Iterator[None]:
    """Inside, TensorBoard's thread prints no traceback of a full disk, which ``say`` tells."""
    usual = threading.excepthook

    def hook(failed: threading.ExceptHookArgs) -> None:
        if not (issubclass(failed.exc_type, OSError) and "AsyncWriter" in repr(failed.thread)):
            usual(failed)

    threading.excepthook = hook
    try:
        yield
    finally:
        threading.excepthook = usual


class Checkpoint:
    """Writer of the best iterate of all starts so far, so that a killed run leaves a model."""

    def __init__(
        self,
        folder: str | Path,
        every: float = 5.0,  # smallest number of seconds between two files
        least: float = math.inf,  # score that an iterate must beat
    ) -> None:
        self.folder, self.every = Path(folder), every
        self._due, self._least = -math.inf, least
        self._unwritten: Model | None = None

    def __call__(self, model: Model, progress: Progress) -> None:
        """Keep the iterate if it is the best so far; write the best one when it is due."""
        if progress.best and progress.score < self._least:
            self._unwritten, self._least = copy.deepcopy(model), progress.score
        if self._unwritten is not None and monotonic() >= self._due:
            self._unwritten.save(self.folder)
            self._unwritten, self._due = None, monotonic() + self.every
