"""A trained model, updated with the data of a command line.

lfrtorch fit update=runs/run new.csv
"""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

import lfrtorch
from lfrtorch._support.atomic import whole_file
from lfrtorch._support.errors import InputError
from lfrtorch._support.tables import number, table
from lfrtorch.cli.hydra_versions import instantiate
from lfrtorch.data.dataset import Dataset
from lfrtorch.data.metrics import rmse_by_output
from lfrtorch.fitting.refit import estimation_records
from lfrtorch.fitting.update import update
from lfrtorch.model.model import Model, check_channels


def updated(cfg: DictConfig, dataset: Dataset, folder: Path) -> float:
    """Update the model with all but the test records, write its files; return the new rms error."""
    given = str(cfg["update"])
    if cfg.init_from is not None:
        raise InputError("update and init_from both name a model to begin with; give one of them.")
    old = lfrtorch.load(given)
    if not isinstance(old, Model) or not old.lfr.cell.nw:
        raise InputError(
            f"update is '{given}', a linear model: give the folder of a run of lfrtorch fit."
        )
    for record in [*dataset.train, *dataset.validation, *dataset.selection, *dataset.tests]:
        check_channels(old, record)
    found = update(
        old, estimation_records(dataset), horizon=cfg.horizon, trainer=instantiate(cfg.trainer)
    )
    print(f"{found}\n")
    scores: dict[str, Any] = {}
    rows: list[list[Any]] = []
    for record in dataset.tests:
        before, after = (
            rmse_by_output(record, model.simulate(record)) for model in (old, found.model)
        )
        scores[record.name] = {"before": before.tolist(), "after": after.tolist()}
        for channel, *own in zip(old.outputs, before, after, strict=True):
            rows.append([record.name, channel.name, *map(number, own), channel.unit])
    if rows:
        print(table(["rms error on", "output", "before", "after", "unit"], rows) + "\n")
    found.model.save(folder / "model")
    entries = {
        "weight": found.weight,
        "new": {"before": found.before.tolist(), "after": found.after.tolist()},
        "steps": found.steps,
        "values": found.values,
        "tests": scores,
    }
    with whole_file(folder / "metrics.json") as fresh:
        fresh.write_text(json.dumps(entries, indent=2) + "\n")
    checkpoint = shlex.quote(f"checkpoint={folder}")
    print(f"The new model: lfrtorch simulate {checkpoint} NEW.csv out=PREDICTED.csv")
    return float(max(found.after))
