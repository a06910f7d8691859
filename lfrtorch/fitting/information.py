"""The information of records on the parameters of a model, as a fit to them sees it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from lfrtorch.data.records import Record, as_records, with_past_outputs
from lfrtorch.fitting.windows import windows
from lfrtorch.least_squares.linear_systems import QRAccumulator
from lfrtorch.least_squares.problem import Problem
from lfrtorch.model.information import Information
from lfrtorch.model.model import Model


def informed(model: Model, records: Record | Sequence[Record], horizon: int | None = None) -> Model:
    """The model with what these records, those of its fit, tell of its parameters."""
    data = as_records(records)
    own = model if model.K is None else model.predictor()
    data = data if model.K is None else [*map(with_past_outputs, data)]
    theta, rows, rmse, size = information_rows(own, as_fitted(own, data, horizon))
    if not (math.isfinite(rmse) and torch.isfinite(rows).all()):
        return replace(model, information=None)
    return replace(model, information=Information(theta, rows / rmse, rmse, size))


def as_fitted(model: Model, records: Sequence[Record], horizon: int | None) -> Sequence[Record]:
    """Records as a fit cuts them."""
    if horizon is None:
        return records
    return windows(records, horizon, model.lfr.cell.nx, y_scale=model.scaler.y_scale)


def information_rows(
    model: Model, records: Sequence[Record]
) -> tuple[Float[Tensor, " P"], Float[Tensor, "K P"], float, int]:
    """θ, R with RᵀR = JᵀJ without start states, the rms error, and the number of errors."""
    total, squares, size, theta = QRAccumulator(), 0.0, 0, torch.zeros(0)
    for record in records:
        problem = Problem.of(model, [record])
        point, own = problem.evaluate(problem.theta), problem.errors.parameters.own
        theta = point.theta[:own]
        J = problem.linearise_at(point, reduce=False, eliminate=False).triangle()
        states = J.shape[1] - own  # first, so that all rows but theirs are without them
        total.fold(torch.linalg.qr(J.roll(states, 1), mode="r").R[states:, states:])
        squares, size = squares + point.cost, size + problem.size
    return theta, total.R, math.sqrt(squares / size), size
