"""Order of the BLA: a scan over nx, scored on records that are not fitted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lfrtorch._support import tables
from lfrtorch._support.checks import integer
from lfrtorch._support.errors import InputError
from lfrtorch.linear.bla import estimate_bla
from lfrtorch.linear.frf import FRF
from lfrtorch.linear.model import LinearModel
from lfrtorch.metrics import rms
from lfrtorch.records import Record, Scaler, as_records

ORDERS = range(1, 13)

MARGIN = 0.01
"""A lower order is taken if its validation score exceeds the best by at most this part."""


@dataclass(frozen=True)
class OrderScan:
    """Linear models of several orders, and the order that is chosen.

    Args:
        models: one for each order.
        scores: of each model. With validation records the rms of the simulation error over them,
            each output relative to its rms. Without them the error over the fitted data, times
            √(1 + p ln M / M) for p parameters and M equations (minimum description length).
        validated: whether validation records give the scores.
        chosen: the lowest order whose validation score is within 1 % of the best; without
            validation records the order of the best score.

    Example:
        >>> scan = lfrtorch.scan_orders(record, range(1, 3))
        >>> scan.orders, scan.best.nx == scan.chosen
        ((1, 2), True)
    """

    models: tuple[LinearModel, ...]
    scores: tuple[float, ...]
    validated: bool
    chosen: int

    @property
    def orders(self) -> tuple[int, ...]:
        """nx of each model."""
        return tuple(model.nx for model in self.models)

    @property
    def best(self) -> LinearModel:
        """The model of the chosen order."""
        return self.models[self.orders.index(self.chosen)]

    @property
    def singular_values(self) -> tuple[float, ...]:
        """Singular values of the largest order's subspace, relative to the size of the outputs."""
        fit = self.models[-1].fit
        return () if fit is None else fit.singular_values

    def table(self) -> str:
        """A table with one line for each order."""
        how = "validation" if self.validated else "MDL"
        rows = []
        for model, score in zip(self.models, self.scores, strict=True):
            s = self.singular_values
            value = s[model.nx - 1] if model.nx <= len(s) else None
            assert model.fit is not None
            radius = tables.radius(float(np.abs(model.poles).max()))
            chosen = "chosen" if model.nx == self.chosen else ""
            rows.append([model.nx, model.fit.rmse, score, value, radius, chosen])
        head = ["nx", "fitted", how, "singular value", "largest pole", ""]
        return tables.table(head, rows, digits=4)


def scan_orders(
    data: Record | Sequence[Record] | FRF,
    orders: Sequence[int] = ORDERS,
    *,
    validation: Record | Sequence[Record] = (),
    **options: Any,
) -> OrderScan:
    """Best linear approximations of several orders, and the lowest that is good enough.

    Args:
        data: as for ``estimate_bla``.
        orders: the values of nx; those that need more data than there are are left out, and those
            below the number of integrators, if there are others.
        validation: records that choose the order.
        options: of ``estimate_bla``.

    Raises:
        ValueError: no order, or too few data for any of them.

    Example:
        >>> scan = lfrtorch.scan_orders(record, [1, 2, 3])
        >>> print(scan.table())  # doctest: +ELLIPSIS
          nx ...
           1 ...
           2 ...
           3 ...
    """
    if not len(orders):
        raise InputError("orders is empty; give at least one, for example range(1, 13).")
    for nx in orders:
        integer("orders", nx, 1)
    outputs = data.outputs if isinstance(data, FRF) else as_records(data)[0].outputs
    least = options.get("integrators", 0) * len(outputs)
    orders = [nx for nx in orders if nx >= least] or orders
    judges = as_records(validation) if validation else []
    models: list[LinearModel] = []
    for nx in sorted(set(orders)):
        try:
            models.append(estimate_bla(data, nx, **options))
        except ValueError:
            if not models:
                raise
            break
    if judges:
        scale = Scaler.of(judges).y_scale
        scores = [_validation(model, judges, scale) for model in models]
    else:
        scores = [_description_length(model, data) for model in models]
    best = min(scores)
    limit = best * (1 + MARGIN) if judges else best
    chosen = next(m.nx for m, s in zip(models, scores, strict=True) if s <= limit)
    return OrderScan(tuple(models), tuple(scores), bool(judges), chosen)


def _validation(model: LinearModel, records: list[Record], scale: np.ndarray) -> float:
    errors = [((r.y - model.simulate(r)) / scale)[r.skip :] for r in records]
    return float(rms(np.concatenate(errors)))


def _description_length(model: LinearModel, data: Record | Sequence[Record] | FRF) -> float:
    assert model.fit is not None
    nx, nu, ny = model.nx, len(model.inputs), len(model.outputs)
    if isinstance(data, FRF):
        M = 2 * data.G.size
    else:
        M = sum(r.samples - r.skip for r in as_records(data)) * ny
    p = nx * (nu + ny) + nu * ny
    return model.fit.rmse * float(np.sqrt(1.0 + p * np.log(M) / M))
