"""How far training data went, and how far beyond them other samples are: the surprise index."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lfrtorch._support.types import Array

FARTHEST = 0.99
"""Part of the training samples whose surprise is below 1."""

FLAT = 1e-12
"""Least variance of z in a direction, relative to the largest."""


@dataclass(frozen=True, eq=False)
class TrainingReach:
    """How far the training data went: in the static map's input z, and in what they tell of y.

    Two distances count, whichever is larger, each relative to that of 99 % of the training samples:
    that of z from the middle of its cloud, in standard deviations of the cloud, and the standard
    deviation of the simulated output. The first says that the static map is asked where it was not
    seen, the second that dynamics are, too, as of another band of frequencies.

    Args:
        middle: mean of z.
        white: so that white (z - middle) has unit covariance.
        farthest: of 99 % of the training samples: both distances, and then the larger ratio.

    Example:
        >>> from lfrtorch.analysis.training_reach import TrainingReach
        >>> reach = TrainingReach.of(np.linspace(-1, 1, 101)[:, None], np.ones((101, 1)))
        >>> reach.surprises(np.array([[0.0], [2.0]]), np.ones((2, 1))).round(1).tolist()
        [1.0, 2.0]
    """

    middle: Float[Array, " nz"]
    white: Float[Array, "nz nz"]
    farthest: tuple[float, float, float]

    @classmethod
    def of(cls, z: Float[Array, "S nz"], variance: Float[Array, "S ny"]) -> TrainingReach:
        """From z and the variances of the outputs at the training samples."""
        middle = z.mean(axis=0)
        values, vectors = np.linalg.eigh((z - middle).T @ (z - middle) / len(z))
        least = max(FLAT * values.max(initial=0.0), 1e-300)
        white = vectors.T / np.sqrt(np.maximum(values, least))[:, None]
        found = cls(middle, white, (1.0, 1.0, 1.0))
        far = [float(np.quantile(d, FARTHEST)) or 1.0 for d in found._distances(z, variance)]
        found = cls(middle, white, (far[0], far[1], 1.0))
        both = float(np.quantile(found.surprises(z, variance), FARTHEST)) or 1.0
        return cls(middle, white, (far[0], far[1], both))

    def surprises(self, z: Float[Array, "T nz"], variance: Float[Array, "T ny"]) -> Array:
        """How far samples are: 1 is as far as 99 % of the training samples go."""
        a, b, both = self.farthest
        of_z, of_y = self._distances(z, variance)
        return np.maximum(of_z / a, of_y / b) / both

    def _distances(self, z: Array, variance: Array) -> tuple[Array, Array]:
        of_z = np.linalg.norm((z - self.middle) @ self.white.T, axis=1)
        return of_z, np.sqrt(variance.sum(axis=1))
