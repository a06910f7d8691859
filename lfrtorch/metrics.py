"""Scores of a simulated output against a measured one, in physical units, after the skip window."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lfrtorch.records import Record


def rmse(record: Record, y_hat: NDArray[np.float64]) -> float:
    """Root mean squared simulation error over scored samples and outputs, in the output's unit."""
    error = record.y[record.skip :] - y_hat[record.skip :]
    return float(np.sqrt(np.mean(error**2)))


def nrmse(record: Record, y_hat: NDArray[np.float64]) -> float:
    """RMSE over the standard deviation of the measured output, both over the scored samples."""
    return rmse(record, y_hat) / float(np.sqrt(np.mean(np.var(record.y[record.skip :], axis=0))))
