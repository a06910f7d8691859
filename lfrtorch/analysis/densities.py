"""Power spectral densities of signals, and of the noise that repeated periods show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from jaxtyping import Float

from lfrtorch._support.types import Array
from lfrtorch.data.records import Record
from lfrtorch.linear.spectra import Spectra, spectra_of_periods

_SEGMENT = 4096
"""Largest number of samples of a segment of Welch's method."""

SHORTEST = 16
"""Smallest number of samples of a segment of Welch's method."""

_STRETCHES = 256
"""Largest number of frequencies of the noise density; each is a mean over neighbouring lines."""


@dataclass(frozen=True, eq=False)
class Densities:
    """Power spectral densities in the output's unit squared per Hz.

    Args:
        frequencies: frequencies of output and error, Hz.
        output, error: measured output and error.
        noise_frequencies, noise: from the differences between periods, if the record repeats.
    """

    frequencies: Float[Array, " F"]
    output: Float[Array, " F"]
    error: Float[Array, " F"]
    noise_frequencies: Float[Array, " K"] | None = None
    noise: Float[Array, " K"] | None = None


def power_density(
    signals: Float[Array, "T n"], fs: float
) -> tuple[Float[Array, " F"], Float[Array, "F n"]]:
    """Frequencies in Hz and power spectral densities of signals, by Welch's method."""
    T = len(signals)
    segment = min(_SEGMENT, T, max(SHORTEST, T // 8))
    f, density = scipy.signal.welch(signals, fs, nperseg=segment, axis=0)
    return f, density


def noise_of_periods(records: Sequence[Record]) -> Float[Array, " ny"] | None:
    """Standard deviation of the outputs' noise from steady differences of periods, or None."""
    spectra = _steady_spectra(records)
    return None if spectra is None else np.sqrt(_noise_power(spectra).sum(axis=0))


def noise_density(
    record: Record,
) -> tuple[Float[Array, " F"], Float[Array, "F ny"], Float[Array, " ny"]] | None:
    """Frequencies in Hz, power spectral densities and rms of the noise between periods, or None."""
    spectra = _steady_spectra([record])
    if spectra is None:
        return None
    power = _noise_power(spectra)
    width = -(-len(power) // _STRETCHES)
    whole = len(power) // width * width
    lines = np.arange(1, len(power) + 1)
    f = spectra.frequencies(lines)[:whole].reshape(-1, width).mean(axis=1)
    density = power[:whole].reshape(len(f), width, -1).mean(axis=1) / spectra.resolution
    return f, density, np.sqrt(power.sum(axis=0))


def _steady_spectra(records: Sequence[Record]) -> Spectra | None:
    """Spectra of periods if these differ by noise alone, or None."""
    try:
        spectra = spectra_of_periods(records)
    except ValueError:
        return None
    steady = spectra.freedom and all(_steady(record, spectra.N) for record in records)
    return spectra if steady else None


def _noise_power(spectra: Spectra) -> Float[Array, "F ny"]:
    """Variance of the noise of the outputs at lines 1, 2, ..."""
    return np.diagonal(spectra.C, axis1=1, axis2=2).real[1:, : spectra.Y.shape[2]]


def _steady(record: Record, N: int) -> bool:
    """Tell if the differences of successive periods of N samples have a steady power over time.

    The first of two periods may have a transient, which is not noise.
    """
    count = (record.samples - record.skip) // N
    if count < 2:
        return True
    periods = record.y[record.samples - count * N :].reshape(count, N, -1)
    power = np.diff(periods, axis=0).reshape((count - 1) * N, -1) ** 2
    tenths = np.array([part.mean(axis=0) for part in np.array_split(power, min(10, len(power)))])
    return bool(np.all(tenths.max(axis=0) <= 4.0 * np.median(tenths, axis=0)))
