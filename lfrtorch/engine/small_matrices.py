"""Decompositions of matrices with about ten numbers, in machine code.

A call of LAPACK takes longer than these functions, and so does its compilation.

References:
    Demmel and Veselić, "Jacobi's method is more accurate than QR", SIAM J. Matrix Analysis and
    Applications 13, 1992.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

_SWEEPS = 40
"""Largest number of sweeps of Jacobi's method, which converges quadratically in fewer than ten."""


@njit(nogil=True, error_model="numpy")
def reflect(M, rows):
    """M times an orthogonal matrix, in place, that makes its first rows lower triangular."""
    for k in range(rows):
        square = 0.0
        for j in range(k, M.shape[1]):
            square += M[k, j] * M[k, j]
        if square == 0.0:
            continue
        # The mirror image of row k has -sign(M_kk) |row| on the diagonal; v is their difference.
        diagonal = -math.copysign(math.sqrt(square), M[k, k])
        v = M[k, k] - diagonal
        scale = 1.0 / (square - diagonal * M[k, k])  # 2 / |v|²
        for i in range(k + 1, len(M)):
            a = M[i, k] * v
            for j in range(k + 1, M.shape[1]):
                a += M[i, j] * M[k, j]
            a *= scale
            M[i, k] -= a * v
            for j in range(k + 1, M.shape[1]):
                M[i, j] -= a * M[k, j]
        M[k, k] = diagonal
        for j in range(k + 1, M.shape[1]):
            M[k, j] = 0.0


@njit(nogil=True, error_model="numpy")
def svd(M):
    """U, s and V of M = U diag(s) Vᵀ, in any order; U has columns of 0 where s is about 0.

    Rotations of pairs of columns make all columns orthogonal.

    Shape:
        M: (m, n), U: (m, n), s: (n,), V: (n, n).
    """
    n, eps = M.shape[1], np.finfo(np.float64).eps
    U, V, s = M.copy(), np.eye(n), np.zeros(n)
    for _ in range(_SWEEPS):
        turned = False
        for p in range(n):
            for q in range(p + 1, n):
                a, b, c = 0.0, 0.0, 0.0
                for i in range(len(U)):
                    a += U[i, p] * U[i, p]
                    b += U[i, q] * U[i, q]
                    c += U[i, p] * U[i, q]
                if abs(c) > eps * math.sqrt(a * b):
                    turned = True
                    cot = (b - a) / (2.0 * c)  # tangent of twice the angle
                    tan = math.copysign(1.0, cot) / (abs(cot) + math.sqrt(1.0 + cot * cot))
                    cos = 1.0 / math.sqrt(1.0 + tan * tan)
                    _turn(U, p, q, cos, cos * tan)
                    _turn(V, p, q, cos, cos * tan)
        if not turned:
            break
    for j in range(n):
        for i in range(len(U)):
            s[j] += U[i, j] * U[i, j]
        s[j] = math.sqrt(s[j])
    for j in range(n):
        seen = s[j] > eps * s.max()
        for i in range(len(U)):
            U[i, j] = U[i, j] / s[j] if seen else 0.0
    return U, s, V


@njit(nogil=True)
def _turn(M, p, q, cos, sin):
    for i in range(len(M)):
        a, b = M[i, p], M[i, q]
        M[i, p] = cos * a - sin * b
        M[i, q] = sin * a + cos * b
