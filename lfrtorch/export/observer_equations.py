"""The observer of a model in physical units: what the exports of observers write down."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array
from lfrtorch.export.equations import numbers
from lfrtorch.extended_kalman_filter import NoiseCovariance, data_root
from lfrtorch.linear.model import LinearModel
from lfrtorch.model import NO_OBSERVER, Model


@dataclass(frozen=True, eq=False)
class SteadyGain:
    """x+ = f(x, u) + K (y - y_hat), K: (nx, ny)."""

    K: Array


@dataclass(frozen=True, eq=False)
class KalmanNoise:
    """G Gᵀ = [R Sᵀ; S Q], and U Uᵀ = P0, that of the states over the training data.

    G: (ny + nx, ny + nx), U: (nx, nx).
    """

    G: Array
    U: Array


def observer_equations(
    model: Model | LinearModel, observer: bool | NoiseCovariance
) -> SteadyGain | KalmanNoise | None:
    """What an observer has beside the model; None for no observer.

    Raises:
        ValueError: a gain that the model has not, or covariances that are none.
    """
    if observer is False:
        return None
    model = model.to_model() if isinstance(model, LinearModel) else model
    if isinstance(observer, NoiseCovariance):
        cell = model.lfr.cell
        return KalmanNoise(observer.root(cell.nx, cell.ny), data_root(cell))
    if model.K is None:
        raise InputError(NO_OBSERVER)
    return SteadyGain(np.ascontiguousarray(numbers(model.K) / model.scaler.y_scale))
