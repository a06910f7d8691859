"""Range of the data of a fit, outside of which a model extrapolates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lfrtorch._support.tables import quantities
from lfrtorch._support.types import Array
from lfrtorch.data.records import Channel

FARTHEST = 0.99
"""Part of the samples with a surprise index below 1."""

_FLAT = 1e-12  # relative power below which a direction has no signal


@dataclass(frozen=True, eq=False)
class Cloud:
    """Samples of a signal z: |axes (z - middle)| is at most ``farthest`` for 99 % of them.

    Args:
        middle: mean.
        axes: axes (z - middle) has unit covariance.
        ends: least and largest entries of that vector: a box of all samples.
        farthest: length of that vector for 99 % of the samples, at most.

    Shape:
        middle: (n,), axes: (n, n), ends: (n, 2).
    """

    middle: Float[Array, " n"]
    axes: Float[Array, "n n"]
    ends: Float[Array, "n 2"]
    farthest: float

    @classmethod
    def of(cls, z: Float[Array, "S n"]) -> Cloud:
        """Build it from all samples."""
        middle, axes = z.mean(axis=0), whitening(z)
        white = (z - middle) @ axes.T
        far = float(np.quantile(np.linalg.norm(white, axis=1), FARTHEST))
        return cls(
            middle, axes, np.stack([white.min(axis=0), white.max(axis=0)], axis=1), far or 1.0
        )

    def surprise(self, z: Float[Array, "*T n"]) -> Float[Array, "*T"]:
        """Surprise index of z: its distance from the middle; at most 1 for 99 % of the samples."""
        distance = np.linalg.norm((z - self.middle) @ self.axes.T, axis=-1)
        return np.asarray(distance / self.farthest)

    def turned(self, Z: Float[Array, "n n"]) -> Cloud:
        """Return the cloud of Z z."""
        return Cloud(Z @ self.middle, self.axes @ np.linalg.inv(Z), self.ends, self.farthest)


@dataclass(frozen=True, eq=False)
class DataReach:
    """Range of the data of a fit.

    Args:
        u, y: least and largest value of each channel, physical units.
        z: cloud of the input of the static map, normalised.

    Shape:
        u: (nu, 2), y: (ny, 2).

    Example:
        >>> known = model.reaching(record).reach
        >>> known.u.shape, known.z.axes.shape
        ((1, 2), (1, 1))
        >>> z = model.signals(record).z[0].numpy()
        >>> bool(np.quantile(known.z.surprise(z), 0.99) <= 1 + 1e-9)
        True
    """

    u: Float[Array, "nu 2"]
    y: Float[Array, "ny 2"]
    z: Cloud

    @classmethod
    def of(
        cls, u: Float[Array, "S nu"], y: Float[Array, "S ny"], z: Float[Array, "S nz"]
    ) -> DataReach:
        """Build it from all samples; y may have NaN."""
        of_u, of_y = (
            np.stack([np.nanmin(s, axis=0), np.nanmax(s, axis=0)], axis=1) for s in (u, y)
        )
        return cls(of_u, of_y, Cloud.of(z))

    def outside(
        self,
        u: Float[Array, " nu"],
        y: Float[Array, " ny"],
        z: Float[Array, " nz"],
        inputs: Sequence[Channel],
        outputs: Sequence[Channel],
    ) -> str:
        """Parts of an operating point that the data did not reach, in words; empty if none."""
        found = []
        for values, ranges, channels in ((u, self.u, inputs), (y, self.y, outputs)):
            for value, (low, high), channel in zip(values, ranges, channels, strict=True):
                slack = 1e-6 * (high - low)
                if not low - slack <= value <= high + slack:
                    here, least, most = quantities([value, low, high], channel.unit)
                    found.append(f"{channel.name} = {here} ({least} to {most} in the data)")
        surprise = float(self.z.surprise(z)) if len(z) else 0.0
        if surprise > 1.0:
            found.append(f"the static map's input, {surprise:.2g} times as far as 99 % of the data")
        return "; ".join(found)


def whitening(signal: Float[Array, "S n"]) -> Float[Array, "n n"]:
    """Matrix T such that T s has unit covariance."""
    centred = signal - signal.mean(axis=0)
    power, axes = np.linalg.eigh(centred.T @ centred / len(centred))
    least = max(_FLAT * float(power.max(initial=0.0)), 1e-300)
    return (axes / np.sqrt(np.maximum(power, least))).T
