"""Scores of a simulated against a measured output, in physical units, after the skipped samples."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from lfrtorch._support.arguments import typed
from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array
from lfrtorch.data.records import Record


def rms(signal: ArrayLike, axis: int | None = None) -> Array:
    """Root mean square of all values, or along an axis; not finite if the signal diverges."""
    with np.errstate(over="ignore", invalid="ignore"):
        return np.sqrt(np.mean(np.square(signal), axis=axis))


@typed()
def rmse(record: Record, y_hat: Array) -> float:
    """Root mean squared simulation error over scored samples and outputs, in the output's unit.

    Raises:
        ValueError: ``y_hat`` is not of the shape (T, ny) of the record's output.

    Example:
        >>> lfrtorch.rmse(record, record.y + 0.5)
        0.5
    """
    if np.shape(y_hat) != record.y.shape:
        raise InputError(
            f"record '{record.name}' has an output of shape {record.y.shape} and the simulation "
            f"{np.shape(y_hat)}; simulate this record."
        )
    with np.errstate(over="ignore", invalid="ignore"):
        squares = np.square(record.errors(y_hat)).sum()
    return float(np.sqrt(squares / record.scored.sum()))


def rmse_by_output(record: Record, y_hat: Array) -> Array:
    """Return the RMSE of each output, (ny,); NaN for an output without a scored sample."""
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        squares = np.square(record.errors(y_hat)).sum(axis=0)
        return np.sqrt(squares / record.scored.sum(axis=0))


@typed()
def nrmse(record: Record, y_hat: Array) -> float:
    """RMSE over the standard deviation of the measured output, both over the scored samples.

    Each output is divided by its own standard deviation. The result is the root mean square over
    the outputs that are not constant; NaN if there are none.

    Example:
        >>> lfrtorch.nrmse(record, bla.simulate(record)) < 0.3
        True
    """
    outputs = [y[there] for y, there in zip(record.y.T, record.scored.T, strict=True)]
    # Subtract the first sample: std is exactly 0 for a constant, whose mean has rounding errors.
    deviations = np.array([np.std(y - y[0]) if len(y) else 0.0 for y in outputs])
    rmse(record, y_hat)  # refuses other shapes
    moved = deviations > 0
    if not moved.any():
        return float("nan")
    return float(rms(rmse_by_output(record, y_hat)[moved] / deviations[moved]))


class BlockScores:
    """Scores of each output (ny,) over blocks of samples, without the first ``skip``.

    Only sums are kept in memory. A sample without a measurement (NaN) does not count.
    """

    def __init__(self, ny: int, skip: int = 0) -> None:
        self.samples = np.zeros(ny, dtype=np.int64)
        """Number of samples that count, by output."""
        self._skip = skip
        self._mean, self._spread, self._errors = np.zeros((3, ny))

    def add(self, y: Array, y_hat: Array) -> None:
        """Add the next samples (n, ny), measured and simulated."""
        left_out = min(self._skip, len(y))
        self._skip -= left_out
        y, y_hat = y[left_out:], y_hat[left_out:]
        if not len(y):
            return
        there = np.isfinite(y)
        added = there.sum(axis=0)
        first = (self.samples == 0) & (added > 0)
        # Then the samples of a constant do not deviate from the mean so far.
        self._mean[first] = y[there.argmax(axis=0), np.arange(len(first))][first]
        whole = np.maximum(self.samples + added, 1)
        y = np.where(there, y, self._mean)
        # Deviations from the mean so far, by the update of Chan, Golub and LeVeque (1983): exact,
        # and without the cancellation of a sum of squares.
        shift = (y - self._mean).sum(axis=0) / np.maximum(added, 1)
        self._spread += np.where(there, (y - self._mean - shift) ** 2, 0.0).sum(axis=0)
        self._spread += shift**2 * self.samples * added / whole
        self._mean += shift * added / whole
        self._errors += np.where(there, (y - y_hat) ** 2, 0.0).sum(axis=0)
        self.samples += added

    @property
    def rmse(self) -> Array:
        """Root mean squared errors, NaN if no sample counts."""
        return np.sqrt(self._mean_of(self._errors))

    @property
    def nrmse(self) -> Array:
        """RMSE over the standard deviation of the measured output, NaN for a constant one."""
        deviation = np.sqrt(self._mean_of(self._spread))
        return self.rmse / np.where(deviation > 0, deviation, np.nan)

    def _mean_of(self, total: Array) -> Array:
        return np.where(self.samples > 0, total / np.maximum(self.samples, 1), np.nan)
