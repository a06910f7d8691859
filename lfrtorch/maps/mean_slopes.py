"""Means of a map's slope: f(z0 + ζ) = f(z0) + Δ ζ, Δ = ∫ f'(z0 + t ζ) dt over t from 0 to 1."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from lfrtorch._support.types import Array


class Quadrature(NamedTuple):
    """Rule for the integral: nodes t from 0 to 1, weights, and True if it is exact."""

    t: Float[Array, " n"]
    weight: Float[Array, " n"]
    exact: bool

    @classmethod
    def gauss_legendre(cls, nodes: int, *, exact: bool = False) -> Quadrature:
        """Gauss-Legendre rule, exact for polynomials in t of a degree below twice the nodes."""
        t, weight = np.polynomial.legendre.leggauss(nodes)
        return cls((t + 1.0) / 2, weight / 2, exact)


class Neurons(NamedTuple):
    """Mean slope Δ = L diag(p) R of w = L σ(R z + b) + .., with the mean slopes p of the neurons.

    Args:
        left: L, (nw, P).
        right: R, (P, nz).
        bounds: least and largest p, (P, 2).
        mean_slopes: z0 (nz,), ζ (S, nz) -> p (S, P).
    """

    left: Float[Array, "nw P"]
    right: Float[Array, "P nz"]
    bounds: Float[Array, "P 2"]
    mean_slopes: Callable[[Array, Array], Array]

    def delta(self, z0: Float[Array, " nz"], zeta: Float[Array, "S nz"]) -> Array:
        """Mean slope Δ, (S, nw, nz)."""
        return self.left @ (self.mean_slopes(z0, zeta)[..., None] * self.right)

    @property
    def delta_bounds(self) -> Float[Array, "nw nz 2"]:
        """Bounds of the entries of Δ, by interval arithmetic."""
        low, high = np.sort(self.bounds.T[..., None] * self.right, axis=0)
        plus, minus = np.maximum(self.left, 0.0), np.minimum(self.left, 0.0)
        return np.stack([plus @ low + minus @ high, plus @ high + minus @ low], axis=-1)
