"""Noise of the outputs as the residuals show it: autoregressive, of any colour.

The residuals of a fit are less than the noise, where the model is flexible more so than elsewhere:
of the noise's power at a frequency a fit takes the part ρ(f) = Σ |q(f)|² / T, with q the
orthonormal columns of its Jacobian. The spectrum of the residuals is divided by 1 - ρ(f), which is
what n - p is for white noise. The noise of several outputs may be correlated at the same sample.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from jaxtyping import Float

from lfrtorch._support.types import Array

SEGMENT = 1024
"""Longest stretch of which a spectrum is taken, in samples."""

RESOLUTION = 8
"""Spectra are smoothed by a window of so many times fewer lags than a stretch has samples."""

LEAST = 0.1
"""Least part 1 - ρ of the noise that is taken to be left in the residuals."""

NO_POWER = 1e-24
"""Power of the prediction errors, over that of the residuals, that is a rounding error."""

FADED, LONGEST = 1e-4, 2048
"""An impulse response ends where so little is left of it, and after so many samples."""


class Spectra:
    """Spectra of residuals and of what the fit took of the noise, summed over stretches.

    Args:
        longest: samples of the longest block.
        ny: outputs.

    Example:
        >>> from lfrtorch.analysis.noise_model import Spectra
        >>> spectra = Spectra(1000, 1)
        >>> white = np.random.default_rng(0).standard_normal((1000, 1))
        >>> spectra.add(white, np.ones((1000, 1, 1)) / 1000**0.5)
        >>> bool(0.9 < spectra.autocovariance()[0, 0] < 1.1)
        True
    """

    def __init__(self, longest: int, ny: int) -> None:
        self.segment = min(SEGMENT, longest)
        self.residual, self.left = np.zeros((2, self.segment + 1, ny))
        self.samples = np.zeros(ny)

    def add(self, errors: Float[Array, "m ny"], Q: Float[Array, "m ny K"]) -> None:
        """A block of residuals and of the rows of Q; rows that do not count are zeros."""
        for first in range(0, len(errors), self.segment):
            part = slice(first, first + self.segment)
            counted = np.any(Q[part], axis=2).sum(axis=0)
            self.samples += counted
            self.residual += np.abs(np.fft.rfft(errors[part], 2 * self.segment, axis=0)) ** 2
            taken = np.abs(np.fft.rfft(Q[part], 2 * self.segment, axis=0)) ** 2
            self.left += counted - taken.sum(axis=2)

    def autocovariance(self) -> Float[Array, "L ny"]:
        """Of the noise, by lag."""
        n = 2 * self.segment
        L = max(2, self.segment // RESOLUTION)
        taper = np.zeros((n, 1))
        taper[:L, 0] = 1.0 - np.arange(L) / L
        taper[n - L + 1 :] = taper[1:L][::-1]
        smooth = np.fft.rfft(np.fft.irfft(self.left, n, axis=0) * taper, axis=0).real
        left = np.maximum(smooth, LEAST * self.samples)
        return np.fft.irfft(self.residual / np.maximum(left, 1e-300), n, axis=0)[: self.segment]


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """Noise e = ε / a(q) of each output, and the covariance of ε.

    Args:
        a: coefficients 1, a1, a2 ... of each output.
        covariance: of ε.

    Example:
        >>> from lfrtorch.analysis.noise_model import NoiseModel
        >>> noise = NoiseModel((np.array([1.0, -0.5]),), np.array([[0.75]]))  # of unit variance
        >>> V = noise.coloured(np.eye(3)[:, None])
        >>> (V.T @ V).round(3)[0].tolist()
        [1.0, 0.5, 0.25]
    """

    a: tuple[Array, ...]
    covariance: Float[Array, "ny ny"]

    def coloured(self, Q: Float[Array, "m ny K"]) -> Float[Array, "m2 K"]:
        """Rows V with VᵀV = QᵀΓQ, Γ the covariance of the noise of all samples.

        Σ q(t) e(t) = Σ (Σ_j ψ_j q(s + j)) ε(s): the impulse responses ψ of 1 / a(q) run backwards.
        """
        longest = max(map(_memory, self.a))
        padded = np.concatenate([Q[::-1], np.zeros((longest, *Q.shape[1:]))])
        for o, a in enumerate(self.a):
            if len(a) > 1:
                padded[:, o] = scipy.signal.lfilter([1.0], a, padded[:, o], axis=0)
        values, vectors = np.linalg.eigh(self.covariance)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        return np.einsum("ok,toc->tkc", root, padded).reshape(-1, Q.shape[2])


def colours(spectra: Spectra) -> tuple[tuple[Array, ...], Float[Array, " ny"]]:
    """Autoregressive coefficients of each output's noise and the variances of ε, by Yule-Walker.

    Akaike's criterion chooses the orders.

    Example:
        >>> from lfrtorch.analysis.noise_model import Spectra, colours
        >>> spectra = Spectra(1000, 1)
        >>> e = signal.lfilter([1.0], [1.0, -0.8], np.random.default_rng(0).standard_normal(1000))
        >>> spectra.add(e[:, None], np.ones((1000, 1, 1)) / 1000**0.5)
        >>> (a,), variances = colours(spectra)
        >>> bool(abs(a[1] + 0.8) < 0.1), bool(abs(variances[0] - 1) < 0.1)
        (True, True)
    """
    found, variances = [], []
    for c, n in zip(spectra.autocovariance().T, spectra.samples, strict=True):
        most = int(min(10 * math.log10(max(n, 1)), n // 10, len(c) - 1))
        best, variance, least = np.ones(1), c[0], 0.0
        for order in range(1, most + 1):
            if c[0] <= 0:
                break
            a = np.r_[1.0, -scipy.linalg.solve_toeplitz(c[:order], c[1 : order + 1])]
            power = a @ c[: order + 1]
            if not power > NO_POWER * c[0]:
                break
            criterion = n * math.log(power / c[0]) + 2 * order
            if criterion < least:
                best, variance, least = a, power, criterion
        found.append(best)
        variances.append(variance)
    return tuple(found), np.array(variances)


def innovations(a: Sequence[Array], errors: Float[Array, "m ny"]) -> Float[Array, "m ny"]:
    """ε of residuals e.

    Example:
        >>> from lfrtorch.analysis.noise_model import innovations
        >>> innovations([np.array([1.0, -0.5])], np.array([[1.0], [0.5]])).ravel().tolist()
        [1.0, 0.0]
    """
    each = [scipy.signal.lfilter(own, [1.0], e) for own, e in zip(a, errors.T, strict=True)]
    return np.stack(each, axis=1)


def _memory(a: Array) -> int:
    """Samples in which the impulse response of 1 / a fades."""
    radius = np.abs(np.roots(a)).max(initial=0.0)
    if radius >= 1.0:
        return LONGEST
    return min(LONGEST, math.ceil(math.log(FADED) / math.log(max(radius, 1e-3))))
