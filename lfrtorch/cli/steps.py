"""Steps of more than one command: records, linear model."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import cast

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig

import lfrtorch
from lfrtorch._threads import each_alone
from lfrtorch.dataset import Dataset
from lfrtorch.distributed import Ranks
from lfrtorch.linear.order_scan import OrderScan
from lfrtorch.survey.findings import findings


def loaded(cfg: DictConfig) -> Dataset:
    """The records; what is to be known of them is printed."""
    dataset: Dataset = instantiate(cfg.data)
    measured = [record for record in dataset.train if record.source == "file"]
    for note in (*dataset.notes, *(findings(measured) if measured else ())):
        print(f"note: {note}")
    return dataset


def linear_model(
    cfg: DictConfig,
    data: Sequence[lfrtorch.Record] | lfrtorch.FRF,
    validation: Sequence[lfrtorch.Record],
    ranks: Ranks,
) -> tuple[lfrtorch.LinearModel, OrderScan | None]:
    """The best linear approximation; with nx=auto of the order that a scan chooses, now ``cfg.nx``.

    What is known of it is printed.
    """
    scan: OrderScan | None = None
    if cfg.nx == "auto":
        options = {k: v for k, v in cfg.bla.items() if k != "nx"}
        options["_target_"] = partial(lfrtorch.scan_orders, validation=validation)
        scan = cast(OrderScan, instantiate(options, data, range(1, cfg.nx_max + 1)))
        print(scan.table())
        # Rounding may differ from machine to machine, and the order must not.
        cfg.nx = int(ranks.first(torch.tensor(scan.chosen)))
        bla = scan.models[scan.orders.index(cfg.nx)]
    else:
        bla = instantiate(cfg.bla, data)
    fit = bla.fit
    assert fit is not None
    print(
        f"BLA: order {bla.nx}, {fit.criterion} error {fit.rmse:.3g} (normalised), "
        f"{fit.iterations} iterations, {fit.reason}, {fit.seconds:.1f} s"
    )
    for note in fit.notes:
        print(f"note: {note}")
    return bla, scan


def same_channels(model: lfrtorch.Model, record: lfrtorch.Record, folder: str) -> None:
    """Refuse data of other channels than those of the model in ``folder`` with a ValueError."""
    for side, channels, found in (
        ("inputs", model.inputs, record.inputs),
        ("outputs", model.outputs, record.outputs),
    ):
        if channels != found:
            raise ValueError(
                f"the model in '{folder}' has the {side} {', '.join(map(str, channels))} "
                f"and the data {', '.join(map(str, found))}; give data of the same channels."
            )


def own_linear_models(cfg: DictConfig, dataset: Dataset) -> dict[str, lfrtorch.LinearModel]:
    """Linear models of single tests, where their table has them, by the test's name."""
    records = {record.name: record for record in dataset.train}
    # Tests that share their records share the model.
    of = list(dict.fromkeys(dataset.linear.values()))
    estimate = partial(instantiate, cfg.bla)
    models = each_alone(estimate, [[records[name] for name in names] for names in of])
    by_records = dict(zip(of, models, strict=True))
    return {test: by_records[names] for test, names in dataset.linear.items()}
