"""Spectra of records by period, and the DFT lines at which their inputs have power.

A periodic signal has power at the lines of its period alone, and a steady state repeats. So the
mean over the periods of a record is its signal, and the scatter of the periods about the mean is
noise. A response can be estimated only at lines that the inputs excite; they are found by their
power, compared to the strongest line and to the noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex128, Float, Int64
from numpy.typing import ArrayLike

from lfrtorch._support.checks import dft_lines
from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array, Booleans, Complex, Integers
from lfrtorch.data.records import Record
from lfrtorch.linear.regression import outer

RELATIVE_POWER = 1e-4
"""Smallest power of each input at an excited line, relative to its strongest line: -40 dB."""

NOISE_LINES = 21
"""Number of neighbouring lines over which noise is averaged."""

_NO_POWER = 1e-12
"""An input has no power at a line if it has less than this part of its strongest line's power."""

SILENT = 1e-10
"""Relative amplitude of the input below which a line is not excited."""


class Spectra(NamedTuple):
    """Spectra Y = √2 / N · DFT of R records, lines 0 to N / 2.

    So |Y|² is the mean square of the sine at a line, and their sum the variance of the signal.
    """

    U: Complex128[Complex, "F R nu"]  # means over the periods of a record
    Y: Complex128[Complex, "F R ny"]
    C: Complex128[Complex, "F ny+nu ny+nu"]  # covariance of the noise of [Y, U] in one period
    freedom: int  # degrees of freedom of C; C is 0 if there are none
    P: Int64[Integers, " R"]  # periods of each record
    N: int  # samples of a period
    resolution: float  # fs / N, Hz
    reference: Complex128[Complex, "F R nu"] | None = None

    @property
    def excitation(self) -> Complex128[Complex, "F R nu"]:
        """Signals that excite the system: the references, which have no noise, or the inputs."""
        return self.U if self.reference is None else self.reference

    def frequencies(self, lines: Int64[Integers, " F"]) -> Float[Array, " F"]:
        """Frequencies of the lines, Hz."""
        return np.asarray(lines * self.resolution, dtype=np.float64)


def spectra_of_periods(data: Sequence[Record]) -> Spectra:
    """Return the spectra of the last whole periods after ``skip``."""
    N = _period(data[0])
    windows = []
    for record in data:
        if _period(record) != N:
            raise InputError(
                f"records '{data[0].name}' and '{record.name}' have periods of {N} and "
                f"{_period(record)} samples; give records of one period."
            )
        count = (record.samples - record.skip) // N
        if not count:
            raise InputError(
                f"record '{record.name}': skip={record.skip} leaves less than one period of {N} "
                f"out of {record.samples} samples; skip less or measure longer."
            )
        windows.append(slice(record.samples - count * N, record.samples))
    return _spectra(data, windows, N)


def spectra_of_records(data: Sequence[Record]) -> Spectra:
    """Return the spectra after ``skip``, over as many samples as the shortest record has there."""
    N = min(record.samples - record.skip for record in data)
    return _spectra(data, [slice(record.skip, record.skip + N) for record in data], N)


def _period(record: Record) -> int:
    if record.period is None and record.start != "periodic":
        raise InputError(
            f"record '{record.name}' has no period; give period=N, or use "
            "method='local_polynomial'."
        )
    return int(record.period or record.samples)


def _spectra(data: Sequence[Record], windows: list[slice], N: int) -> Spectra:
    """Return the spectra of whole periods of N samples in a window of each record."""
    if N < 3:
        raise InputError(f"{N} samples have no line between 0 and fs / 2; give more.")
    known = given_references(data)
    excitation = [record.u if r is None else r for record, r in zip(data, known, strict=True)]
    constant = np.all(
        [np.ptp(e[window], axis=0) == 0 for e, window in zip(excitation, windows, strict=True)],
        axis=0,
    )
    if constant.any():
        what = "input" if known[0] is None else "the reference of input"
        raise InputError(
            f"{what} '{data[0].inputs[int(np.argmax(constant))].name}' is constant in each record: "
            "a spectrum does not show what it does; give records in which it moves, or leave it "
            "out if it is the same in all."
        )
    ny = data[0].y.shape[1]
    size = ny + data[0].u.shape[1]
    C = np.zeros((N // 2 + 1, size, size), np.complex128)
    means, references, P, changes, freedom = [], [], [], [], 0
    for record, window, excited in zip(data, windows, excitation, strict=True):
        record.require_all_valid("a spectrum")
        signals = np.concatenate([record.y[window], record.u[window]], axis=1)
        Z = np.fft.rfft(signals.reshape(-1, N, size), axis=1) * (np.sqrt(2) / N)
        mean = Z.mean(axis=0)
        E = np.fft.rfft(excited[window].reshape(-1, N, size - ny), axis=1) * (np.sqrt(2) / N)
        references.append(E.mean(axis=0))
        # Line 0 is left out: a drift of the offset is not a change of the input.
        changes.append(
            np.sum(np.abs(E - references[-1])[:, 1:] ** 2, axis=(0, 1)) / max(len(Z) - 1, 1)
        )
        if len(Z) > 1:
            C += outer((Z - mean).swapaxes(0, 1))
        freedom += len(Z) - 1
        means.append(mean)
        P.append(len(Z))
    both = np.stack(means, axis=1)
    Y, U = both[:, :, :ny], both[:, :, ny:]
    R = np.stack(references, axis=1)
    rms = np.sqrt(np.sum(np.abs(R[1:]) ** 2, axis=(0, 1)) / len(data))
    change = np.sqrt(changes) / rms
    if change.max() > 0.1:
        r, channel = (int(i) for i in np.unravel_index(np.argmax(change), change.shape))
        raise InputError(
            f"record '{data[r].name}': the periods of {N} samples of input "
            f"'{data[r].inputs[channel].name}' deviate from their mean by "
            f"{100 * change[r, channel]:.0f} %; give period=N, skip=N or "
            "method='local_polynomial',\nor the reference of an input with noise."
        )
    C /= max(freedom, 1)
    reference = None if known[0] is None else R
    return Spectra(U, Y, C, freedom, np.array(P), N, data[0].fs / N, reference)


def given_references(data: Sequence[Record]) -> list[Array | None]:
    """Return the references of the records; all records must have one, or none."""
    with_one = [record.name for record in data if record.reference is not None]
    without = [record.name for record in data if record.reference is None]
    if with_one and without:
        raise InputError(
            f"record '{with_one[0]}' has a reference and '{without[0]}' has none; give all records "
            "one, or none."
        )
    return [record.reference for record in data]


def excited_lines(spectra: Spectra, data: Sequence[Record], given: ArrayLike | None) -> Integers:
    """Return the lines between 0 and fs / 2 at which all inputs are excited, or the given ones."""
    last = (spectra.N - 1) // 2
    inputs = data[0].inputs
    power = np.mean(np.abs(spectra.excitation[1 : last + 1]) ** 2, axis=1)  # (lines, nu), from 1
    if given is not None:
        lines = dft_lines(given, spectra.N)
        weak = np.argwhere(power[lines - 1] <= _NO_POWER * power.max(axis=0))
        if weak.size:
            line, channel = weak[0]
            raise InputError(
                f"input '{inputs[channel].name}' has no power at line {lines[line]}; give lines "
                "at which all inputs are excited."
            )
        return lines
    noise = np.diagonal(spectra.C, axis1=1, axis2=2).real[1 : last + 1, -len(inputs) :]
    noise = noise if spectra.reference is None else np.zeros_like(noise)
    shown = smoothed(noise, NOISE_LINES) * np.mean(1 / spectra.P)
    # With two periods of one record, noise at a line exceeds 30 times its mean once in 1e8.
    excited = power > np.maximum(RELATIVE_POWER * power.max(axis=0), 30.0 * shown)
    if not noise.any():  # one period does not tell noise from a weak line
        excited &= np.stack([carrying(channel) for channel in power.T], axis=1)
    lines = 1 + np.flatnonzero(excited.all(axis=1))
    if not lines.size:
        counts = zip(inputs, excited.sum(axis=0), strict=True)
        raise InputError(
            "no line is excited in every input (lines excited: "
            + ", ".join(f"{count} in '{channel.name}'" for channel, count in counts)
            + "); give the lines, or excite all inputs at the same ones."
        )
    return lines


def carrying(power: Array) -> Booleans:
    """Return which lines the input is meant to excite, by their power (F,).

    Sorted by power, these lines end where the next line has less than a hundredth: a measured
    input has noise, hum and distortion at the lines that its generator leaves out. One or two
    lines of a random input are as weak, and count; three are as weak once in 1e6.
    """
    order = np.argsort(-power, kind="stable")
    ranked = power[order]
    loud = int((ranked > SILENT**2 * power.max(initial=0.0)).sum())
    gaps = 1 + np.flatnonzero(ranked[1:loud] < 1e-2 * ranked[: max(0, loud - 1)])
    ends = [int(end) for end in gaps if loud - end >= 3]
    excited = np.zeros(len(power), dtype=bool)
    excited[order[: min([loud, *ends])]] = True
    return excited


def powered_lines(spectra: Spectra, n: int) -> Integers:
    """Return the lines between 0 and fs / 2 about which, within n lines, all inputs have power."""
    last = (spectra.N - 1) // 2
    power = smoothed(np.mean(np.abs(spectra.excitation[1 : last + 1]) ** 2, axis=1), 2 * n + 1)
    return 1 + np.flatnonzero((power > _NO_POWER * power.max(axis=0)).all(axis=1))


def smoothed(power: Array, width: int) -> Array:
    """Means (F, n) of the power over ``width`` lines about each one, over fewer at the ends."""
    window = np.ones(min(width, len(power)))
    count = np.convolve(np.ones(len(power)), window, "same")
    return np.stack([np.convolve(channel, window, "same") / count for channel in power.T], axis=1)


def without_noise(
    power: Complex128[Complex, "F nu nu"], noise: Complex128[Complex, "F nu nu"]
) -> tuple[Complex128[Complex, "F nu nu"] | None, Bool[Booleans, " F"]]:
    """Return UᴴU without the noise of the inputs, and the lines that keep more than half of it.

    At other lines it is the unit matrix. It is ``None`` if the inputs have no noise.
    """
    clear = np.ones(len(power), dtype=bool)
    if not np.abs(noise).max(initial=0.0) > 1e-24 * np.abs(power).max(initial=0.0):
        return None, clear  # only rounding changes from period to period
    left = power - noise
    clear = np.linalg.eigvalsh(left)[:, 0] > 0.5 * np.linalg.eigvalsh(power)[:, 0]
    return np.where(clear[:, None, None], left, np.eye(power.shape[1])), clear


def in_band(lines: Integers, resolution: float, band: tuple[float, float] | None) -> Integers:
    """Return the lines in a band of frequencies in Hz, or all of them."""
    if band is None:
        return lines
    inside = lines[(lines * resolution >= band[0]) & (lines * resolution <= band[1])]
    if not inside.size:
        raise InputError(
            f"no line from {band[0]} to {band[1]} Hz is excited; the excited ones go from "
            f"{lines[0] * resolution:g} to {lines[-1] * resolution:g} Hz."
        )
    return inside
