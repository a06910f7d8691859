"""The whole identification: records, linear model, sizes, starts, fit, scores and advice."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from typing import Any

from lfrtorch._support.arguments import typed
from lfrtorch._support.errors import InputError
from lfrtorch._support.frames import is_frame
from lfrtorch.data.dataset import Dataset
from lfrtorch.data.records import Record
from lfrtorch.distributed import Ranks, using
from lfrtorch.files.split import cut
from lfrtorch.fitting.observer import LineObserver, Observer
from lfrtorch.fitting.settings import Settings
from lfrtorch.fitting.snapshots import Snapshots
from lfrtorch.fitting.stage import Job
from lfrtorch.fitting.stages import STAGES
from lfrtorch.fitting.trainer import Stop
from lfrtorch.linear.record_start import decided
from lfrtorch.reporting.run import Run
from lfrtorch.reporting.scored_run import scored_run

_CUT = 0.2, 0.2
"""Fractions of a record for validation and test."""


@typed("dataset")
def identify(
    dataset: Dataset | Record | Sequence[Record],
    settings: Settings,
    *,
    observer: Observer | None = None,
    snapshots: Snapshots | None = None,
    ranks: Ranks | None = None,
    stop: Stop | None = None,
) -> Run:
    """Identify a nonlinear LFR model, from records to scores.

    Args:
        dataset: records by use. Or one or several records, each cut in time: the first 60 % are
            fitted, the next 20 % choose the iterate, and the last 20 % are the test.
        settings: sizes, starts and trainer.
        observer: object whose methods are called at every step. Default: it shows a progress line.
            :class:`lfrtorch.reporting.Console` prints every step, :class:`Observer` prints nothing.
        snapshots: store of the state of the starts, from which a later program continues.
        ranks: processes that share the starts or the training records, see :func:`lfrtorch.fit`.
        stop: function that is called before each iteration; if it returns True, the fit ends and
            keeps the best iterate so far.

    Returns:
        The models, their scores and the numbers that were chosen. If the fit was interrupted, or a
        process was lost, the model is the best iterate so far, and ``run.fit.reason`` says so.

    Raises:
        ValueError: settings or records do not fit together.
        StoppedError: ``stop`` or Ctrl-C ended the search for sizes.
        ProcessLostError: one of the processes was lost before the fit itself.

    Example:
        >>> u = np.random.default_rng(0).standard_normal(600)
        >>> y = np.zeros(600)
        >>> for k in range(599):
        ...     y[k + 1] = 0.7 * y[k] + np.tanh(u[k])
        >>> parts = [lfrtorch.Record(u[p], y[p], name=name, skip=20) for name, p in
        ...     (("train", slice(0, 400)), ("test", slice(400, 600)))]
        >>> dataset = lfrtorch.Dataset("saturation", parts[:1], [], parts[1:])
        >>> settings = lfrtorch.Settings(nx=1, nz=1, nn=4,
        ...     trainer=lfrtorch.LevenbergMarquardt(max_iter=20))
        >>> run = lfrtorch.identify(dataset, settings)
        >>> score = run.metrics["scores"]["test"]
        >>> score["rmse"] < score["lti_rmse"]
        True
    """
    with using(ranks) as processes:
        dataset = decided(_by_use(dataset))
        if observer is None:
            observer = LineObserver() if processes.rank == 0 else Observer()
        job = Job(
            given=dataset,
            dataset=dataset.with_windows(),
            settings=settings,
            observer=observer,
            stop=stop,
            snapshots=snapshots,
        )
        with closing(observer):
            for stage in STAGES:
                stage.check(job)
            for stage in STAGES:
                if stage.when(job):
                    job = stage.run(job)
            return scored_run(job)


def _by_use(given: Any) -> Dataset:
    """The dataset as it is; from records, a dataset of their parts, each record cut in time."""
    if isinstance(given, Dataset):
        return given
    records = [given] if isinstance(given, Record) else given
    if (
        not isinstance(records, list | tuple)
        or not records
        or not all(isinstance(record, Record) for record in records)
    ):
        means = "; lfrtorch.load_records(df, inputs=..., outputs=...) makes a Dataset"
        raise InputError(
            "identify takes a Record, or a Dataset('mine', train=[...], validation=[...], "
            f"tests=[...]), and not {type(given).__name__}{means if is_frame(given) else ''}."
        )
    parts = [cut(record, *_CUT) for record in records]
    found = {use: [part[use] for part in parts] for use in ("train", "validation", "test")}
    if len(records) == 1:
        found = {use: [replace(part, name=use) for part in own] for use, own in found.items()}
    return Dataset(records[0].name, found["train"], found["validation"], found["test"])
