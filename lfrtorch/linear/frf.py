"""Nonparametric best linear approximation: frequency response, noise and nonlinear distortion.

The best linear approximation (BLA) of a nonlinear system is the linear system with the nearest
output, for inputs of one spectrum. The unexplained rest is of two kinds. Noise changes from
period to period of the same input. Nonlinear distortion is the same in every period, but looks like
noise over frequency and changes from one realisation of the input to the next. So periods and
realisations together tell how much of an error is noise, and how much a nonlinear model can hope to
explain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from jaxtyping import Complex128, Float
from numpy.typing import ArrayLike

from lfrtorch._support import checks
from lfrtorch._support.arguments import typed
from lfrtorch._support.checks import dft_lines, integer
from lfrtorch._support.errors import InputError
from lfrtorch._support.threads import spread_by_hand
from lfrtorch._support.types import Array, Complex, Integers
from lfrtorch.data.records import Channel, Record, as_records
from lfrtorch.linear.local_polynomial import WindowErrors, fit_local_polynomials, half_width
from lfrtorch.linear.realisations import united
from lfrtorch.linear.regression import Regression, covariance, divided, outer, regress
from lfrtorch.linear.spectra import (
    Spectra,
    excited_lines,
    in_band,
    powered_lines,
    spectra_of_periods,
    spectra_of_records,
    without_noise,
)

Method = Literal["auto", "robust", "fast", "local_polynomial"]


@dataclass(frozen=True, eq=False)
class Level:
    """Power of the outputs at some lines, and how much of it is noise.

    A power is a mean square in squared units of the output: |Y|² of Y = √2 / N · DFT over one
    period, so that the powers of all lines add up to the variance of the signal.

    Args:
        frequencies: frequencies of the lines, Hz.
        power: power of the mean over the periods, as a mean over the records.
        noise: expected power of the disturbing noise in ``power``.
    """

    frequencies: Float[Array, " F"]
    power: Float[Array, "F ny"]
    noise: Float[Array, "F ny"]

    @property
    def distortion(self) -> Array:
        """Power beyond the noise, at least 0."""
        return np.maximum(self.power - self.noise, 0.0)


@dataclass(frozen=True, eq=False)
class Distortion:
    """Nonlinear distortion at the output under an odd excitation, separated into even and odd.

    Args:
        output: the output at the excited lines.
        odd, even: the rest Y - G U at the odd and even lines that are not excited.
    """

    output: Level
    odd: Level
    even: Level


@dataclass(frozen=True, eq=False)
class FRF:
    """Best linear approximation at some frequencies, in physical units, with its covariances.

    The covariance at a line is E[d dᴴ] of the error d of vec(G) = ``G[f].reshape(-1)`` (output,
    then input). G is a mean over periods and experiments, and the covariance is that of the mean.

    Args:
        frequencies: Hz.
        G: frequency response.
        fs: sampling frequency in Hz.
        u_offset, y_offset: means of the records.
        inputs, outputs: channel names and units.
        cov_noise: covariance due to the disturbing noise, ``None`` if not available.
        cov_total: covariance due to noise and stochastic nonlinear distortion together, likewise.
        experiments: number of records; records of one realisation count as one.
        periods: smallest number of periods of an experiment; 1 for records without periods.
        method: ``"robust"``, ``"fast"`` or ``"local_polynomial"``.
        distortion: levels at the output, from the fast method alone.
        notes: results that are not available, with the reason and a remedy.
        errors: map from independent errors to the errors of local polynomials, which are correlated
            as their windows share lines.

    Example:
        >>> frf = lfrtorch.estimate_frf(record)
        >>> frf.G.shape == (len(frf.frequencies), 1, 1), frf.method
        (True, 'robust')
        >>> bool(frf.frequencies[0] == frf.fs / 400)  # the first line of a period of 400 samples
        True
    """

    frequencies: Float[Array, " F"]
    G: Complex128[Complex, "F ny nu"]
    fs: float
    u_offset: Float[Array, " nu"]
    y_offset: Float[Array, " ny"]
    inputs: tuple[Channel, ...]
    outputs: tuple[Channel, ...]
    cov_noise: Complex128[Complex, "F ny*nu ny*nu"] | None
    cov_total: Complex128[Complex, "F ny*nu ny*nu"] | None
    experiments: int
    periods: int
    method: str
    distortion: Distortion | None = None
    notes: tuple[str, ...] = ()
    errors: WindowErrors | None = None

    @property
    def realisations(self) -> int:
        """Number M of independent realisations: whole blocks of nu experiments."""
        return self.experiments // len(self.inputs)

    @property
    def var_noise(self) -> Array | None:
        """Variance (F, ny, nu) of G due to the noise, or ``None``."""
        return self._variance(self.cov_noise)

    @property
    def var_total(self) -> Array | None:
        """Variance (F, ny, nu) of G due to noise and nonlinear distortion, or ``None``."""
        return self._variance(self.cov_total)

    @property
    def var_distortion(self) -> Array | None:
        """Variance (F, ny, nu) of G due to nonlinear distortion in one realisation, or ``None``.

        It is M (total - noise), at least 0, for M = experiments / nu realisations, so that it does
        not fall with their number. The floor at 0 makes it too high if there is little distortion.
        """
        total, noise = self.var_total, self.var_noise
        if total is None or noise is None:
            return None
        return np.maximum(total - noise, 0.0) * (self.experiments / len(self.inputs))

    def _variance(self, cov: Complex | None) -> Array | None:
        if cov is None:
            return None
        return np.diagonal(cov, axis1=1, axis2=2).real.reshape(self.G.shape)


@typed()
@spread_by_hand()
def estimate_frf(
    records: Record | Sequence[Record],
    *,
    method: Method = "auto",
    lines: ArrayLike | None = None,
    band: tuple[float, float] | None = None,
    order: int = 2,
) -> FRF:
    """Frequency response of the best linear approximation, and its variances as the data allow.

    ``"robust"``: the records are experiments with one period length, in steady state after
    ``skip``; the last whole periods of each are used. G is the least-squares fit of the spectra
    over the experiments (one input: the mean of their ratios weighted by input power). The
    scatter from period to period is noise; the scatter over experiments is noise and
    distortion. Experiments weigh equally, whatever their number of periods. The total covariance
    comes from the scatter of the blocks of nu experiments if these are orthogonal multisines;
    otherwise from the residuals, assumed to have the same covariance in all experiments.

    ``"fast"``: the same estimate from as little as one experiment, with a random odd multisine.
    At the odd lines that are not excited, the output minus the linear response is odd distortion
    and noise; interpolated, it gives the total covariance at the excited lines. Even distortion
    falls on even lines and does not disturb G.

    ``"local_polynomial"``: any excitation, transients included; records are cut to the shortest
    one. Only the sum of the variances of noise and distortion is known.

    ``"auto"``: robust if every record has periods, else local polynomials.

    Records of one realisation of the input do not show distortion, and count as periods of one
    experiment. If they have periods, the realisation may begin anywhere in its period.

    If the records have a ``reference`` r, G is the response from r to y over that from r to u, so
    that neither noise fed back by a controller nor noise of the input's sensor causes a bias.
    Without a reference the mean over periods removes most of such noise. The noise power that is
    left in the input is known from two periods or more, and is subtracted.

    Args:
        records: data. A record is periodic if it has a ``period`` or ``start="periodic"`` (one
            period long, unless ``period`` is given).
        method: see above.
        lines: numbers (F,) of DFT lines of the period (of the record, for local polynomials),
            0 < line < N / 2. Default: all excited lines, which the fast method needs.
        band: lowest and highest frequency in Hz. Default: all lines.
        order: order of the local polynomials.

    Raises:
        ValueError: a constant input, records with different periods or with none, an input that
            not repeat or leaves lines without power, too few experiments, periods or lines.

    Example:
        >>> design = lfrtorch.multisine(50, realisations=3)
        >>> records = []
        >>> for period in design.u:
        ...     u = np.tile(period, (3, 1))
        ...     y = signal.lfilter([0, 1], [1, -0.5], u + 0.1 * u**3, axis=0)
        ...     records.append(lfrtorch.Record(u, y, period=50, skip=50))
        >>> frf = lfrtorch.estimate_frf(records)
        >>> frf.experiments, frf.periods, frf.G.shape
        (3, 2, (24, 1, 1))
        >>> bool((frf.var_total > 1e6 * frf.var_noise).all())  # distortion, and no noise
        True

    References:
        Pintelon and Schoukens, "System Identification: A Frequency Domain Approach", 2nd ed.,
        2012, chapters 2 (with noise on the input and feedback), 3.4, 4.3 (robust and fast method)
        and 7 (local polynomial method).
    """
    data = as_records(records)
    integer("order", order, 0)
    if band is not None:
        checks.band(band)
        if not 0 <= band[0] <= band[1]:
            raise InputError(
                f"the band is {band[0]} to {band[1]} Hz; give a lower and an upper frequency."
            )
    if method == "auto":
        periodic = all(record.period or record.start == "periodic" for record in data)
        method = "robust" if periodic else "local_polynomial"
    if method == "local_polynomial":
        return _local_polynomial(data, lines, band, order)
    spectra = spectra_of_periods(data)
    chosen = in_band(excited_lines(spectra, data, lines), spectra.resolution, band)
    at_once = [
        f"noise: record '{record.name}' is used from its first sample on; a transient there counts "
        "as noise; skip=N leaves it out."
        for record, P in zip(data, spectra.P, strict=True)
        if record.start != "periodic" and record.samples == P * spectra.N and spectra.freedom
    ]
    spectra, data, notes = united(spectra, data, shifted=True)
    frf = (_robust if method == "robust" else _fast)(spectra, data, chosen)
    return replace(frf, notes=(*frf.notes, *notes, *at_once[:1]))


def _robust(spectra: Spectra, data: list[Record], lines: Integers) -> FRF:
    """Distortion from the scatter over experiments, noise from that over periods."""
    fitted = _response(spectra, lines)
    R, nu = spectra.U.shape[1:]
    spare = R - nu
    cov_noise = cov_total = None
    notes = []
    if spectra.freedom:
        cov_noise = _noise(spectra, lines, fitted)
    else:
        notes.append(
            "noise: not available from one period a record; two or more periods give it (period=N)."
        )
    if spare > 0:
        cov_total = _block_covariance(spectra, lines)
        if cov_total is None:
            cov_total = covariance(outer(fitted.residual) / spare, fitted.weights)
    else:
        notes.append(
            f"total: not available, as {R} experiment(s) of {nu} input(s) leave no freedom; "
            "more realisations give it, or a random odd multisine and method='fast'."
        )
    return FRF(
        spectra.frequencies(lines),
        fitted.G,
        cov_noise=cov_noise,
        cov_total=cov_total,
        method="robust",
        notes=tuple(notes),
        **_about(spectra, data),
    )


def _fast(spectra: Spectra, data: list[Record], lines: Integers) -> FRF:
    """Distortion from the lines that are not excited, noise from the scatter over periods."""
    if spectra.P.min() < 2:
        record = data[int(np.argmin(spectra.P))]
        raise InputError(
            f"record '{record.name}' has one period of {spectra.N} samples after skip; "
            "method='fast' needs two or more to know the noise."
        )
    advice = (
        "method='fast' needs a random odd multisine (lfrtorch.multisine, grid='random_odd'); "
        "or use method='robust'."
    )
    if (lines % 2 == 0).any():
        raise InputError(f"line {lines[lines % 2 == 0][0]} is even and excited; {advice}")
    left_out = np.setdiff1d(np.arange(lines[0], lines[-1]), lines)
    odd, even = left_out[left_out % 2 == 1], left_out[left_out % 2 == 0]
    if not odd.size:
        raise InputError(f"no odd line is left out between the excited ones; {advice}")
    fitted = _response(spectra, lines)

    def level(at: Integers, G: Complex) -> tuple[Level, Complex]:
        """Power of Y - G U at the lines, and its matrix (F, ny, ny)."""
        C = outer(spectra.Y[at] - spectra.U[at] @ G.swapaxes(1, 2)) / len(data)
        noise = _residual_noise(spectra.C[at], G) * np.mean(1 / spectra.P)
        return Level(spectra.frequencies(at), _diagonal(C), _diagonal(noise)), C

    output, _ = level(lines, np.zeros_like(fitted.G))
    odd_level, C_odd = level(odd, _interpolated(odd, lines, fitted.G))
    even_level, _ = level(even, _interpolated(even, lines, fitted.G))
    return FRF(
        spectra.frequencies(lines),
        fitted.G,
        cov_noise=_noise(spectra, lines, fitted),
        cov_total=covariance(_interpolated(lines, odd, C_odd), fitted.weights),
        method="fast",
        distortion=Distortion(output, odd_level, even_level),
        **_about(spectra, data),
    )


def _local_polynomial(
    data: list[Record],
    given: ArrayLike | None,
    band: tuple[float, float] | None,
    order: int,
) -> FRF:
    """Fit smooth functions of frequency; their residuals tell noise and distortion together."""
    spectra = spectra_of_records(data)
    cut = any(record.samples - record.skip > spectra.N for record in data)
    spectra, data, repeated = united(spectra, data, shifted=False)
    last = (spectra.N - 1) // 2
    # Covariances are then regular; with one output, a variance has a standard deviation of 45 %.
    freedom = len(data[0].outputs) + 4
    n = half_width(order, freedom, len(data[0].inputs), len(data))
    if 2 * n + 1 > last:
        raise InputError(
            f"{spectra.N} samples have {last} lines and a window of local polynomials takes "
            f"{2 * n + 1}; use longer records or a lower order."
        )
    lines = powered_lines(spectra, n)
    if given is not None:
        chosen = dft_lines(given, spectra.N)
        missing = np.setdiff1d(chosen, lines)
        if missing.size:
            raise InputError(
                f"an input has no power about line {missing[0]}; give lines about which all "
                "inputs are excited."
            )
        lines = chosen
    lines = in_band(lines, spectra.resolution, band)
    # Line 0 holds the offsets and stays out of all windows.
    driven, outputs = spectra.Y, None
    if spectra.reference is not None:
        driven, outputs = np.concatenate([spectra.Y, spectra.U], axis=2), spectra.Y.shape[2]
    inside = slice(1, last + 1)
    G, cov, determined, errors = fit_local_polynomials(
        spectra.excitation[inside], driven[inside], lines - 1, order=order, n=n, outputs=outputs
    )
    if not determined.any():
        raise InputError(
            "the inputs determine the response at no line: they depend on each other, excite too "
            "few lines, or follow the reference less than noise;\nuse richer inputs, another band "
            "or a lower order."
        )
    notes = [
        "noise: not told apart from nonlinear distortion without periods; two or more periods of "
        "a multisine tell them apart (period=N).",
        *repeated,
    ]
    if cut:
        notes.append(
            f"frequency response: the records were cut to the shortest one, {spectra.N} samples."
        )
    if not determined.all():
        weak = "" if outputs is None else ", or follow the reference less than noise"
        notes.append(
            f"{np.sum(~determined)} line(s) are left out: the inputs do not determine G{weak}."
        )
    return FRF(
        spectra.frequencies(lines[determined]),
        G[determined],
        cov_noise=None,
        cov_total=cov[determined],
        method="local_polynomial",
        notes=tuple(notes),
        errors=errors.at(determined),
        **_about(spectra, data),
    )


def _about(spectra: Spectra, data: list[Record]) -> dict[str, Any]:
    return {
        "fs": data[0].fs,
        "u_offset": np.mean(spectra.U[0].real, axis=0) / np.sqrt(2),
        "y_offset": np.mean(spectra.Y[0].real, axis=0) / np.sqrt(2),
        "inputs": data[0].inputs,
        "outputs": data[0].outputs,
        "experiments": len(data),
        "periods": int(spectra.P.min()),
    }


def _response(spectra: Spectra, lines: Integers) -> Regression:
    """G at the lines by least squares over the experiments; the rows are experiments."""
    R, nu = spectra.U.shape[1:]
    if nu > R:
        raise InputError(
            f"{R} record(s) cannot tell {nu} inputs apart at one line; give at least {nu} "
            "experiments (lfrtorch.multisine), or use method='local_polynomial'."
        )
    if spectra.reference is None:
        fitted = _without_noise(regress(spectra.U[lines], spectra.Y[lines], nu), spectra, lines)
    else:
        driven = np.concatenate([spectra.Y, spectra.U], axis=2)[lines]
        fitted = divided(regress(spectra.reference[lines], driven, nu), spectra.Y.shape[2])
    if not fitted.determined.all():
        line = lines[np.argmin(fitted.determined)]
        raise InputError(
            f"the inputs of the {R} experiments depend on each other at line {line} "
            f"({line * spectra.resolution:g} Hz); use orthogonal ones (lfrtorch.multisine), "
            "or leave the line out."
        )
    return fitted


def _without_noise(fitted: Regression, spectra: Spectra, lines: Integers) -> Regression:
    """Least squares with noisy inputs, without the bias that this noise causes.

    nu of the R experiments fit exactly, whatever the noise. So the share (R - nu) / R of the noise
    is left in UᴴU and UᴴY; it is subtracted, to first order in the noise.
    """
    U, Y = spectra.U[lines], spectra.Y[lines]
    R, nu = U.shape[1:]
    noise = spectra.C[lines].swapaxes(1, 2) * ((R - nu) / R * np.sum(1 / spectra.P))
    Uh = U.conj().swapaxes(1, 2)
    left, clear = without_noise(Uh @ U, noise[:, -nu:, -nu:])
    if left is None:
        return fitted
    both = np.concatenate([Uh @ Y - noise[:, -nu:, :-nu], Uh], axis=2)
    solved = np.asarray(np.linalg.solve(left, both), dtype=np.complex128)
    G, weights = solved[:, :, :-R].swapaxes(1, 2), solved[:, :, -R:]
    own = Regression(G, weights, Y - U @ G.swapaxes(1, 2), fitted.determined)
    pairs = zip(own, fitted, strict=True)
    return Regression(*(np.where(clear.reshape(-1, *[1] * (a.ndim - 1)), a, b) for a, b in pairs))


def _noise(spectra: Spectra, lines: Integers, fitted: Regression) -> Complex:
    """Covariance of vec(G) due to the noise; a mean over P periods divides it by P."""
    C = _residual_noise(spectra.C[lines], fitted.G)
    return covariance(C, fitted.weights / np.sqrt(spectra.P))


def _residual_noise(C: Complex, G: Complex) -> Complex:
    """Covariance (F, ny, ny) of the noise of Y - G U, from that of [Y, U]."""
    eye = np.broadcast_to(np.eye(G.shape[1]), (len(G), G.shape[1], G.shape[1]))
    H = np.concatenate([eye, -G], axis=2)
    return H @ C @ H.conj().swapaxes(1, 2)


def _block_covariance(spectra: Spectra, lines: Integers) -> Complex | None:
    """Covariance of the mean over blocks of orthogonal experiments, ``None`` for other designs."""
    R, nu = spectra.U.shape[1:]
    M = R // nu
    if nu == 1 or R % nu or spectra.reference is not None:  # the residuals give the same
        return None
    X = spectra.U[lines].reshape(len(lines), M, nu, nu)  # (line, block, experiment, input)
    products = X.conj().swapaxes(2, 3) @ X
    power = np.diagonal(products[:, :1], axis1=2, axis2=3).real  # of the first block
    unit = products / np.sqrt(power[..., :, None] * power[..., None, :])
    if np.abs(unit - np.eye(nu)).max() > 1e-6:
        return None
    blocks = np.linalg.solve(X, spectra.Y[lines].reshape(len(lines), M, nu, -1)).swapaxes(2, 3)
    d = (blocks - blocks.mean(axis=1, keepdims=True)).reshape(len(lines), M, -1)
    return outer(d) / (M * (M - 1))


def _interpolated(at: Integers, lines: Integers, matrices: Complex) -> Complex:
    """Matrices (F, n, m) at the lines ``at``: piecewise linear, constant beyond the ends."""
    if len(lines) == 1:
        return np.repeat(matrices, len(at), axis=0)
    left = np.clip(np.searchsorted(lines, at, side="right") - 1, 0, len(lines) - 2)
    share = np.clip((at - lines[left]) / (lines[left + 1] - lines[left]), 0.0, 1.0)
    share = share[:, None, None]
    return (1 - share) * matrices[left] + share * matrices[left + 1]


def _diagonal(matrices: Complex) -> Array:
    return np.diagonal(matrices, axis1=1, axis2=2).real.copy()
