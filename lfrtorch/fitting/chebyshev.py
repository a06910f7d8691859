"""Chebyshev polynomials of several variables up to a total degree, and their slopes."""

from __future__ import annotations

from functools import reduce
from itertools import product
from operator import mul

import numpy as np

from lfrtorch._support.types import Array

REACH = 3.0
"""z that is mapped to 1, in standard deviations: the polynomials grow beyond it."""


def chebyshev(z: Array, degree: int) -> Array:
    """φ(z): products of one Chebyshev polynomial in each z / 3.

    Their span is that of all monomials up to the degree, which no affine map of z changes; for z of
    unit deviation they are far from collinear, as monomials are not.

    Args:
        z: points.
        degree: highest sum of the degrees of the factors.

    Shape:
        z: (..., nz) -> φ: (..., nf), nf = (nz + degree)! / (nz! degree!).
    """
    T, _ = _factors(z, degree)
    powers = _powers(z.shape[-1], degree)
    terms = [reduce(mul, [T[p][..., i] for i, p in enumerate(power)]) for power in powers]
    return np.stack(terms, axis=-1)


def chebyshev_slope(z: Array, degree: int) -> Array:
    """∂φ/∂z (..., nf, nz) at z (..., nz)."""
    T, dT = _factors(z, degree)
    nz = z.shape[-1]
    terms = [
        reduce(mul, [(dT if j == i else T)[p][..., j] for j, p in enumerate(power)])
        for power in _powers(nz, degree)
        for i in range(nz)
    ]
    return np.stack(terms, axis=-1).reshape(*z.shape[:-1], -1, nz)


def _factors(z: Array, degree: int) -> tuple[list[Array], list[Array]]:
    """The polynomials of each z / 3 by rising degree, and their slopes, (..., nz) each."""
    t = z / REACH
    T, dT = [np.ones_like(t), t], [np.zeros_like(t), np.full_like(t, 1.0 / REACH)]
    for _ in range(1, degree):
        dT.append(2.0 / REACH * T[-1] + 2.0 * t * dT[-1] - dT[-2])
        T.append(2.0 * t * T[-1] - T[-2])
    return T, dT


def _powers(nz: int, degree: int) -> list[tuple[int, ...]]:
    """Degrees of the factors of each term; the first is the constant."""
    return [p for p in product(range(degree + 1), repeat=nz) if sum(p) <= degree]
