"""The linear model that an identification begins with: the best linear approximation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import cast

import torch

from lfrtorch._support.errors import InputError
from lfrtorch._support.tables import number, quantity
from lfrtorch.data.records import Record
from lfrtorch.distributed import agreed
from lfrtorch.fitting.observer import Observer
from lfrtorch.fitting.settings import Settings
from lfrtorch.fitting.stage import Job, Stage
from lfrtorch.fitting.windows import begins_at_outputs
from lfrtorch.linear.bla import estimate_bla
from lfrtorch.linear.frf import FRF
from lfrtorch.linear.measured_states import measured_states_model
from lfrtorch.linear.model import LinearModel
from lfrtorch.linear.order_scan import OrderScan, scan_orders
from lfrtorch.linear.requirements import excited_directions


class BestLinear(Stage):
    """The best linear approximation of the records, and its order."""

    def when(self, job: Job) -> bool:
        """Tell if the states are not the outputs."""
        return not begins_at_outputs(job.dataset.train)

    def run(self, job: Job) -> Job:
        """Estimate the best linear approximation."""
        settings, train = of_linear_model(job.settings), job.dataset.train
        records = linear_records(train, settings, job.observer)
        linear, scan = linear_model(
            records, settings, job.dataset.validation, observer=job.observer
        )
        if not (job.settings.known_states or job.settings.searched):
            job = replace(job, settings=replace(job.settings, nx=linear.nx))
        return replace(job, linear=linear, begun=linear, order_scan=scan)


class OutputsAsStates(Stage):
    """The linear model whose states are the outputs, for records with a measured start."""

    def when(self, job: Job) -> bool:
        """Tell if the states are the outputs."""
        return begins_at_outputs(job.dataset.train)

    def run(self, job: Job) -> Job:
        """Estimate the linear model; refuse settings that do not fit such records."""
        linear = measured_states_model(job.dataset.train)
        tell(linear, job.observer)
        return replace(job, settings=_of_outputs(job), linear=linear, begun=linear)


def _of_outputs(job: Job) -> Settings:
    """The settings of a model whose states are the outputs; refuse other nx and short records."""
    dataset, settings = job.dataset, job.settings
    ny, horizon = len(dataset.train[0].outputs), settings.horizon or 0
    for record in (*dataset.train, *dataset.validation, *dataset.selection, *dataset.tests):
        if record.samples <= horizon:
            raise InputError(
                f"record '{record.name}' has {record.samples} samples and horizon is {horizon}; "
                "give a longer record or a shorter horizon."
            )
    if settings.known_states or settings.nx == ny:
        return settings
    if settings.nx != "auto":
        raise InputError(
            f"nx is {settings.nx}, but with start='measured' the {ny} outputs are the states; give "
            f"nx={ny} or nx='auto'."
        )
    return replace(settings, nx=ny)


def of_linear_model(settings: Settings) -> Settings:
    """The settings of the linear model that a known model is compared with."""
    if not settings.known_states:
        return settings
    nx = settings.known_states + cast(int, settings.nx)
    return replace(settings, known=None, init_from=None, nx=nx, nz=1, nw=1, nn=1)


def linear_model(
    data: Sequence[Record] | FRF,
    settings: Settings,
    validation: Sequence[Record] = (),
    *,
    observer: Observer,
) -> tuple[LinearModel, OrderScan | None]:
    """The best linear approximation, and the scan that chose its order if nx is ``"auto"``."""
    if not isinstance(data, FRF) and not data:
        raise InputError(
            "no record is left to fit; give a smaller validation and test, or more of train."
        )
    scan: OrderScan | None = None
    if settings.nx == "auto":
        orders = range(1, settings.nx_max + 1)
        scan = scan_orders(
            data, orders, validation=validation, watch=observer.say, **settings.linear
        )
        observer.say(scan.table())
        for note in scan.notes:
            observer.say(f"note: {note}")
        # Rounding may differ between processes, so the first process decides the order.
        chosen = int(agreed(torch.tensor(scan.chosen)))
        linear = scan.models[scan.orders.index(chosen)]
    else:
        linear = estimate_bla(data, cast(int, settings.nx), **settings.linear)
    tell(linear, observer)
    return linear, scan


def approximation(records: Sequence[Record], nx: int, settings: Settings) -> LinearModel:
    """The linear model of an order, or the model whose states are the outputs."""
    if begins_at_outputs(records):
        return measured_states_model(records)
    return estimate_bla(records, nx, **settings.linear)


def tell(linear: LinearModel, observer: Observer) -> None:
    """Report a linear model to the observer."""
    found = linear.fit
    assert found is not None
    observer.say(
        f"BLA: order {linear.nx}, {found.criterion} error {number(found.rmse)} (normalised), "
        f"{found.iterations} iterations, {found.reason}, {quantity(found.seconds, 's')}"
    )
    for note in found.notes:
        observer.say(f"note: {note}")


def linear_records(
    train: Sequence[Record], settings: Settings, observer: Observer
) -> Sequence[Record]:
    """Return the records that the linear model is estimated from: those in steady state, or all."""
    # A best linear approximation holds for one kind of signal, and is much cheaper to estimate from
    # records in steady state. If these records excite too little for the order, all are taken.
    steady = [record for record in train if record.start == "periodic"]
    if len(steady) in (0, len(train)):
        return train
    order = settings.nx_max if settings.nx == "auto" else cast(int, settings.nx)
    excited, wanted = excited_directions(steady, order)
    if excited < wanted:
        return train
    observer.say(f"linear model: from the {len(steady)} training record(s) in steady state alone")
    return steady
