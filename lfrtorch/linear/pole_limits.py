"""Limits for the poles of a model that is fitted to spectral lines.

A resonance narrower than the spacing of the lines fits a single line. A resonance outside the
excited band, much narrower than its distance from the band, fits the band's edge. In both cases the
lines do not tell how narrow it is. A pole e^(-h + jω), of half-power width 2h, has the limit

    h >= m(ω) = max(half the line spacing, REACH times the distance of ω to the nearest line).

Residuals ρ e with e = max(0, 1 - h / m) and ρ² = PART |r|² raise the cost |r|² of poles beyond. So
the fit keeps the limits unless the data clearly ask for more. A perfect model, r = 0, has no
penalty.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Complex128, Float

from lfrtorch._support.types import Array, Complex

PART = 0.1
"""Penalty of a pole far beyond its limit, relative to the squared error."""

REACH = 1 / 3
"""Smallest half width of a pole outside the band, relative to its distance from the band. The real
pole of Bouc-Wen's linear model has 2 / 3."""


class PoleLimits:
    """Limits that lines z on the unit circle set."""

    def __init__(self, z: Complex128[Complex, " F"]) -> None:
        self._lines = np.unique(np.abs(np.angle(z)))
        apart = np.diff(self._lines)
        self._half = float(np.median(apart)) / 2 if len(apart) else 0.0

    def excess(
        self, poles: Complex128[Complex, " nx"]
    ) -> tuple[Float[Array, " nx"], Complex128[Complex, " nx"]]:
        """e, and its derivative e' with each pole: de = Re(e' dλ / λ)."""
        h, angle = -np.log(np.maximum(np.abs(poles), 1e-300)), np.angle(poles)
        omega = np.abs(angle)
        right = np.searchsorted(self._lines, omega).clip(1, max(1, len(self._lines) - 1))
        ends = self._lines[[right - 1, np.minimum(right, len(self._lines) - 1)]]
        away = (omega - ends)[np.abs(omega - ends).argmin(axis=0), np.arange(len(poles))]
        m = np.maximum(np.maximum(self._half, REACH * np.abs(away)), 1e-300)
        e = np.maximum(0.0, 1.0 - h / m)
        out = REACH * np.abs(away) > self._half
        turned = np.where(out, REACH * np.sign(away) * np.sign(angle), 0.0)
        # dh = -Re(dλ / λ), dω = Im(dλ / λ) = Re(-j dλ / λ)
        return e, np.where(e > 0, 1.0 / m - 1j * turned * h / m**2, 0.0)

    def slopes(
        self,
        poles: Complex128[Complex, " nx"],
        V: Complex128[Complex, "nx nx"],
        W: Complex128[Complex, "nx nx"],
    ) -> Float[Array, "nx nx*nx"]:
        """Derivative of each e with A, from its eigenvectors V and W = V⁻¹."""
        e, slope = self.excess(poles)
        by_pole = slope / np.where(e > 0, poles, 1.0)
        slopes = by_pole[:, None, None] * W[:, :, None] * V.T[:, None, :]
        return slopes.real.reshape(len(poles), -1)


class Excess:
    """Residuals ρ e at some θ, and their derivative, from e, |r| and their derivatives."""

    def __init__(
        self,
        e: Float[Array, " nx"],
        slopes: Float[Array, "nx P"],
        errors: float,
        gradient: Float[Array, " P"],
    ) -> None:
        root = math.sqrt(PART)
        self.residual = root * errors * e
        self.jacobian = root * (errors * slopes + np.outer(e, gradient / max(errors, 1e-300)))
        self.active = bool(e.any())
