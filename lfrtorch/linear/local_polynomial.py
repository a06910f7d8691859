"""Local polynomial method: the frequency response from any excitation, transients included.

In a record that is not periodic, the spectrum of the output is G U plus a transient, as the states
at its beginning and end differ. Both G and the transient are smooth functions of frequency. So in
a window of a few neighbouring lines they are polynomials with few coefficients, found by least
squares; what these do not explain is noise and nonlinear distortion.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex128, Float, Int64

from lfrtorch._support.types import Array, Booleans, Complex, Integers
from lfrtorch.linear.regression import (
    DEPENDENT,
    Regression,
    covariance,
    divided,
    outer,
    regress,
)
from lfrtorch.linear.spectra import NOISE_LINES, smoothed

FOLLOWING = 10.0
"""A line is excited if the input power that follows a reference is 10 dB above its error. The ratio
of the responses of y and u then has a bias of exp(-10)."""

STRONGER = 100.0
"""Lines with 20 dB more input power than a weaker line tell the noise there. For chirps and steps
in a loop, 10 dB gives models that are as good."""

CHUNK = 2**21
"""Complex numbers of windows in memory at a time: 32 MiB, and as much again in copies."""


class WindowErrors(NamedTuple):
    """Errors of estimates whose windows share lines, and so are correlated.

    The error of G(k)_yu is Σ weights(k)_url V_ry(first(k) + l) over records r and lines l, with V
    the noise and distortion of the spectra, independent from line to line and record to record.
    """

    first: Int64[Integers, " F"]  # lowest line of each window
    weights: Complex128[Complex, "F nu R lines"]
    noise: Complex128[Complex, "F ny ny"]  # covariance of V about each line
    sizes: Float[Array, "F nu"] | None  # with a reference: |weights|² if inputs followed it exactly

    def at(self, lines: Booleans) -> WindowErrors:
        """Return the errors at some of the lines."""
        sizes = None if self.sizes is None else self.sizes[lines]
        return WindowErrors(self.first[lines], self.weights[lines], self.noise[lines], sizes)

    def times(self, by_y: Array | Complex, by_u: Array | float) -> WindowErrors:
        """Return the errors of by_y G by_u; factors of every line are (F, 1)."""
        factor = np.asarray(by_y)[..., :, None] * np.conj(by_y)[..., None, :]
        weights = np.asarray(by_u)[..., :, None, None] * self.weights
        return WindowErrors(self.first, weights, factor * self.noise, self.sizes)

    @property
    def sharing(self) -> float:
        """Power of the sum of all errors, of unit variance each, over that of independent ones."""
        F, _, _, width = self.weights.shape
        power = np.sum(np.abs(self.weights) ** 2, axis=(2, 3), keepdims=True)
        unit = self.weights / np.sqrt(power)
        sums = np.zeros((int(self.first.max()) + width, *unit.shape[1:3]), dtype=complex)
        for place in range(width):
            np.add.at(sums, self.first + place, unit[..., place])
        return float(np.sum(np.abs(sums) ** 2) / (F * unit.shape[1]))

    def covariance(self, linear: Callable[[Complex], Complex], K: int) -> Float[Array, "K K"]:
        """Return the covariance of the K numbers Re Σ linear(δG)(k) over the lines k."""
        values, vectors = np.linalg.eigh(self.noise)
        roots = vectors * np.sqrt(np.maximum(values, 0.0))[:, None]
        last, total = int(self.first.max()) + self.weights.shape[3], np.zeros((K, K))
        for record in np.moveaxis(self.weights, 2, 0):
            for root in np.moveaxis(roots, 2, 0):
                sums = np.zeros((last, K), dtype=complex)  # of noise of unit variance at each line
                for place, weights in enumerate(np.moveaxis(record, 2, 0)):
                    found = linear(root[:, :, None] * weights[:, None])
                    np.add.at(sums, self.first + place, found)
                power: Complex = sums.conj().T @ sums
                total += power.real / 2  # a part, real or imaginary, has half
        return total


def half_width(order: int, degrees_of_freedom: int, nu: int, records: int) -> int:
    """Smallest n for which a window of 2 n + 1 lines leaves ``degrees_of_freedom``.

    R (2 n + 1) equations have (order + 1) (nu + R) unknowns: G, and the transient of each record.
    """
    rows = -(-((order + 1) * nu + degrees_of_freedom) // records)  # of a record, without transient
    return (rows + order + 1) // 2


def fit_local_polynomials(
    U: Complex128[Complex, "lines R nu"],
    Y: Complex128[Complex, "lines R driven"],
    centres: Int64[Integers, " F"],
    *,
    order: int,
    n: int,
    outputs: int | None = None,
) -> tuple[
    Complex128[Complex, "F ny nu"],
    Complex128[Complex, "F ny*nu ny*nu"],
    Bool[Booleans, " F"],
    WindowErrors,
]:
    """Frequency response at lines of spectra that hold transients, and its covariance.

    About each centre k, for the 2 n + 1 lines k + r nearest to it (shifted at the ends)::

        Y(k + r) = (Σ_s g_s rˢ) U(k + r) + Σ_s t_s rˢ + V(k + r),    s = 0 .. order

    The records share g, and each has its own t. A projection orthogonal to all polynomials of the
    order removes t; it is the same for all windows. The result is g_0 = G(k).

    Where nothing else excites the input, a controller makes the input from the noise. There G
    becomes one over the controller and leaves no residual, so that the residual does not show the
    error. A reference (in U; Y then holds ``outputs`` columns of y, and the inputs) leaves such
    lines undetermined. Without one, noise is added at lines of weak input: the noise at lines of
    strong input, times the lines of a window, as the controller's input is common to these.

    References:
        Pintelon and Schoukens, "System Identification: A Frequency Domain Approach", 2nd ed.,
        2012, chapter 7.
    """
    records, nu = U.shape[1:]
    width = 2 * n + 1
    powers = np.arange(order, -1, -1)  # g_0 last: see regress
    vandermonde = (np.arange(-n, n + 1)[:, None] / n) ** powers
    complement = np.linalg.qr(vandermonde, mode="complete")[0][:, order + 1 :]
    rows = records * complement.shape[1]
    freedom = rows - (order + 1) * nu
    first = np.clip(centres - n, 0, len(U) - width)

    parts = []
    size = max(1, CHUNK // (records * width * (order + 1) * (nu + Y.shape[2])))
    for start in range(0, len(centres), size):
        part = slice(start, start + size)
        window = first[part, None] + np.arange(width)
        r = ((window - centres[part, None]) / n)[:, :, None] ** powers
        X = np.einsum("wm,fwru,fws->frmsu", complement, U[window], r, optimize=True)
        projected = np.einsum("wm,fwry->frmy", complement, Y[window], optimize=True)
        shape = len(window), rows, -1
        fitted = regress(X.reshape(shape), projected.reshape(shape), nu)
        alone = np.sum(np.abs(fitted.weights) ** 2, axis=2)
        excited = np.ones(len(window))
        if outputs is not None:
            excited = _following(fitted, outputs, freedom)
            fitted = divided(fitted, outputs)
        C = outer(fitted.residual) / freedom
        # If one line alone has power, some columns are rounding errors, which pass as independent.
        sizes = np.linalg.norm(X, axis=(1, 2))  # (line, s, input)
        determined = (sizes > DEPENDENT * sizes.max(axis=1, keepdims=True)).all(axis=(1, 2))
        weights = fitted.weights.reshape(len(window), nu, records, -1) @ complement.T
        parts.append((fitted.G, fitted.determined & determined, excited, weights, C, alone))
    joined = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    G, determined, excited, weights, noise, alone = joined
    if outputs is None:
        noise = noise + width * _noise_of_stronger(noise, weights, determined)
    else:  # noise alone passes at some lines, but not at most of the lines about them
        determined &= smoothed(excited[:, None], NOISE_LINES)[:, 0] > 0.5
    cov = covariance(noise, weights.reshape(len(first), nu, -1))
    errors = WindowErrors(first, weights, noise, None if outputs is None else alone)
    return G, cov, determined, errors


def _following(fitted: Regression, ny: int, freedom: int) -> Booleans:
    """Tell at which lines the inputs, the last columns of Y, follow X beyond the noise."""
    G = fitted.G[:, ny:]
    A = fitted.weights @ fitted.weights.conj().swapaxes(1, 2)
    A = np.where(fitted.determined[:, None, None], A, np.eye(G.shape[2]))
    power = G @ np.linalg.solve(A.swapaxes(1, 2), G.conj().swapaxes(1, 2))
    noise = outer(fitted.residual[:, :, ny:]) / freedom
    beyond = np.linalg.eigvalsh(power - FOLLOWING * noise)
    return np.asarray(beyond[:, 0] > 0)


def _noise_of_stronger(noise: Complex, weights: Complex, determined: Booleans) -> Complex:
    """Return the mean noise (F, ny, ny) of the lines with stronger inputs, 0 if there are none."""
    power = determined[:, None] / np.sum(np.abs(weights) ** 2, axis=(2, 3))
    power = (power / np.maximum(power.max(axis=0), 1e-300)).min(axis=1)
    order = np.argsort(-power, kind="stable")
    ranked = power[order]
    sums = np.cumsum(ranked[:, None, None] * noise[order], axis=0)
    means = sums / np.maximum(np.cumsum(ranked), 1e-300)[:, None, None]
    stronger = np.searchsorted(-ranked, -STRONGER * power)
    return np.where(stronger[:, None, None] > 0, means[np.maximum(stronger - 1, 0)], 0.0)
