"""How far training data went, and how far beyond them other samples are: the surprise index."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lfrtorch._support.types import Array
from lfrtorch.analysis.canonical_form import whitening

FARTHEST = 0.99
"""Part of the training samples whose surprise is below 1."""


@dataclass(frozen=True, eq=False)
class TrainingReach:
    """How far the training data went: in the static map's input z, and in what they tell of y.

    Two distances count, whichever is larger, each relative to the one of 99 % of the training
    samples: of z from the middle of its cloud, in standard deviations of the cloud, and the
    standard deviation of the simulated output, which tells of dynamics, too.
    """

    middle: Float[Array, " nz"]
    white: Float[Array, "nz nz"]  # white (z - middle) has unit covariance
    farthest: tuple[float, float, float]  # of 99 %: both distances, and then the larger ratio

    @classmethod
    def of(cls, z: Float[Array, "S nz"], variance: Float[Array, "S ny"]) -> TrainingReach:
        """Build it from z and the variances of the outputs at the training samples."""
        middle = z.mean(axis=0)
        white = whitening(z)
        found = cls(middle, white, (1.0, 1.0, 1.0))
        far = [float(np.quantile(d, FARTHEST)) or 1.0 for d in found._distances(z, variance)]
        found = cls(middle, white, (far[0], far[1], 1.0))
        both = float(np.quantile(found.surprises(z, variance), FARTHEST)) or 1.0
        return cls(middle, white, (far[0], far[1], both))

    def surprises(self, z: Float[Array, "T nz"], variance: Float[Array, "T ny"]) -> Array:
        """Surprise of each sample: 1 is as far as 99 % of the training samples go."""
        a, b, both = self.farthest
        of_z, of_y = self._distances(z, variance)
        return np.maximum(of_z / a, of_y / b) / both

    def _distances(self, z: Array, variance: Array) -> tuple[Array, Array]:
        of_z = np.linalg.norm((z - self.middle) @ self.white.T, axis=1)
        return of_z, np.sqrt(variance.sum(axis=1))
