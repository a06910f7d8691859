"""Range of training data, and distance of other samples from them: the surprise index."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lfrtorch._support.types import Array
from lfrtorch.model.data_reach import FARTHEST, Cloud


@dataclass(frozen=True, eq=False)
class TrainingReach:
    """Range of the training data in the static map's input z, and in the uncertainty of y.

    The larger of two distances counts, each relative to its value within which 99 % of the training
    samples are. The first is that of z from the middle of its cloud, in standard deviations of the
    cloud. The second is the standard deviation of the simulated output, which covers dynamics, too.
    """

    z: Cloud
    of_y: float
    both: float  # 99 % quantile of the larger of the two distances

    @classmethod
    def of(cls, z: Float[Array, "S nz"], variance: Float[Array, "S ny"]) -> TrainingReach:
        """Build it from z and the variances of the outputs at the training samples."""
        of_y = float(np.quantile(np.sqrt(variance.sum(axis=1)), FARTHEST)) or 1.0
        found = cls(Cloud.of(z), of_y, 1.0)
        both = float(np.quantile(found.surprises(z, variance), FARTHEST)) or 1.0
        return cls(found.z, of_y, both)

    def surprises(self, z: Float[Array, "T nz"], variance: Float[Array, "T ny"]) -> Array:
        """Surprise of each sample: 99 % of the training samples are within 1."""
        return np.maximum(self.z.surprise(z), np.sqrt(variance.sum(axis=1)) / self.of_y) / self.both
