"""The linear model that an NL-LFR is compared with: the best for the error that is judged.

A fit to predictions gives a good start where a controller closes the loop, and may simulate worse
than a constant. An NL-LFR that beats such a model beats nothing. So linear models of the other
criteria stand beside it, and estimation records choose: tests have no say.
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
"""Linear models by the samples that outputs are predicted ahead; None: by simulation."""


def opponents(
    linear: LinearModel,
    records: Sequence[Record],
    dataset: Dataset,
    *,
    nx: int,
    options: Mapping[str, Any],
    ahead: Sequence[int] = (),
) -> Opponents:
    """Choose the linear model of an order for simulations, and for predictions so far ahead.

    Args:
        linear: that the NL-LFR begins with.
        records: that linear models are estimated from.
        dataset: whose training, validation and selection records choose.
        nx: order.
        options: arguments of :func:`lfrtorch.estimate_bla`.
        ahead: horizons of the predictions that are judged; none of simulations alone.
    """
    wanted: list[Criterion] = ["simulation"] if not ahead else ["prediction", "simulation"]
    same = linear.nx == nx and linear.fit is not None
    models = [linear] if same else [estimate_bla(records, nx, **options)]
    known = {model.fit.criterion for model in models if model.fit is not None}
    for refine in wanted:
        if refine in known:
            continue
        own = {**options, "refine": refine}
        if refine == "prediction":  # which finds poles near 1 without
            own["integrators"] = 0
        try:
            models.append(estimate_bla(records, nx, **own))
        except InputError:  # what the criterion of the start does without, such as a longer record
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
    """Output (T, ny) simulated, or predicted so far ahead; without K a simulation predicts, too."""
    if ahead is None or model.K is None:
        return model.simulate(record)
    return model.to_model().predict(without_coordinates(record), horizon=ahead)
