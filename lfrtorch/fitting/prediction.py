"""Fits of the prediction one sample ahead: predictors of models, and the records they need."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from lfrtorch.data.records import Record, as_records, with_past_outputs
from lfrtorch.fitting.trainer import Monitor
from lfrtorch.model.model import Model


def without_gain(models: Model | Sequence[Model]) -> Model | list[Model]:
    """Models without K, for a fit of simulations, after which K would be out of date."""
    if isinstance(models, Model):
        return models if models.K is None else replace(models, K=None)
    return [model if model.K is None else replace(model, K=None) for model in models]


def without_innovations(model: Model) -> Model:
    """The model, with K = 0 if it has no K; a search for K then begins at the simulation."""
    cell = model.lfr.cell
    return model if model.K is not None else replace(model, K=cell.A.new_zeros(cell.nx, cell.ny))


def predicting(
    models: Model | Sequence[Model], *records: Record | Sequence[Record]
) -> tuple[Model | list[Model], *tuple[list[Record], ...]]:
    """The predictors of models, and the records that the predictors are simulated on."""
    given = [models] if isinstance(models, Model) else list(models)
    found = [model.predictor() for model in given]
    driven = [[with_past_outputs(r) for r in as_records(part)] if part else [] for part in records]
    return (found[0] if isinstance(models, Model) else found, *driven)


def shown_innovation_form(
    monitors: Sequence[Monitor] | Sequence[Sequence[Monitor]] | None,
) -> list[Any] | None:
    """Monitors for a fit of predictors that are called with the models in innovation form."""
    if monitors is None:
        return None

    def wrapped(monitor: Monitor) -> Monitor:
        return lambda model, progress: monitor(model.innovation_form(), progress)

    return [
        wrapped(each) if callable(each) else [wrapped(monitor) for monitor in each]
        for each in monitors
    ]
