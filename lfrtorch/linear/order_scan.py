"""Order of the BLA: a scan over nx, scored on records that are not fitted.

The lowest order is taken that does as well as the best (``data.paired_blocks``). If the validation
records are short compared with the system's memory, or unlike the training records, they say little
about the order. The scores then come from a cross-validation in time over both. Each of five
stretches is left out of a fit to the rest, and scored in a simulation of its whole record.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from math import inf
from typing import Any, NamedTuple

import numpy as np

from lfrtorch._support import tables
from lfrtorch._support.arguments import typed
from lfrtorch._support.checks import integer
from lfrtorch._support.errors import InputError
from lfrtorch._support.tables import number, quantity
from lfrtorch._support.threads import each_alone
from lfrtorch._support.types import Array
from lfrtorch.data.metrics import rms
from lfrtorch.data.paired_blocks import (
    BLOCKS,
    MARGIN,
    Judge,
    no_progress,
)
from lfrtorch.data.records import Record, Scaler, as_records, measured_signals, without_coordinates
from lfrtorch.data.score_window import with_window
from lfrtorch.linear.bla import estimate_bla
from lfrtorch.linear.frf import FRF
from lfrtorch.linear.integrators import integrators_of
from lfrtorch.linear.model import LinearModel
from lfrtorch.linear.order_fits import OrderFits, Window, description_length, fitted
from lfrtorch.linear.requirements import check_length, check_signals, excited_directions

_FOLDS = 5
"""Stretches of a cross-validation."""

UNLIKE = 1.5
"""Validation and training records are unlike if the errors of the order that fits best differ by
more than this factor: the error on one then says little about the error on the other."""


@dataclass(frozen=True)
class OrderScan:
    """Linear models of several orders, and the order that is chosen.

    Args:
        models: one model for each order; that of the chosen order is from ``estimate_bla``.
        scores: scores of the orders. With validation records: the rms simulation error on them, or
            in a cross-validation over them and the training records; each output is relative to its
            rms. Otherwise: the error of the fit times M^(p / 2M) (minimum description length), for
            p parameters, initial states included, and M independent equations.
            Periodic records are averaged over their periods before the fit, so that its error is
            less than that of their samples.
        validated: validation records give the scores.
        chosen: the lowest order whose score is within 1 % of the best, or within both one standard
            error and 5 % of it; without validation records the order of the best score.
        notes: why the scores are those of a cross-validation, and what orders were left out.

    Example:
        >>> scan = lfrtorch.scan_orders(record, range(1, 3))
        >>> scan.orders, scan.best.nx == scan.chosen
        ((1, 2), True)
    """

    models: tuple[LinearModel, ...]
    scores: tuple[float, ...]
    validated: bool
    chosen: int
    notes: tuple[str, ...] = ()

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
            radius = tables.radius(float(np.abs(model.poles).max()))
            chosen = "chosen" if model.nx == self.chosen else ""
            rows.append([model.nx, fitted(model), score, value, radius, chosen])
        head = ["nx", "fitted", how, "singular value", "largest pole", ""]
        return tables.table(head, rows, digits=4)


@typed("validation")
def scan_orders(
    data: Record | Sequence[Record] | FRF,
    orders: Sequence[int] = range(1, 13),
    *,
    validation: Record | Sequence[Record] = (),
    watch: Callable[[str], None] = lambda _: None,
    **options: Any,
) -> OrderScan:
    """Best linear approximations of several orders, and the lowest that is good enough.

    The scan ends when the input excites fewer directions than the order has, when there are too
    few data, or when several orders in a row bring no improvement.

    Args:
        data: as for ``estimate_bla``.
        orders: the values of nx; those below the number of integrators are left out, if there are
            others.
        validation: records on which the order is chosen.
        watch: called with a line after each order.
        options: arguments of ``estimate_bla``.

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
    outputs = data.outputs if isinstance(data, FRF) else as_records(data)[0].outputs
    orders = _rising(orders, sum(integrators_of(options.get("integrators", 0), len(outputs))))
    none = isinstance(validation, list | tuple) and not validation
    judges = [] if none else [*map(with_window, as_records(validation))]
    records = [] if isinstance(data, FRF) else [without_coordinates(r) for r in as_records(data)]
    if records:
        check_signals(records)
    given = data if isinstance(data, FRF) else records
    fits = OrderFits.of(given, max(orders), options)
    fit = partial(_alone, given, options) if fits is None else fits.fit
    how = "validation" if judges else "MDL"
    notes: list[str] = []

    def enter(tried: list[_Tried], new: _Tried, clock: float) -> bool:
        """Record and report an order; return whether the last ones brought no improvement."""
        tried.append(new)
        scores = _scores(tried)
        watch(
            f"order {new.model.nx}: fitted {number(fitted(new.model))}, {how} "
            f"{number(scores[-1])}, {quantity(time.perf_counter() - clock, 's')}"
        )
        return no_progress(scores, 3)

    tried: list[_Tried] = []
    for nx in orders:
        clock = time.perf_counter()
        try:
            if records:
                check_length(records, nx)
            excited, wanted = excited_directions(records, nx) if tried and records else (0, 0)
            if excited < wanted:
                notes.append(
                    f"orders from {nx} on are left out: the input excites {excited} of the "
                    f"{wanted} directions that order {nx} needs (one a frequency and phase)."
                )
                break
            model, length = fit(nx)
        except ValueError:
            if not tried:
                raise
            break
        errors = _errors(judges, Scaler.of(judges).y_scale, model) if judges else []
        if enter(tried, _Tried(model, length, errors), clock):
            break
    doubt = ""
    if records and judges and fits is not None:
        fittest = min(tried, key=lambda each: each.length)
        doubt = _doubt(tried[_first(tried)].model, fittest.model, records, judges)
    if doubt:
        notes.append(f"{doubt}: cross-validation over training and validation chooses the order.")
        how, every, tried = "cross-validation", tried, []
        kept = _worthwhile([each.model for each in every])
        if left := [each.model.nx for each in every if each.model.nx not in kept]:
            notes.append(
                f"orders {left} are left out of the cross-validation: they fit less than "
                f"{MARGIN:.0%} better than those below."
            )
        every = [each for each in every if each.model.nx in kept]
        folds = _Folds(records, judges, every[-1].model.nx, options)
        for each in every:
            clock = time.perf_counter()
            if enter(tried, each._replace(errors=folds.errors(each.model)), clock):
                break
    first, models = _first(tried), [each.model for each in tried]
    if fits is not None:
        models[first] = estimate_bla(given, models[first].nx, **options)
    return OrderScan(
        tuple(models), tuple(_scores(tried)), bool(judges), models[first].nx, tuple(notes)
    )


class _Tried(NamedTuple):
    """Model of an order, its description length, and its errors on records held back."""

    model: LinearModel
    length: float
    errors: list[Array]


def _rising(orders: Sequence[int], least: int) -> list[int]:
    """Return the orders once each, rising, without those below ``least`` if others remain."""
    if not len(orders):
        raise InputError("orders is empty; give at least one, for example range(1, 13).")
    for nx in orders:
        integer("orders", nx, 1)
    rising = sorted(set(orders))
    return [nx for nx in rising if nx >= least] or rising


def _scores(tried: Sequence[_Tried]) -> list[float]:
    """Return for each model the rms of its errors, or its description length if it has none."""
    return [_rms(each.errors) if each.errors else each.length for each in tried]


def _rms(errors: Sequence[Array]) -> float:
    """Return the rms of all errors; infinite if one is not finite."""
    found = float(rms(np.concatenate(errors)))
    return found if np.isfinite(found) else inf


def _worthwhile(models: Sequence[LinearModel]) -> list[int]:
    """Return the first order, and each that fits better than those below by ``MARGIN``."""
    kept, best = [], inf
    for model in models:
        if not kept or fitted(model) < best / (1.0 + MARGIN):
            kept.append(model.nx)
            best = fitted(model)
    return kept


def _first(tried: Sequence[_Tried]) -> int:
    """Return the first model that does as well as the best, or the one of the best score."""
    errors = [each.errors for each in tried]
    if sum(map(len, errors[0])) < BLOCKS:  # too few errors to judge by, or none
        return int(np.argmin(_scores(tried)))
    return Judge.of(errors).first_good()


def _errors(records: Sequence[Record], scale: Array, model: LinearModel) -> list[Array]:
    """Return the relative errors of a simulation of each record, (T, ny), after its ``skip``."""
    with np.errstate(over="ignore", invalid="ignore"):
        return [((r.y - model.simulate(r)) / scale)[r.skip :] for r in records]


def _doubt(
    model: LinearModel, fittest: LinearModel, train: list[Record], judges: list[Record]
) -> str:
    """Say why validation records tell little of an order; empty if they tell enough.

    The judging records chose the order of ``model``. ``fittest`` has the order that fits the
    training records best: the errors of a poor model are alike on both, and hide a difference.
    """
    scored = sum(record.samples - record.skip for record in judges)
    memory = memory_of(model, max(record.samples for record in train))
    if scored < 20 * memory:
        return (
            f"validation has {scored} scored samples, {number(scored / memory)} time constants "
            "of the linear model"
        )
    scale = Scaler.of(train).y_scale
    here, there = (_rms(_errors(some, scale, fittest)) for some in (train, judges))
    if not here / UNLIKE < there < here * UNLIKE:
        return f"the linear error on validation is {number(there / here)} times that on training"
    return ""


def memory_of(model: LinearModel, samples: int) -> float:
    """Return the memory in samples: the time constant of one pole with as long a response.

    The slowest pole would overstate it, as it may hardly show in the response.
    """
    x, responses = model.B, []
    for _ in range(samples):
        responses.append(model.C @ x)
        x = model.A @ x
    squares = np.square(responses).sum(axis=2)  # (samples, ny); every output counts alike
    totals = squares.sum(axis=0)
    mean = np.arange(samples) @ squares / np.where(totals > 0.0, totals, 1.0)
    return max(1.0, 2.0 * float(mean.max()))  # the mean lag of a^k is half its time constant


class _Folds:
    """Errors in stretches of time, each from a fit that leaves the stretch out."""

    def __init__(
        self,
        train: list[Record],
        judges: list[Record],
        most: int,
        options: Mapping[str, Any],
    ) -> None:
        self._records = [*map(with_window, _united(train, judges))]
        self._scale = Scaler.of(self._records).y_scale
        whole = [(r.skip, r.samples) for r in self._records]
        ends = np.cumsum([0] + [last - first for first, last in whole])
        cuts = np.linspace(0, ends[-1], _FOLDS + 1).astype(int)
        self._left_out: list[list[Window]] = []
        self._fits: list[OrderFits] = []
        chosen = {name: options.get(name, True) for name in ("offset", "feedthrough")}
        for begin, end in pairwise(cuts):
            # In samples of each record; equal bounds if the stretch is not in the record.
            out = [
                (int(np.clip(first + begin - at, first, last)),
                 int(np.clip(first + end - at, first, last)))
                for (first, last), at in zip(whole, ends, strict=False)
            ]  # fmt: skip
            rest = [
                [window for window in ((first, a), (b, last)) if window[1] > window[0]]
                for (first, last), (a, b) in zip(whole, out, strict=True)
            ]
            self._left_out.append(out)
            self._fits.append(OrderFits.of_windows(self._records, rest, most=most, **chosen))

    def errors(self, model: LinearModel) -> list[Array]:
        """Return the relative errors in each stretch, of fits that are started at the model."""
        return [
            error for some in each_alone(partial(self._of, model), range(_FOLDS)) for error in some
        ]

    def _of(self, model: LinearModel, fold: int) -> list[Array]:
        windows = self._left_out[fold]
        try:
            errors = self._fits[fold].fit_near(model)[1]
        except ValueError:
            return [np.full((b - a, len(model.outputs)), inf) for a, b in windows if b > a]
        pairs = zip(errors, windows, strict=True)
        return [(each / self._scale)[a:b] for each, (a, b) in pairs if b > a]


def _united(train: list[Record], judges: list[Record]) -> list[Record]:
    """Join records; a validation record that begins with a training record replaces that one."""
    found = list(train)
    for judge in map(without_coordinates, judges):
        for i, record in enumerate(found):
            T = record.samples
            begins = measured_signals(judge)[:T]
            if judge.skip >= T and np.array_equal(begins, measured_signals(record)):
                found[i] = replace(judge, skip=record.skip)
                break
        else:
            found.append(judge)
    return found


def _alone(
    data: list[Record] | FRF, options: Mapping[str, Any], nx: int
) -> tuple[LinearModel, float]:
    """Return the full estimate of one order, and its description length."""
    model = estimate_bla(data, nx, **options)
    nu, ny = len(model.inputs), len(model.outputs)
    if isinstance(data, FRF):
        M, starts = 2 * data.G.size / (1.0 if data.errors is None else data.errors.sharing), 0
    else:
        M = sum(r.samples - r.skip for r in data) * ny
        starts = sum(r.start != "zero" for r in data)
    gains = 0 if model.K is None else ny
    p = nx * (nu + ny + gains + starts) + nu * ny
    return model, description_length(fitted(model), p, M)
