"""Spectra that a linear model is fitted to: those of periodic records, or a frequency response.

In both cases the model is asked for Y = G(z) U at some points z of the unit circle. For a response
U = I, Y is the response, and the weight of each error is one over its variance. For periodic
records in steady state U and Y are their spectra: by Parseval's theorem the sum of squared errors
is the mean squared simulation error, found without a simulation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Complex128, Float

from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array, Complex
from lfrtorch.data.records import NormalisedRecord, Scaler, rms_scale
from lfrtorch.linear.frf import FRF
from lfrtorch.linear.local_polynomial import WindowErrors
from lfrtorch.linear.regression import outer
from lfrtorch.linear.spectra import (
    NOISE_LINES,
    SILENT,
    carrying,
    given_references,
    smoothed,
    without_noise,
)

Weight = Literal["total", "noise", "none"]

_DEGREES_OF_FREEDOM = 20
"""Degrees of freedom that a variance needs before it is used as a weight; neighbouring lines are
averaged until it has them."""


@dataclass(frozen=True, eq=False)
class SpectralData:
    """Spectra that are fitted, Y = G(z) U; the sum of squared errors is their mean square."""

    z: Complex128[Complex, " F"]
    U: Complex128[Complex, "F nu m"]
    Y: Complex128[Complex, "F ny m"]
    weight: Float[Array, "F ny m"] | None = None  # of the errors Y - G U
    left_out: int = 0  # lines of some power that the input is not meant to excite
    errors: WindowErrors | None = None  # of Y, if those of several lines are correlated

    def weighted(self, errors: Complex) -> Complex:
        """√weight times errors (F, ny, m), or times their Jacobian (F, ny, m, K)."""
        if self.weight is None:
            return errors
        root = np.sqrt(self.weight)
        return errors * root.reshape(*root.shape, *[1] * (errors.ndim - 3))

    @property
    def independent(self) -> float:
        """Number of independent real equations: fewer if lines share windows."""
        return self.equations / (1.0 if self.errors is None else self.errors.sharing)

    @property
    def equations(self) -> int:
        """Real equations: two a line, one at 0 and fs / 2, for each output and excited column."""
        real = np.abs(self.z.imag) < 1e-12
        counts = np.broadcast_to((np.abs(self.U) ** 2).sum(axis=1, keepdims=True) > 0, self.Y.shape)
        if self.weight is not None:
            counts = counts & (self.weight > 0)
        return int((counts.sum(axis=(1, 2)) * np.where(real, 1, 2)).sum())


def spectral_data_of_records(
    normalised: Sequence[NormalisedRecord], *, offset: bool
) -> SpectralData | None:
    """Spectra of periodic records, or ``None`` if their simulation error is not a sum over lines.

    Noise on the inputs would make every response too small, and noise that a controller feeds back
    would bias it. The fit depends on U Uᴴ and Y Uᴴ alone, and the scatter over the periods gives
    the noise in these: it is subtracted (Pintelon and Schoukens, 2012, chapter 9). If records
    have references, only the part that follows the references is kept.
    """
    records, ny = [each.record for each in normalised], normalised[0].y.shape[1]
    if any(r.start != "periodic" or r.skip for r in records):
        return None
    if ny > 1 and any(np.ptp(r.weight) > 0 or r.line_weight is not None for r in records):
        return None
    groups: dict[int, list[_Lines]] = {}
    references = given_references(records)
    means: list[tuple[Complex, Complex, float]] = []
    total = sum(record.samples for record in records)
    for each, r in zip(normalised, references, strict=True):
        u, y, record = each.u, each.y, each.record
        N = record.period or len(u)

        def periods(signal: Array, N: int = N) -> Complex:
            return np.fft.rfft(signal.reshape(-1, N, signal.shape[1]), axis=1) / N

        U, Y = (np.fft.rfft(s.reshape(-1, N, s.shape[1]).mean(0), axis=0) / N for s in (u, y))
        weight = np.max(record.weight) * _twice(N) * len(u) / total
        if record.line_weight is not None:
            weight = weight * record.line_weight[:: len(u) // N]
        root = np.sqrt(weight)
        means.append((root[0] * U[0], root[0] * Y[0], float(root[0, 0])))
        noise = None
        if len(u) > N and np.ptp(u.reshape(-1, N, u.shape[1]), axis=0).any():
            Z = np.concatenate([periods(u), periods(y)], axis=2).swapaxes(0, 1)
            P = Z.shape[1]
            noise = outer(root[:, :, None] * (Z - Z.mean(axis=1, keepdims=True))) / (P * (P - 1))
        groups.setdefault(N, []).append(
            _Lines(
                root[1:] * U[1:],
                root[1:] * Y[1:],
                None if noise is None else noise[1:],
                None if r is None else root[1:] * periods(r).mean(axis=0)[1:],
            )
        )
    parts = [_line_0(means, offset=offset)]
    for N, group in groups.items():
        z = np.exp(2j * np.pi * np.arange(1, len(group[0].U) + 1) / N)
        parts.append((z, *_together(group)))
    m = max(U.shape[2] for _, U, _ in parts)

    def together(which: int) -> Complex:
        wide = [np.pad(p[which], ((0, 0), (0, 0), (0, m - p[which].shape[2]))) for p in parts]
        return np.concatenate(wide)

    z, U, Y = np.concatenate([z for z, _, _ in parts]), together(1), together(2)
    power = (np.abs(U) ** 2).sum(axis=(1, 2))
    excited = carrying(power)
    left_out = int((power[~excited] > SILENT**2 * power.max(initial=0.0)).sum())
    return SpectralData(z[excited], U[excited], Y[excited], left_out=left_out)


def spectral_data_of_parts(
    parts: Sequence[tuple[Array, Array]], weights: Sequence[float], *, offset: bool
) -> SpectralData:
    """Spectra of stretches of signals, each with its own initial state, as an additional input.

    A stretch is one period of a periodic signal whose state jumps between its end and its
    beginning. The jump is the response to an impulse in the last sample, so that the impulse's
    column of B is the jump, and its D is 0. By Parseval's theorem the sum of squared errors is the
    mean square of the simulation errors from the best initial states.
    """
    R, total = len(parts), sum(len(u) for u, _ in parts)
    zs, Us, Ys = [], [], []
    for r, ((u, y), weight) in enumerate(zip(parts, weights, strict=True)):
        N = len(u)
        U, Y = (np.fft.rfft(s, axis=0) / N for s in (u, y))
        z = np.exp(2j * np.pi * np.arange(len(U)) / N)
        impulses = np.zeros((len(z), R), dtype=complex)
        impulses[:, r] = z / np.sqrt(N)
        kept = slice(int(offset), None)
        root = np.sqrt(weight * _twice(N) * N / total)
        zs.append(z[kept])
        Us.append((root * np.hstack([U, impulses]))[kept])
        Ys.append((root * Y)[kept])
    return SpectralData(
        np.concatenate(zs), np.concatenate(Us)[:, :, None], np.concatenate(Ys)[:, :, None]
    )


def _twice(N: int) -> Array:
    """Count the lines (F, 1) that each line of N samples stands for: itself and its conjugate."""
    twice = np.full((N // 2 + 1, 1), 2.0)
    twice[0] = 1.0  # lines 0 and N / 2 are their own
    if N % 2 == 0:
        twice[-1] = 1.0
    return twice


def _line_0(
    means: list[tuple[Complex, Complex, float]], *, offset: bool
) -> tuple[Complex, Complex, Complex]:
    """Line 0 of all records, projected orthogonally to a constant that is common to them."""
    U, Y = (np.stack([mean[side] for mean in means], axis=-1) for side in (0, 1))
    if offset:
        one = np.array([weight for _, _, weight in means])
        one /= max(float(np.linalg.norm(one)), np.finfo(float).tiny)
        U, Y = (S - np.outer(S @ one, one) for S in (U, Y))
    return np.ones(1, dtype=complex), *_compressed(U[None], Y[None])


class _Lines(NamedTuple):
    """Weighted spectra of a record at lines from 1 on, means over the periods."""

    U: Complex
    Y: Complex
    noise: Complex | None  # covariance of the noise of [U, Y]
    reference: Complex | None


def _together(group: Sequence[_Lines]) -> tuple[Complex, Complex]:
    """U and Y of records with one period, in at most nu columns, without the noise of U."""
    U = np.stack([record.U for record in group], axis=-1)
    Y = np.stack([record.Y for record in group], axis=-1)
    nu, R = U.shape[1:]
    shares = [record.noise for record in group if record.noise is not None]
    noise = np.sum(shares, axis=0) if shares else None
    known = [record.reference for record in group if record.reference is not None]
    excited = None
    if known:
        reference = np.stack(known, axis=-1)
        excited = carrying((np.abs(reference) ** 2).sum(axis=(1, 2)))
        if nu < R:
            Q = np.linalg.qr(reference.swapaxes(1, 2).conj())[0]
            Z = np.concatenate([U, Y], axis=1)
            along = Z @ Q
            rest = Z - along @ Q.conj().swapaxes(1, 2)
            noise = rest @ rest.conj().swapaxes(1, 2) * (nu / (R - nu))
            U, Y = along[:, :nu], along[:, nu:]
    if noise is None:
        return _compressed(U, Y)
    Uh = U.conj().swapaxes(1, 2)
    left, clear = without_noise(U @ Uh, noise[:, :nu, :nu])
    if left is None:
        return _compressed(U, Y)
    if excited is None:
        shown, power = (np.trace(S, axis1=1, axis2=2).real for S in (noise[:, :nu, :nu], U @ Uh))
        # A line of noise alone has ten times its mean power once in 1e4.
        excited = power > 10.0 * smoothed(shown[:, None], NOISE_LINES)[:, 0]
    if nu > R:  # noise leaves nothing of fewer experiments than inputs: it is not subtracted
        return _compressed(U * excited[:, None, None], Y * excited[:, None, None])
    counts = (excited & clear)[:, None, None]
    root = np.asarray(np.linalg.cholesky(left) * counts, dtype=np.complex128)
    across = (Y @ Uh - noise[:, nu:, :nu]) * counts
    right = np.linalg.inv(np.where(counts, root, np.eye(nu))).conj().swapaxes(1, 2)
    return root, np.asarray(across @ right, dtype=np.complex128)


def _compressed(U: Complex, Y: Complex) -> tuple[Complex, Complex]:
    """Return the same normal equations in at most nu columns."""
    nu = U.shape[1]
    if U.shape[2] <= nu:
        return U, Y
    stacked = np.concatenate([U, Y], axis=1).swapaxes(1, 2).conj()
    R = np.asarray(np.linalg.qr(stacked, mode="r"))[:, :nu].conj().swapaxes(1, 2)
    return R[:, :nu], R[:, nu:]


def spectral_data_of_response(
    frf: FRF, weight: Weight | Array | None, *, offset: bool, differences: int = 0
) -> tuple[SpectralData, Scaler, bool, list[str]]:
    """Return a response as spectra of channels of unit size, with their scaling.

    Also return whether the weights are the inverse variances of the errors, and notes on the
    weights. ``differences`` of the inputs follow the inputs.
    """
    weights, known, notes = _weights(frf, weight)
    u_scale = 1.0 / rms_scale([np.abs(frf.G).reshape(-1, frf.G.shape[2])], np.zeros(1))
    G = frf.G * u_scale
    y_scale = rms_scale([np.abs(G).swapaxes(1, 2).reshape(-1, G.shape[1])], np.zeros(1))
    size = y_scale[:, None] / u_scale
    nu = len(u_scale)
    z = np.exp(2j * np.pi * frf.frequencies / frf.fs)
    powers = (z[:, None] - 1.0) ** np.arange(differences + 1)
    U = np.einsum("fd,uv->fduv", powers, np.eye(nu)).reshape(len(z), -1, nu)
    data = SpectralData(
        z, U, frf.G / size, None if weights is None else weights * size**2,
        errors=frf.errors and frf.errors.times(1.0 / y_scale, u_scale),
    )  # fmt: skip
    u_offset = np.pad(frf.u_offset, (0, nu * differences))
    scaler = Scaler(
        u_offset * offset, np.tile(u_scale, differences + 1), frf.y_offset * offset, y_scale
    )
    return data, scaler, known, notes


def _weights(frf: FRF, weight: Weight | Array | None) -> tuple[Array | None, bool, list[str]]:
    """Return weights (F, ny, nu) of the errors of G, if they are inverse variances, and notes.

    A noise variance is less than the variance of the errors: nonlinear distortion adds to it.
    """
    notes: list[str] = []
    if isinstance(weight, list | tuple):
        weight = np.asarray(weight, dtype=np.float64)
    if isinstance(weight, np.ndarray):
        if weight.shape != frf.G.shape or not (np.isfinite(weight).all() and (weight >= 0).all()):
            raise InputError(
                f"weight has shape {weight.shape}; give finite numbers of at least 0 in the shape "
                f"of the response, {frf.G.shape}."
            )
        if not weight.any():
            raise InputError("weight is 0 everywhere; give some lines a positive one.")
        return weight.astype(np.float64), False, notes
    variances = {"total": frf.var_total, "noise": frf.var_noise}
    if weight is None:
        random = frf.method == "local_polynomial" and frf.var_total is not None
        weight = "total" if random else "none"
    if weight == "none":
        return None, False, notes
    if not isinstance(weight, str) or weight not in variances:
        raise InputError(
            f"weight is {weight!r}; use 'total', 'noise', 'none' or an array (F, ny, nu)."
        )
    variance = variances[weight]
    if variance is None:
        raise InputError(
            f"the {weight} variance of the response is not known: {' '.join(frf.notes)} "
            "Use another weight, or measure more."
        )
    if not (variance > 0).any():
        notes.append("the variance is 0 at all lines, so that they count alike in the fit.")
        return None, False, notes
    if frf.errors is not None and frf.errors.sizes is not None:
        smooth = _of_other_windows(variance, frf.errors.sizes, frf.errors)
    else:
        freedom = frf.realisations - 1 if weight == "total" else frf.experiments * (frf.periods - 1)
        smooth = _smoothed(variance, 1 if frf.method == "local_polynomial" else freedom)
    return 1.0 / np.maximum(smooth, 1e-12 * smooth.max()), weight == "total", notes


def _of_other_windows(variance: Array, sizes: Array, errors: WindowErrors) -> Array:
    """Variances (F, ny, nu) from the nearest lines whose windows share no line with a line's own.

    In a window, the variance and G share the noise. Weights from the same window would favour lines
    where noise makes G small: a bias that does not fall with the length of the records.
    """
    variance = variance / sizes[:, None]
    first, F, width = errors.first, len(variance), errors.weights.shape[3]
    near = np.arange(_DEGREES_OF_FREEDOM // 2)
    below = np.searchsorted(first, first - width, side="right")[:, None] - 1 - near
    above = np.searchsorted(first, first + width)[:, None] + near
    total, count = np.zeros_like(variance), np.zeros((F, 1, 1))
    for at in np.hstack([below, above]).T:
        there = ((at >= 0) & (at < F))[:, None, None]
        total += there * variance[np.clip(at, 0, F - 1)]
        count += there
    return sizes[:, None] * np.where(count > 0, total / np.maximum(count, 1), variance.mean(axis=0))


def _smoothed(variance: Array, degrees_of_freedom: int) -> Array:
    """Variances (F, ny, nu) averaged over neighbouring lines.

    A weight is one over a variance; one over an estimate of few degrees of freedom has no finite
    mean, and some lines would outweigh all others by chance.
    """
    half = min((_DEGREES_OF_FREEDOM // max(1, degrees_of_freedom)) // 2, (len(variance) - 1) // 2)
    if half == 0:
        return variance
    padded = np.pad(variance, ((half, half), (0, 0), (0, 0)), mode="reflect")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1, axis=0)
    return windows.mean(axis=-1)
