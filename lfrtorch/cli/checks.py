"""Checks of the settings of each command, before the slow import of torch."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np
from omegaconf import DictConfig, ListConfig, OmegaConf

from lfrtorch._support.arguments import is_of, wanted
from lfrtorch._support.checks import integer, number, true_or_false
from lfrtorch._support.errors import InputError
from lfrtorch._support.settings import check_settings
from lfrtorch.files.writer import FORMATS
from lfrtorch.fitting.exclusions import USUAL, refuse_together
from lfrtorch.fitting.plain_settings import PlainSettings
from lfrtorch.least_squares.options import AdamOptions, LevenbergMarquardtOptions

_SIZES = {"nx", "nz", "nw", "nn", "degree"}


def require_data(cfg: DictConfig) -> None:
    """Refuse a command without data, and say how data are chosen."""
    if cfg.get("data") is None:
        raise InputError(
            "no data chosen: add +bench=boucwen, or a file and its columns, "
            "x.csv inputs=force outputs=disp fs=HZ nx=ORDER (or nx=auto)."
        )


def check_plain(cfg: DictConfig) -> None:
    """Refuse settings that have a wrong type, are beyond their limits, or exclude each other."""
    require_data(cfg)
    plain: Any = OmegaConf.to_container(cfg, resolve=True)
    plain["known"] = plain["known"]["_target_"]
    brought = any(plain[n] is not None for n in ("init_from", "update", "known"))
    if cfg.nx is None and not brought:
        raise InputError(
            "nx, the number of states, is not set: add nx=2, for example, or nx=auto "
            "(+bench=boucwen sets it and all else for that benchmark)."
        )
    for name in ("figures", "overwrite"):
        true_or_false(name, cfg[name])
    if cfg.threads is not None:
        integer("threads", cfg.threads, 1)
    if cfg.dtype not in ("float32", "float64"):
        raise InputError(f"dtype is {cfg.dtype}; give float64 or float32.")
    check_settings(_of_types(PlainSettings, plain), without=_SIZES if brought else ())
    trainer = plain["trainer"]
    of_adam = str(trainer.get("_target_")).endswith("Adam")
    try:
        _of_types(AdamOptions if of_adam else LevenbergMarquardtOptions, trainer)
    except InputError as error:
        raise InputError(f"trainer: {error}") from None
    plain |= {"static": plain["static"]["kind"], "guarantee": trainer.get("guarantee")}
    bare = {"static", "structure", *_SIZES} if plain["init_from"] else set[str]()
    refuse_together(**{name: plain[name] for name in {*USUAL} & {*plain} - bare})


def _of_types(kind: Any, values: dict[str, Any]) -> Any:
    """Return the declared settings among the values; refuse a wrong type."""
    hints, given = get_type_hints(kind), {}
    for one in fields(kind):
        if one.name in values and not isinstance(values[one.name], dict):
            given[one.name] = value = values[one.name]
            if not (one.metadata["limits"] or is_of(value, hints[one.name])):
                raise InputError(f"{one.name} is {value!r}; give {wanted(hints[one.name])}.")
    return kind(**given)


def check_checkpoint(cfg: DictConfig) -> None:
    """Refuse a command that needs a model if ``checkpoint`` is not set."""
    if cfg.checkpoint is None:
        raise InputError(
            "checkpoint is not set: add checkpoint=DIR, the folder of a run or of a saved model."
        )


def check_simulation(cfg: DictConfig) -> None:
    """Refuse settings of ``simulate`` that are missing or wrong."""
    check_checkpoint(cfg)
    for option, value, example in (
        ("data.path", cfg.data.path, "FILE, the file of inputs"),
        ("out", cfg.out, "FILE.csv, which is written, or for several files a FOLDER"),
    ):
        if value is None:
            raise InputError(f"{option} is not set: add {option}={example}.")
    if isinstance(cfg.out, DictConfig | ListConfig):
        raise InputError(f"out is {cfg.out}; give a file or a folder.")
    if cfg.start not in ("zero", "given", "estimated", "measured"):
        raise InputError(
            f"start is {cfg.start!r}; give zero, given (with x0=[...]), estimated or measured."
        )
    if (cfg.start == "given") != (cfg.x0 is not None):
        raise InputError(
            f"start is {cfg.start!r} and x0 is {cfg.x0}; "
            "give a start state x0 with start=given, and only then."
        )
    x0 = cfg.x0 if isinstance(cfg.x0, ListConfig | None) else [None]
    if not all(isinstance(x, int | float) and np.isfinite(x) for x in x0 or []):
        raise InputError(f"x0 is {cfg.x0}; give a list of finite numbers, one for each state.")
    for name, least in (("estimate", 1), ("skip", 0)):
        if cfg[name] is not None:
            integer(name, cfg[name], least)
    if cfg.data.fs is not None:
        number("data.fs", cfg.data.fs, positive=True)
    if f".{cfg.format}" not in FORMATS:
        raise InputError(f"format is {cfg.format!r}; give csv, npz or parquet.")


def check_evaluation(cfg: DictConfig) -> None:
    """Refuse settings of ``evaluate`` that are missing or wrong."""
    check_checkpoint(cfg)
    require_data(cfg)
    if cfg.out is not None and Path(str(cfg.out)).suffix.lower() != ".json":
        raise InputError(f"out is '{cfg.out}'; the scores are JSON: name it FILE.json.")


def check_preview(cfg: DictConfig) -> None:
    """Refuse a preview without a file."""
    if (cfg.get("data") or {}).get("path") is None:
        raise InputError("no file is named; give its path, or path=FILE.")


CHECKS = {
    "config": check_plain, "linear": check_plain, "evaluate": check_evaluation,
    "simulate": check_simulation, "export": check_checkpoint, "preview": check_preview,
}  # fmt: skip
"""The check of each command, by its file in ``conf/``."""
