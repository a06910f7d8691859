"""Scores of a simulated output against a measured one, in physical units, after the skip window."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lfrtorch.records import Record


def rmse(record: Record, y_hat: NDArray[np.float64]) -> float:
    """Root mean squared simulation error over scored samples and outputs, in the output's unit.

    Raises:
        ValueError: ``y_hat`` is not of the shape (T, ny) of the record's output.
    """
    if np.shape(y_hat) != record.y.shape:
        raise ValueError(
            f"record '{record.name}' has an output of shape {record.y.shape} and the simulation "
            f"{np.shape(y_hat)}; simulate this record."
        )
    error = record.y[record.skip :] - y_hat[record.skip :]
    return float(np.sqrt(np.mean(error**2)))


def nrmse(record: Record, y_hat: NDArray[np.float64]) -> float:
    """RMSE over the standard deviation of the measured output, both over the scored samples.

    NaN for an output that is constant there.
    """
    deviation = float(np.sqrt(np.mean(np.var(record.y[record.skip :], axis=0))))
    return rmse(record, y_hat) / deviation if deviation > 0 else float("nan")
