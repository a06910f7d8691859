"""A trained model as files of another tool.

lfrtorch export checkpoint=runs/run/DATE to=c name=engine out=firmware
"""

from __future__ import annotations

import hydra
import numpy as np
from omegaconf import DictConfig

from lfrtorch import export
from lfrtorch._support.errors import InputError
from lfrtorch.cli import CONF
from lfrtorch.cli.composition import take_words
from lfrtorch.cli.errors import user_errors
from lfrtorch.cli.hydra_versions import MAIN
from lfrtorch.cli.simulate import introduced, opened
from lfrtorch.extended_kalman_filter import NoiseCovariance


def written(cfg: DictConfig) -> None:
    """Write the files, and say how they are used."""
    if cfg.checkpoint is None:
        raise InputError(
            "checkpoint is not set: add checkpoint=DIR, the folder of a run or of a saved model."
        )
    if cfg.to is None:
        raise InputError(f"to is not set: add to=c, or another of {', '.join(export.TARGETS)}.")
    model = opened(str(cfg.checkpoint))
    print(introduced(str(cfg.checkpoint), model))
    name, observer = str(cfg.name), observer_of(cfg)
    paths = export.write(
        model, str(cfg.to), cfg.out, name=name, overwrite=cfg.overwrite, observer=observer
    )
    print(f"written: {', '.join(map(str, paths))}")
    print(f"use: {export.TARGETS[cfg.to].use.format(name=name, path=paths[0])}")


def observer_of(cfg: DictConfig) -> bool | NoiseCovariance:
    """The observer that is asked for: with Q and R an extended Kalman filter."""
    Q, R = cfg.Q, cfg.R
    if Q is None and R is None:
        return bool(cfg.observer)
    if Q is None or R is None or not cfg.observer:
        raise InputError("Q and R are the noise of a Kalman filter: give observer=true Q=... R=...")
    return NoiseCovariance(np.array(Q, dtype=float), np.array(R, dtype=float))


@hydra.main(**MAIN, config_path=str(CONF), config_name="export")
def main(cfg: DictConfig) -> None:
    """The command line."""
    with user_errors(cfg=cfg):
        written(cfg)


def launch() -> None:
    """The command."""
    with user_errors():
        take_words("export")
    main()
