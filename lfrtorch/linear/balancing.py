"""Balanced coordinates of a linear model."""

from __future__ import annotations

import numpy as np

from lfrtorch._support.types import Array


def balancing(A: Array, B: Array, C: Array) -> tuple[Array, Array]:
    """Return T and T⁻¹ to balanced coordinates, by the square-root method (Laub et al. 1987).

    For an unstable system, which has no balanced coordinates, both are the identity.
    """
    controllable, observable = _gramian(A, B @ B.T), _gramian(A.T, C.T @ C)
    if controllable is None or observable is None:
        return np.eye(len(A)), np.eye(len(A))
    Lp, Lq = _square_root(controllable), _square_root(observable)
    U, s, Vh = np.linalg.svd(Lq.T @ Lp)
    if not s.any():  # no input reaches an output: all coordinates are balanced
        return np.eye(len(A)), np.eye(len(A))
    # A state that is almost uncontrollable or unobservable would be scaled by its rounding error.
    root = np.sqrt(np.maximum(s, s[0] * np.finfo(float).eps))
    return (U / root).T @ Lq.T, Lp @ (Vh.T / root)


_DOUBLINGS = 60
"""Enough doublings for every pole to decay that rounding can tell from one on the unit circle."""


def _gramian(A: Array, Q: Array) -> Array | None:
    """P = A P Aᵀ + Q by Smith's doubling.

    scipy's solver forms I - A ⊗ A, which is singular to rounding if two poles are close to the unit
    circle; the sum of A^k Q A^kᵀ stays positive semidefinite there. None if rounding puts a pole on
    or beyond the circle.
    """
    P, eps = Q, np.finfo(float).eps
    for _ in range(_DOUBLINGS):
        if np.abs(A).max() <= eps:
            return P
        if np.abs(A).max() >= 1.0 / eps:
            break
        P = P + A @ P @ A.T
        A = A @ A
    return None


def _square_root(gramian: Array) -> Array:
    values, vectors = np.linalg.eigh((gramian + gramian.T) / 2)
    return vectors * np.sqrt(np.maximum(values, 0.0))
