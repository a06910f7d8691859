"""The linear model that an NL-LFR is compared with: the best one for the error that is judged.

If a controller closes the loop, a linear model fitted to predictions is a good start, but it may
simulate worse than a constant. To be better than such a model means nothing. So linear models are
also fitted by the other criteria, and the estimation records, not the tests, choose among them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array
from lfrtorch.data.dataset import Dataset
from lfrtorch.data.metrics import rms
from lfrtorch.data.records import Record, Scaler, without_coordinates
from lfrtorch.data.score_window import fitted
from lfrtorch.linear.bla import Criterion, estimate_bla
from lfrtorch.linear.model import LinearModel

Opponents = Mapping[int | None, LinearModel]
"""Linear models by the number of samples ahead of predictions; the key None is for simulation."""


def opponents(
    linear: LinearModel,
    records: Sequence[Record],
    dataset: Dataset,
    *,
    nx: int,
    options: Mapping[str, Any],
    ahead: Sequence[int] = (),
) -> Opponents:
    """Choose the linear model of an order for simulations, and for predictions ``ahead``.

    Args:
        linear: model that the NL-LFR starts from.
        records: records that linear models are estimated from.
        dataset: its training, validation and selection records choose.
        nx: order.
        options: arguments of :func:`lfrtorch.estimate_bla`.
        ahead: horizons of the predictions that are judged; empty if only simulations are judged.
    """
    wanted: list[Criterion] = ["simulation"] if not ahead else ["prediction", "simulation"]
    same = linear.nx == nx and linear.fit is not None
    models = [linear] if same else [estimate_bla(records, nx, **options)]
    known = {model.fit.criterion for model in models if model.fit is not None}
    for refine in wanted:
        if refine in known:
            continue
        own = {**options, "refine": refine}
        if refine == "prediction":  # it finds poles near 1 without integrators
            own["integrators"] = 0
        try:
            models.append(estimate_bla(records, nx, **own))
        except InputError:  # this criterion may need a longer record than that of the start
            continue
    if len(models) == 1:
        return dict.fromkeys((None, *ahead), models[0])
    judges = [(record, fitted(record)) for record in dataset.train]
    judges += [(record, record) for record in (*dataset.validation, *dataset.selection)]
    scale = Scaler.of(dataset.train).y_scale

    def error(model: LinearModel, horizon: int | None) -> float:
        with np.errstate(over="ignore", invalid="ignore"):
            errors = [record.errors(output(model, own, horizon)) for record, own in judges]
            found = float(rms(np.concatenate(errors) / scale))
        return found if math.isfinite(found) else math.inf

    return {h: min(models, key=lambda model: error(model, h)) for h in (None, *ahead)}


def output(model: LinearModel, record: Record, ahead: int | None) -> Array:
    """Output (T, ny), predicted ``ahead`` samples ahead; simulated without ``ahead`` or K."""
    if ahead is None or model.K is None:
        return model.simulate(record)
    return model.to_model().predict(without_coordinates(record), horizon=ahead)
