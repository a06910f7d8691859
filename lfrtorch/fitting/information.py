"""The information of records on the parameters of a model, as a fit to them sees it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lfrtorch.data.records import Record, as_records, with_past_outputs
from lfrtorch.engine.record_starts import STARTS
from lfrtorch.fitting.windows import windows
from lfrtorch.least_squares.linear_systems import QRAccumulator
from lfrtorch.least_squares.problem import Problem
from lfrtorch.model.information import Information
from lfrtorch.model.model import Model

LARGEST = 3000
"""Number of entries of θ, with those that a fit holds, up to which their information is kept."""


def informed(model: Model, records: Record | Sequence[Record], horizon: int | None = None) -> Model:
    """The model with what these records, those of its fit, tell of its parameters."""
    data = as_records(records)
    own = model if model.K is None else model.predictor()
    if free_entries(own).numel() > LARGEST:
        return replace(model, information=None)
    data = data if model.K is None else [*map(with_past_outputs, data)]
    theta, rows, rmse, size = information_rows(own, as_fitted(own, data, horizon))
    if not (0.0 < rmse < math.inf and torch.isfinite(rows).all()):
        return replace(model, information=None)
    return replace(model, information=Information(theta, rows / rmse, rmse, size))


def free_entries(model: Model) -> Bool[Tensor, " P"]:
    """Mask of the entries of θ that a fit does not hold."""
    cell = model.lfr.cell
    free = [(name, p) for name, p in cell.named_parameters() if p.requires_grad]
    none = torch.zeros(0, dtype=torch.bool)
    held = (cell.held.get(n, torch.zeros_like(p, dtype=torch.bool)).flatten() for n, p in free)
    return ~torch.cat([none, *(mask.cpu() for mask in held)])


def as_fitted(model: Model, records: Sequence[Record], horizon: int | None) -> Sequence[Record]:
    """Records as a fit cuts them."""
    if horizon is None:
        return records
    return windows(records, horizon, model.lfr.cell.nx, y_scale=model.scaler.y_scale)


def information_rows(
    model: Model, records: Sequence[Record]
) -> tuple[Float[Tensor, " P"], Float[Tensor, "K free"], float, int]:
    """θ, R with RᵀR = JᵀJ in its free entries, without start states, rms and number of errors."""
    total, squares, size, theta = QRAccumulator(), 0.0, 0, torch.zeros(0)
    free = torch.nonzero(free_entries(model)).squeeze(1)
    for batch in _batches(records, len(free), model.lfr.cell.nx):
        problem = Problem.of(model, batch)
        point, own = problem.evaluate(problem.theta), problem.errors.parameters.own
        theta = point.theta[:own]
        columns = torch.cat([free, torch.arange(own, len(point.theta))])
        J = problem.linearise_at(point, reduce=False, eliminate=False).triangle(columns)
        states = len(columns) - len(free)  # first, so that all rows but theirs are without them
        total.fold(torch.linalg.qr(J.roll(states, 1), mode="r").R[states:, states:])
        squares, size = squares + point.cost, size + problem.size
    return theta.cpu(), total.R.cpu(), math.sqrt(squares / size), size


def _batches(records: Sequence[Record], free: int, nx: int) -> Iterator[Sequence[Record]]:
    """Records that are linearised together: with about as many start states as parameters."""
    others = [record for record in records if not STARTS[record.start].fitted]
    if others:
        yield others
    estimated = [record for record in records if STARTS[record.start].fitted]
    count = max(1, free // max(nx, 1))
    for first in range(0, len(estimated), count):
        yield estimated[first : first + count]
