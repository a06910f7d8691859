"""Stages of an identification: steps before a fit, fits, and steps after a fit.

A stage that is a fit defines when it runs, its models, data and trainer, and what it keeps:

    class Reweighted(Stage):
        name = "the fit to records weighted by their errors"

        def models(self, job):
            return [job.result.model]

        def data(self, job):
            return Data([replace(r, weight=...) for r in job.dataset.train])

        def keep(self, job, result):
            return replace(job, result=replace(job.result, model=result.model))

A stage before ``WholeFit`` sets ``models``, where the fit begins. A stage after it goes on from
``result``. A stage that is not a fit overrides ``run``. ``stages.STAGES`` lists all stages in their
order; a new stage needs no other entry.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from lfrtorch._support.reasons import CUT_SHORT
from lfrtorch.data.dataset import Dataset
from lfrtorch.data.records import Record
from lfrtorch.fitting.choice import Choice
from lfrtorch.fitting.multistart import fit
from lfrtorch.fitting.observer import Observer
from lfrtorch.fitting.settings import Settings
from lfrtorch.fitting.snapshots import Snapshots
from lfrtorch.fitting.trainer import FitResult, Stop, StoppedError, Trainer
from lfrtorch.least_squares.ridge import Ridge
from lfrtorch.linear.model import LinearModel
from lfrtorch.linear.order_scan import OrderScan
from lfrtorch.model.model import Model

_LATER: Any = None
"""Placeholder for a field that a later stage sets."""


@dataclass(frozen=True, kw_only=True)
class Job:
    """The state of an identification; its settings include the values chosen so far.

    Args:
        given: records by use, with their inputs as they act.
        dataset: the same records, with their score windows.
        delay: whole samples by which each input acts later; empty for none.
        whole: the dataset as it was measured, if the inputs are delayed.
        settings, observer, stop, snapshots: see :func:`lfrtorch.identify`.
        linear: the best linear approximation.
        begun: the linear approximation that the models are made from; its order may differ.
        order_scan, choice: choice of the linear order, and choice of the sizes.
        models: models that the next fit starts from.
        ridge: ridge of the next fit, if it differs from the settings.
        result, again: result of the fit, and of the refit to all estimation records.
    """

    given: Dataset
    dataset: Dataset
    settings: Settings
    observer: Observer
    delay: tuple[int, ...] = ()
    whole: Dataset | None = None
    stop: Stop | None = None
    snapshots: Snapshots | None = None
    linear: LinearModel = _LATER
    begun: LinearModel = _LATER
    order_scan: OrderScan | None = None
    choice: Choice | None = None
    models: Sequence[Model] = ()
    ridge: Ridge | None = None
    result: FitResult = _LATER
    again: FitResult | None = None

    def fit(self, models: Sequence[Model], data: Data, **options: Any) -> FitResult:
        """Fit with the settings; ``options`` replace single settings."""
        own = {name: getattr(self.settings, name) for name in ("noise", "horizon")}
        own["ridge"] = self.settings.ridge if self.ridge is None else self.ridge
        return fit(models, *data, **{**own, "stop": self.stop, **options})


class Data(NamedTuple):
    """Records of a fit by use."""

    train: Sequence[Record]
    validation: Sequence[Record] = ()
    selection: Sequence[Record] = ()

    @classmethod
    def of(cls, dataset: Dataset) -> Data:
        """Training, validation and selection records of a dataset."""
        return cls(dataset.train, dataset.validation, dataset.selection)


class Stage:
    """A stage of an identification; it is a fit, unless it overrides ``run``."""

    name = ""
    """Name of the stage, after "stopped during"."""

    def check(self, job: Job) -> None:
        """Refuse invalid settings before anything is computed."""

    def when(self, job: Job) -> bool:
        """Tell if the stage runs."""
        return True

    def models(self, job: Job) -> Sequence[Model]:
        """Models that the fit starts from."""
        return job.models

    def data(self, job: Job) -> Data:
        """Data of the fit."""
        return Data.of(job.dataset)

    def trainer(self, job: Job) -> Trainer:
        """Trainer of the fit."""
        return job.settings.trainer

    def options(self, job: Job) -> Mapping[str, Any]:
        """Keywords of the fit that replace settings."""
        return {}

    def keep(self, job: Job, result: FitResult) -> Job:
        """The job with what is kept of the result."""
        raise NotImplementedError

    def run(self, job: Job) -> Job:
        """The job after the stage."""
        # If this fit is cut short, the result of the whole fit, if there is one, is kept and gets
        # this fit's reason.
        monitor, models = job.observer.searching(), self.models(job)
        result = job.fit(
            models,
            self.data(job),
            trainer=self.trainer(job),
            monitors=None if monitor is None else [[monitor]] * len(models),
            **self.options(job),
        )
        if result.reason not in CUT_SHORT:
            return self.keep(job, result)
        if job.result is None:
            raise StoppedError(f"stopped during {self.name}")
        whole = replace(job.result, reason=result.reason, detail=result.detail)
        return replace(job, result=whole)


def best_start(job: Job, result: FitResult) -> tuple[Settings, list[Model]]:
    """The best start, and the settings with its seed."""
    best = result.starts[0].number if result.starts else 0
    settings = job.settings
    return replace(settings, seed=settings.seeds[best], starts=1), [result.model]
