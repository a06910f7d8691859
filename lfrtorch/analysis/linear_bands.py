"""Bands of a linear model's frequency response and poles, from the covariance of its matrices."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Complex128, Float
from numpy.typing import ArrayLike

from lfrtorch._support.arguments import typed
from lfrtorch._support.checks import reals
from lfrtorch._support.types import Array, Complex
from lfrtorch.linear.model import LinearModel
from lfrtorch.linear.resolvent import known


@dataclass(frozen=True, eq=False)
class ResponseBand:
    """A frequency response and its uncertainty, in physical units.

    Args:
        frequencies: in Hz.
        response: complex.
        covariance: covariance of its real and imaginary part.

    Example:
        >>> band = lfrtorch.analysis.response_band(bla, [1.0, 10.0])
        >>> band.magnitude.shape, bool((band.magnitude_std <= band.std).all())
        ((2, 1, 1), True)
    """

    frequencies: Float[Array, " F"]
    response: Complex128[Complex, "F ny nu"]
    covariance: Float[Array, "F ny nu 2 2"]

    @property
    def std(self) -> Float[Array, "F ny nu"]:
        """Root of the mean squared distance in the complex plane."""
        return np.sqrt(np.trace(self.covariance, axis1=-2, axis2=-1))

    @property
    def magnitude(self) -> Float[Array, "F ny nu"]:
        """|G|."""
        return np.abs(self.response)

    @property
    def magnitude_std(self) -> Float[Array, "F ny nu"]:
        """Standard deviation of |G|, to first order."""
        size = np.where(self.magnitude > 0, self.magnitude, 1.0)
        along = np.stack([self.response.real, self.response.imag], -1) / size[..., None]
        variance = np.einsum("...i,...ij,...j->...", along, self.covariance, along)
        return np.sqrt(np.maximum(variance, 0.0))


@dataclass(frozen=True)
class PoleBand:
    """A pole, or a conjugate pair, and its uncertainty.

    Args:
        pole: in the z plane, with an imaginary part of 0 or more.
        std: root of the mean squared distance in the z plane.
        frequency, frequency_std: |s| / 2π in Hz, with z = exp(s / fs).
        damping, damping_std: ratio -Re s / |s|.

    Example:
        >>> (pole,) = lfrtorch.analysis.pole_bands(bla)
        >>> bool(pole.frequency_std < 0.2 * pole.frequency), round(pole.damping)
        (True, 1)
    """

    pole: complex
    std: float
    frequency: float
    frequency_std: float
    damping: float
    damping_std: float


@typed()
def response_band(model: LinearModel, frequencies: ArrayLike) -> ResponseBand:
    """Frequency response with its covariance.

    Args:
        model: a model with a covariance, from ``Uncertainty.linearise`` or ``estimate_bla``.
        frequencies: (F,) in Hz.

    Raises:
        ValueError: a model without covariance.

    Example:
        >>> lfrtorch.analysis.response_band(bla, [0.0, 10.0]).std.shape
        (2, 1, 1)
    """
    f = np.atleast_1d(reals("frequencies", frequencies))
    return ResponseBand(f, model.frf(f), model.frf_covariance(f))


@typed()
def pole_bands(model: LinearModel) -> tuple[PoleBand, ...]:
    """Poles with their standard deviations, by frequency; a conjugate pair counts once.

    The standard deviations are of first order: for poles that lie together, or for a real pair that
    may be a complex pair, they say little.

    Args:
        model: a model with a covariance, from ``Uncertainty.linearise`` or ``estimate_bla``.

    Raises:
        ValueError: a model without covariance.

    Example:
        >>> len(lfrtorch.analysis.pole_bands(bla))
        1
    """
    nx = model.nx
    covariance = known(model.covariance)[: nx * nx, : nx * nx]
    poles, right = (np.asarray(part, np.complex128) for part in np.linalg.eig(model.A))
    upper = poles.imag >= 0
    z, left = poles[upper], np.linalg.pinv(right)[upper]
    # dz = left dA right, and s = fs log z, columns for each pole.
    d_z = np.einsum("pi,jp->ijp", left, right[:, upper]).reshape(nx * nx, -1)
    radius = np.abs(z)
    s = model.fs * (np.log(np.maximum(radius, 1e-300)) + 1j * np.angle(z))
    d_s = d_z * np.divide(model.fs, z, out=np.full_like(z, np.nan), where=radius > 0)
    size = np.where(s == 0, np.nan, np.abs(s))
    d_size = (s.conj() * d_s).real / size
    d_damping = -d_s.real / size + s.real * d_size / size**2
    stds = [
        np.sqrt(np.einsum("ap,ab,bp->p", d, covariance, d).clip(0.0))
        for d in (d_z.real, d_z.imag, d_size / (2 * np.pi), d_damping)
    ]
    of_z, frequency, damping = np.hypot(*stds[:2]), size / (2 * np.pi), -s.real / size
    columns = zip(z.tolist(), of_z, frequency, stds[2], damping, stds[3], strict=True)
    found = [PoleBand(pole, *map(float, numbers)) for pole, *numbers in columns]
    return tuple(sorted(found, key=lambda pole: (pole.frequency, pole.damping)))
