"""Noise model of the outputs, estimated from residuals: autoregressive, of any colour.

The residuals of a fit are smaller than the noise, the more so where the model is more flexible. At
each frequency a fit absorbs the part ρ(f) = Σ |q(f)|² / T of the noise's power, with q the
orthonormal columns of its Jacobian. So the spectrum of the residuals is divided by 1 - ρ(f), which
for white noise is the usual n - p. The noise of several outputs may be correlated at the same
sample.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
import torch
from jaxtyping import Float
from torch import Tensor

from lfrtorch._support.types import Array

_SEGMENT = 1024
"""Length of the longest stretch for a spectrum, in samples."""

LEAST = 0.1
"""Lower bound for the part 1 - ρ of the noise that remains in the residuals."""

_NO_POWER = 1e-24
"""Prediction errors with less than this part of the residuals' power are rounding."""

_FADED = 1e-4
"""An impulse response ends when it is below this part."""

_LONGEST = 2048
"""Largest number of samples of an impulse response."""


class Spectra:
    """Spectra of residuals, and of the noise that the fit absorbed, summed over stretches."""

    def __init__(self, longest: int, ny: int) -> None:
        self.segment = min(_SEGMENT, longest)
        self.residual, self.left = np.zeros((2, self.segment + 1, ny))
        self.samples = np.zeros(ny)

    def add(self, errors: Float[Array, "m ny"], Q: Float[Array, "m ny K"]) -> None:
        """Add a block of residuals and of the rows of Q; rows that do not count are zeros."""
        for first in range(0, len(errors), self.segment):
            part = slice(first, first + self.segment)
            counted = np.any(Q[part], axis=2).sum(axis=0)
            self.samples += counted
            self.residual += np.abs(np.fft.rfft(errors[part], 2 * self.segment, axis=0)) ** 2
            taken = np.abs(np.fft.rfft(Q[part], 2 * self.segment, axis=0)) ** 2
            self.left += counted - taken.sum(axis=2)

    def autocovariance(self) -> Float[Array, "L ny"]:
        """Autocovariance of the noise, by lag."""
        n = 2 * self.segment
        L = max(2, self.segment // 8)  # lags of the window that smooths the spectra
        taper = np.zeros((n, 1))
        taper[:L, 0] = 1.0 - np.arange(L) / L
        taper[n - L + 1 :] = taper[1:L][::-1]
        smooth = np.fft.rfft(np.fft.irfft(self.left, n, axis=0) * taper, axis=0).real
        left = np.maximum(smooth, LEAST * self.samples)
        return np.fft.irfft(self.residual / np.maximum(left, 1e-300), n, axis=0)[: self.segment]


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """Noise e = ε / a(q) of each output, and the covariance of ε."""

    a: tuple[Array, ...]  # coefficients 1, a1, a2 ... of each output
    covariance: Float[Array, "ny ny"]

    def coloured(self, Q: Float[Tensor, "m ny K"]) -> Float[Tensor, "m2 K"]:
        """Rows V with VᵀV = QᵀΓQ, where Γ is the covariance of the noise of all samples.

        Σ q(t) e(t) = Σ (Σ_j ψ_j q(s + j)) ε(s): the impulse responses ψ of 1 / a(q) run backwards.
        """
        longest = max(map(_memory, self.a))
        padded = np.concatenate([Q.numpy()[::-1], np.zeros((longest, *Q.shape[1:]))])
        for o, a in enumerate(self.a):
            if len(a) > 1:
                padded[:, o] = scipy.signal.lfilter([1.0], a, padded[:, o], axis=0)
        values, vectors = np.linalg.eigh(self.covariance)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        rows = np.einsum("ok,toc->tkc", root, padded).reshape(-1, Q.shape[2])
        return torch.as_tensor(rows)


def colours(spectra: Spectra) -> tuple[tuple[Array, ...], Float[Array, " ny"]]:
    """Autoregressive coefficients of each output's noise and the variances of ε, by Yule-Walker.

    Akaike's criterion chooses the orders.
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
            if not power > _NO_POWER * c[0]:
                break
            criterion = n * math.log(power / c[0]) + 2 * order
            if criterion < least:
                best, variance, least = a, power, criterion
        found.append(best)
        variances.append(variance)
    return tuple(found), np.array(variances)


def innovations(a: Sequence[Array], errors: Float[Array, "m ny"]) -> Float[Array, "m ny"]:
    """ε for residuals e."""
    each = [scipy.signal.lfilter(own, [1.0], e) for own, e in zip(a, errors.T, strict=True)]
    return np.stack(each, axis=1)


def _memory(a: Array) -> int:
    """Number of samples until the impulse response of 1 / a has decayed."""
    radius = np.abs(np.roots(a)).max(initial=0.0)
    if radius >= 1.0:
        return _LONGEST
    return min(_LONGEST, math.ceil(math.log(_FADED) / math.log(max(radius, 1e-3))))
