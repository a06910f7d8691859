"""A trained model as files of another tool.

lfrtorch export checkpoint=runs/run to=c name=engine out=firmware
"""

from __future__ import annotations

from typing import Any

import numpy as np
from omegaconf import DictConfig

import lfrtorch
from lfrtorch import export
from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array
from lfrtorch.cli.checks import check_checkpoint
from lfrtorch.cli.errors import user_errors
from lfrtorch.cli.simulate import introduced
from lfrtorch.linear.model import LinearModel
from lfrtorch.model.extended_kalman_filter import NoiseCovariance
from lfrtorch.model.model import Model


def written(cfg: DictConfig) -> None:
    """Write the files, and print how they are used."""
    check_checkpoint(cfg)
    if cfg.to is None:
        raise InputError(f"to is not set: add to=c, or another of {', '.join(export.TARGETS)}.")
    model = lfrtorch.load(str(cfg.checkpoint))
    print(introduced(cfg.checkpoint, model))
    name, observer = str(cfg.name), observer_of(cfg, model)
    paths = export.write(
        model, str(cfg.to), cfg.out, name=name, overwrite=cfg.overwrite, observer=observer,
        disturbance=cfg.disturbance,
    )  # fmt: skip
    print(f"written: {', '.join(map(str, paths))}")
    print(f"use: {export.TARGETS[cfg.to].usage(name, paths, observer)}")


def observer_of(cfg: DictConfig, model: Model | LinearModel) -> bool | NoiseCovariance:
    """The observer that the settings ask for; with Q and R an extended Kalman filter."""
    if cfg.Q is None and cfg.R is None:
        if cfg.observer and model.K is None:
            raise InputError(
                "this model has no innovation gain K: give Q=... R=..., the noise of a Kalman "
                "filter, or fit it with noise=innovation."
            )
        return bool(cfg.observer)
    if cfg.Q is None or cfg.R is None or not cfg.observer:
        raise InputError("Q and R are the noise of a Kalman filter: give observer=true Q=... R=...")
    return NoiseCovariance(_variances("Q", cfg.Q), _variances("R", cfg.R))


def _variances(name: str, given: Any) -> Array:
    """One variance, or a list of variances."""
    try:
        return np.array(given, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(
            f"{name} is {given}; give a variance or a list, {name}=1e-4 or {name}=[1e-4,1e-3]. "
            "lfrtorch.estimate_noise finds them in Python."
        ) from None


main = user_errors()(written)
"""The command."""
