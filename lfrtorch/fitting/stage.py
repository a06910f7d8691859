"""What the stages of a job share: sizes, a first part, the fit, one model for a mean, a refit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypedDict, cast

from lfrtorch.dataset import Dataset
from lfrtorch.fitting.observer import Observer
from lfrtorch.fitting.plain_settings import Noise
from lfrtorch.fitting.settings import Settings
from lfrtorch.fitting.trainer import Stop, Trainer
from lfrtorch.least_squares.ridge import Ridge


class FitOptions(TypedDict):
    """Keywords of every fit of a job, see :func:`lfrtorch.fit`."""

    trainer: Trainer
    ridge: Ridge
    noise: Noise
    horizon: int | None
    stop: Stop | None


@dataclass(frozen=True)
class Stage:
    """What a stage is given, and hands on; the settings are as far as they are chosen."""

    dataset: Dataset
    settings: Settings
    observer: Observer
    stop: Stop | None

    @property
    def options(self) -> FitOptions:
        """Keywords of its fit."""
        return {
            "trainer": self.settings.trainer,
            "ridge": cast(Ridge, self.settings.ridge),  # chosen before a fit begins
            "noise": self.settings.noise,
            "horizon": self.settings.horizon,
            "stop": self.stop,
        }
