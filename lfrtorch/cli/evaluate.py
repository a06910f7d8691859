"""A trained model on a dataset: checkpoint and records -> table of scores.

lfrtorch evaluate checkpoint=runs/boucwen +bench=boucwen
lfrtorch evaluate checkpoint=runs/run new.csv
"""

from __future__ import annotations

import json
import shlex
from dataclasses import replace
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

import lfrtorch
from lfrtorch._support.atomic import refuse_existing, whole_file
from lfrtorch._support.paths import real
from lfrtorch.analysis.residual_analysis import SHORTEST, Residuals, of_simulation
from lfrtorch.cli.checks import check_evaluation
from lfrtorch.cli.config import loaded
from lfrtorch.cli.errors import user_errors
from lfrtorch.cli.run_folder import CONFIG, program, read_settings
from lfrtorch.files.load import EVERYTHING, listed_files
from lfrtorch.model.model import check_channels
from lfrtorch.reporting import scores as report
from lfrtorch.reporting.evaluation import Evaluation

_FILES = "lfrtorch.load_records"  # target that reads a user's own files
_DIVIDES = "data.validation", "data.test"  # words that divide records by use


def evaluate(cfg: DictConfig) -> None:
    """Print the scores of the checkpoint's model, and write them if ``out`` is set."""
    command = shlex.join([*program("scripts/evaluate.py"), *HydraConfig.get().overrides.task])
    check_evaluation(cfg)
    folder = str(cfg.checkpoint)
    if cfg.out is not None and not cfg.overwrite:
        refuse_existing(cfg.out, "overwrite=true")
    model, bla = lfrtorch.load(folder), linear_beside(folder)
    if cfg.data._target_ == _FILES:
        from_files(cfg, model, command)
    dataset = loaded(cfg).with_windows(model.delay)
    for record in (*dataset.tests, *dataset.validation, *dataset.selection):
        check_channels(model, record)
    if bla is None and model.sizes["nz"]:
        print(f"note: '{folder}' has no folder linear/, so no linear model is scored")
    elif bla is not None and dataset.linear:
        print("note: the linear model is that of all training records; a run has one for each test")
    scored = replace(dataset, train=[])  # not scored, so not simulated
    evaluation = Evaluation(dataset=scored, linear=bla, model=model)
    scores = report.scored(evaluation, command)
    print(f"\n{report.table(evaluation)}")
    use = "test" if dataset.tests else "validation"
    parts = [
        part
        for one in evaluation.simulations
        if one.use == use and len(one.scored) >= SHORTEST
        for part in of_simulation(one.record, one.y_hat)
    ]
    if parts:
        residuals = Residuals(tuple(parts))
        scores["residuals"] = residuals.entries()
        print(f"\nResiduals\n\n{residuals}")
    if cfg.out is not None:
        found = {"checkpoint": folder, **scores}
        with whole_file(cfg.out) as file:
            file.write_text(json.dumps(found, indent=2, allow_nan=False) + "\n")
        print(f"\nScores in {cfg.out}")


def from_files(cfg: DictConfig, model: lfrtorch.Model, command: str) -> None:
    """Complete the data by the model's channels; all records are tests if the run used none."""
    for side, channels in (("inputs", model.inputs), ("outputs", model.outputs)):
        if cfg.data[side] is None:
            cfg.data[side] = [channel.name for channel in channels]
    divided = any(word.startswith(f"{name}=") for word in shlex.split(command) for name in _DIVIDES)
    if divided or not cfg.data.path or fitted(cfg.checkpoint, cfg.data.path):
        return
    cfg.data.test = EVERYTHING
    print("note: whole records are scored; data.test=0.2 scores the last fifth alone")


def fitted(checkpoint: str, path: str | list[str]) -> bool:
    """Tell if the run of the checkpoint used one of the files."""
    folder = Path(checkpoint)
    for config in (folder / CONFIG, folder.parent / CONFIG):
        if config.is_file():
            settings = read_settings(config)
            data = settings.get("data") if isinstance(settings, dict) else None
            own = data.get("path") if isinstance(data, dict) else None
            return own is not None and not resolved(own).isdisjoint(resolved(path))
    return False


def resolved(path: str | list[str]) -> set[Path]:
    """The files of paths and patterns; empty if the files are gone."""
    try:
        return {real(file) for file in listed_files(path, "data.path")}
    except FileNotFoundError:
        return set()


def linear_beside(checkpoint: str) -> lfrtorch.LinearModel | None:
    """The linear model of a run, if there is one; ``checkpoint`` is its folder or ``model/``."""
    folder = Path(checkpoint)
    places = [folder / "linear", *([folder.parent / "linear"] if folder.name == "model" else [])]
    found = next((place for place in places if place.is_dir()), None)
    return None if found is None else lfrtorch.LinearModel.load(found)


main = user_errors()(evaluate)
"""The command."""
