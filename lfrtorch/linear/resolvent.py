"""Frequency response of a linear state-space model, and its slope with the matrices.

The response at z is G = C (zI - A)⁻¹ B + D. With X = (zI - A)⁻¹ B and L = C (zI - A)⁻¹ its slope is
a product: dG = [L I] [dA dB; dC dD] [X; I].
"""

from __future__ import annotations

import numpy as np
import scipy.linalg

from lfrtorch._types import Array, Complex, Integers


def resolvent(A: Array, B: Array, z: Complex) -> Complex:
    """X = (zI - A)⁻¹ B.

    By a Schur form of A, one substitution over all z together: as accurate as a solution for every
    z, where eigenvectors would lose digits at poles that lie close together.

    Shape:
        A: (nx, nx), B: (nx, nu), z: (F,) -> (F, nx, nu).
    """
    T, Q = scipy.linalg.schur(A, output="complex")
    forced = Q.conj().T @ B
    nx, nu, F = len(A), B.shape[1], len(z)
    X = np.empty((nx, nu * F), dtype=complex)
    for k in range(nx - 1, -1, -1):
        known = (T[k, k + 1 :] @ X[k + 1 :]).reshape(nu, F)
        X[k] = ((forced[k][:, None] + known) / (z - T[k, k])).ravel()
    return (Q @ X).reshape(nx, nu, F).transpose(2, 0, 1)


def resolvents(A: Array, B: Array, C: Array, z: Complex) -> tuple[Complex, Complex]:
    """X = (zI - A)⁻¹ B and L = C (zI - A)⁻¹.

    Shape:
        z: (F,) -> X: (F, nx, nu), L: (F, ny, nx).
    """
    return resolvent(A, B, z), resolvent(A.T, C.T, z).swapaxes(1, 2)


def frequency_response(A: Array, B: Array, C: Array, D: Array, z: Complex) -> Complex:
    """G (F, ny, nu) at z (F,)."""
    return np.asarray(C @ resolvent(A, B, z) + D, dtype=np.complex128)


def slopes(X: Complex, L: Complex, U: Complex, columns: Integers | None = None) -> Complex:
    """Slope of G U with the entries of A, B, C, D, each by rows, one after another.

    Args:
        X, L: the resolvents.
        U: input spectra.
        columns: the entries wanted; all of them where left out.

    Shape:
        X: (F, nx, nu), L: (F, ny, nx), U: (F, nu, m), columns: (K,) -> (F, ny, m, K).
    """
    F, nx, nu = X.shape
    ny = L.shape[1]
    rows, others = _places(nx, nu, ny)
    if columns is not None:
        rows, others = rows[columns], others[columns]
    left = np.concatenate([L, np.broadcast_to(np.eye(ny), (F, ny, ny))], axis=2)
    right = np.concatenate([X @ U, U], axis=1).swapaxes(1, 2)
    return left[:, :, None, rows] * right[:, None, :, others]


def _places(nx: int, nu: int, ny: int) -> tuple[Integers, Integers]:
    """Row and column of every entry of A, B, C, D in [A B; C D]."""
    x, u, y = np.arange(nx), nx + np.arange(nu), nx + np.arange(ny)
    blocks = [np.meshgrid(r, c, indexing="ij") for r, c in ((x, x), (x, u), (y, x), (y, u))]
    rows, columns = zip(*blocks, strict=True)
    return np.concatenate([r.ravel() for r in rows]), np.concatenate([c.ravel() for c in columns])
