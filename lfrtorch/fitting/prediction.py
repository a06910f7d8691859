"""Fits of the prediction one sample ahead: models and records of predictors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from lfrtorch.data.records import Record, as_records, with_past_outputs
from lfrtorch.fitting.trainer import Monitor
from lfrtorch.model.model import Model


def without_gain(models: Model | Sequence[Model]) -> Model | list[Model]:
    """Models whose simulation is fitted: K would be that of the models before the fit."""
    if isinstance(models, Model):
        return models if models.K is None else replace(models, K=None)
    return [model if model.K is None else replace(model, K=None) for model in models]


def without_innovations(model: Model) -> Model:
    """A model without a gain with one of 0, where a search for one begins at the simulation."""
    cell = model.lfr.cell
    return model if model.K is not None else replace(model, K=cell.A.new_zeros(cell.nx, cell.ny))


def predicting(
    models: Model | Sequence[Model], *records: Record | Sequence[Record]
) -> tuple[Model | list[Model], *tuple[list[Record], ...]]:
    """The predictors of models, and the records that drive them."""
    given = [models] if isinstance(models, Model) else list(models)
    found = [model.predictor() for model in given]
    driven = [[with_past_outputs(r) for r in as_records(part)] if part else [] for part in records]
    return (found[0] if isinstance(models, Model) else found, *driven)


def shown_innovation_form(
    monitors: Sequence[Monitor] | Sequence[Sequence[Monitor]] | None,
) -> list[Any] | None:
    """Monitors of a fit of predictors, which see the models of the systems themselves."""
    if monitors is None:
        return None

    def wrapped(monitor: Monitor) -> Monitor:
        return lambda model, progress: monitor(model.innovation_form(), progress)

    return [
        wrapped(each) if callable(each) else [wrapped(monitor) for monitor in each]
        for each in monitors
    ]
