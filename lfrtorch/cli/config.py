"""The dataset and the settings that a configuration describes."""

from __future__ import annotations

import os
import sys
from dataclasses import fields, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf
from torch.nn import Module

import lfrtorch
from lfrtorch._support.errors import InputError
from lfrtorch._support.tables import in_lines
from lfrtorch.cli.checks import check_plain
from lfrtorch.cli.errors import as_words
from lfrtorch.cli.hydra_versions import instantiate
from lfrtorch.data.dataset import Dataset
from lfrtorch.fitting.plain_settings import PlainSettings
from lfrtorch.fitting.settings import Settings
from lfrtorch.linear.record_start import decided
from lfrtorch.survey.notes import notes_on


def configured(cfg: DictConfig) -> Settings:
    """The settings of an identification."""
    check_plain(cfg)
    plain: Any = OmegaConf.to_container(cfg, resolve=True)
    return Settings(
        **{one.name: plain[one.name] for one in fields(PlainSettings)},
        static=partial(own_map, cfg) if cfg.static.kind == "own" else cfg.static.kind,
        known=None if cfg.known._target_ is None else users_own(cfg.known),
        fixed={name: np.array(matrix, dtype=float) for name, matrix in plain["fixed"].items()},
        linear=plain["bla"],
        trainer=instantiate(cfg.trainer),
        init_from=None if cfg.init_from is None else opened(cfg),
        dtype=getattr(torch, cfg.dtype),
    )


def limit_threads(cfg: DictConfig) -> None:
    """Compute on at most ``threads`` threads; more threads than cores can cost hours."""
    if cfg.threads is not None:
        torch.set_num_threads(min(cfg.threads, os.cpu_count() or 1))


def own_map(cfg: DictConfig, nz: int, nw: int) -> Module:
    """Make a static map of the user's own."""
    options = {name: value for name, value in cfg.static.items() if name != "kind"}
    return users_own(options, nz=nz, nw=nw)


def users_own(node: Any, **options: Any) -> Any:
    """Call a target of the user's own; its module may be in the working directory."""
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())
    return instantiate(node, **options)


def opened(cfg: DictConfig) -> lfrtorch.Model:
    """The saved model of ``init_from``; a note names the sizes that it replaces."""
    own = own_map(cfg, cfg.nz, cfg.nw) if cfg.static.kind == "own" else None
    model = lfrtorch.load(cfg.init_from, static=own)
    if not model.lfr.cell.nw:
        raise InputError(
            f"init_from is '{cfg.init_from}', a linear model: give the folder of a run of "
            "lfrtorch fit, or leave it out, as a fit starts from a linear model of its own."
        )
    for name, size in model.sizes.items():
        if cfg[name] not in (size, None):
            print(
                f"note: {name} is {size}, that of the model in '{cfg.init_from}', not {cfg[name]}"
            )
    return model


def loaded(cfg: DictConfig) -> Dataset:
    """The records; notes on them are printed, and kept for the report."""
    dataset: Dataset = decided(instantiate(cfg.data))
    measured = [record for record in dataset.train if record.source == "file"]
    given = dict(cfg.get("bla") or {})
    if not cfg.get("feedthrough", True):
        given["feedthrough"] = False
    if cfg.get("noise", "output") != "output":
        given["refine"] = given.get("refine") or "prediction"
    said = (*dataset.notes, *(notes_on(measured, given=given) if measured else ()))
    notes = tuple(map(as_words, said))
    for note in notes:
        print(in_lines(f"note: {note}"))
    return replace(dataset, notes=notes)
