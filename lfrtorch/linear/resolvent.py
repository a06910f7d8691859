"""Frequency response of a linear state-space model, and its Jacobian with the matrices.

At a point z of the unit circle the response is G = C (zI - A)⁻¹ B + D. Two parts of it are needed
for the derivative: X = (zI - A)⁻¹ B, what the inputs do to the states, and L = C (zI - A)⁻¹, what a
disturbance of the states does to the outputs. A small change of the matrices then changes G by
dG = [L I] [dA dB; dC dD] [X; I], a product without any further inverse.
"""

from __future__ import annotations

import numpy as np
import scipy
from jaxtyping import Complex128, Float, Integer
from numpy.typing import ArrayLike

from lfrtorch._support.checks import reals
from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array, Complex, Integers


def solve_resolvent(
    A: Float[Array, "nx nx"], B: Float[Array, "nx nu"], z: Complex128[Complex, " F"]
) -> Complex128[Complex, "F nx nu"]:
    """X = (zI - A)⁻¹ B, by a Schur form A = Q T Qᴴ and back substitution for all z at once."""
    # Eigenvectors would lose digits if poles lie close together.
    T, Q = scipy.linalg.schur(A, output="complex")
    return _substituted(T, Q, (Q.conj().T @ B)[:, :, None], z)


def solve_driven(
    A: Float[Array, "nx nx"],
    B: Float[Array, "nx nu"],
    z: Complex128[Complex, " F"],
    U: Complex128[Complex, "F nu m"],
) -> Complex128[Complex, "F nx m"]:
    """(zI - A)⁻¹ B U, the states under inputs: less work than X if these have fewer columns."""
    T, Q = scipy.linalg.schur(A, output="complex")
    return _substituted(T, Q, np.tensordot(Q.conj().T @ B, U, (1, 1)).swapaxes(1, 2), z)


def _substituted(T: Complex, Q: Complex, forced: Complex, z: Complex) -> Complex:
    """Q (zI - T)⁻¹ forced (nx, m, F or 1), as (F, nx, m)."""
    (nx, m, _), F = forced.shape, len(z)
    X = np.empty((nx, m * F), dtype=complex)
    for k in range(nx - 1, -1, -1):
        known = (T[k, k + 1 :] @ X[k + 1 :]).reshape(m, F)
        X[k] = ((forced[k] + known) / (z - T[k, k])).ravel()
    return (Q @ X).reshape(nx, m, F).transpose(2, 0, 1)


def solve_left(
    A: Float[Array, "nx nx"], C: Float[Array, "ny nx"], z: Complex128[Complex, " F"]
) -> Complex128[Complex, "F ny nx"]:
    """Return L = C (zI - A)⁻¹."""
    return solve_resolvent(A.T, C.T, z).swapaxes(1, 2)


def frequency_response(
    A: Float[Array, "nx nx"],
    B: Float[Array, "nx nu"],
    C: Float[Array, "ny nx"],
    D: Float[Array, "ny nu"],
    z: Complex128[Complex, " F"],
) -> Complex128[Complex, "F ny nu"]:
    """G = C (zI - A)⁻¹ B + D."""
    return np.asarray(C @ solve_resolvent(A, B, z) + D, dtype=np.complex128)


def response_jacobian(
    S: Complex128[Complex, "F nx m"],
    L: Complex128[Complex, "F ny nx"],
    U: Complex128[Complex, "F nu m"],
    columns: Integer[np.ndarray, " K"] | None = None,
) -> Complex128[Complex, "F ny m K"]:
    """Derivative of G U with the entries of A, B, C, D, row by row, from the states S = X U."""
    F, ny, nx = L.shape
    rows, others = _places(nx, U.shape[1], ny)
    if columns is not None:
        rows, others = rows[columns], others[columns]
    left = np.concatenate([L, np.broadcast_to(np.eye(ny), (F, ny, ny))], axis=2)
    right = np.concatenate([S, U], axis=1).swapaxes(1, 2)
    return left[:, :, None, rows] * right[:, None, :, others]


def gain_jacobian(
    A: Float[Array, "nx nx"],
    B: Float[Array, "nx nu"],
    C: Float[Array, "ny nx"],
    z: Complex128[Complex, " F"],
) -> Complex128[Complex, "F ny nu P"]:
    """Derivative of G itself with all entries of A, B, C, D."""
    one = np.broadcast_to(np.eye(B.shape[1], dtype=complex), (len(z), *B.shape[1:] * 2))
    return response_jacobian(solve_resolvent(A, B, z), solve_left(A, C, z), one)


def _places(nx: int, nu: int, ny: int) -> tuple[Integers, Integers]:
    """Row and column of every entry of A, B, C, D in [A B; C D]."""
    x, u, y = np.arange(nx), nx + np.arange(nu), nx + np.arange(ny)
    blocks = [np.meshgrid(r, c, indexing="ij") for r, c in ((x, x), (x, u), (y, x), (y, u))]
    rows, columns = zip(*blocks, strict=True)
    return np.concatenate([r.ravel() for r in rows]), np.concatenate([c.ravel() for c in columns])


def response_covariance(
    A: Float[Array, "nx nx"],
    B: Float[Array, "nx nu"],
    C: Float[Array, "ny nx"],
    covariance: Float[Array, "P P"] | None,
    z: Complex128[Complex, " F"],
) -> Float[Array, "F ny nu 2 2"]:
    """Covariance of the real and imaginary part of G from that of the matrices' entries."""
    J = gain_jacobian(A, B, C, z)
    parts = np.stack([J.real, J.imag], axis=-2)
    return np.einsum("...ip,pq,...jq->...ij", parts, known(covariance), parts, optimize=True)


def known(covariance: Array | None) -> Array:
    """The covariance of a linear model; a ValueError if there is none."""
    if covariance is None:
        raise InputError(
            "the covariance of this model is not known: take one of estimate_bla, or of "
            "lfrtorch.analysis.uncertainty(model, records).linearise()."
        )
    return covariance


def unit_circle(frequencies: ArrayLike, fs: float) -> Complex128[Complex, " F"]:
    """The points z of frequencies in Hz."""
    f = np.atleast_1d(reals("frequencies", frequencies))
    if f.ndim != 1:
        raise InputError(f"the frequencies have shape {f.shape}; give one dimension, in Hz.")
    return np.exp(2j * np.pi * f / fs)
