"""Complex least squares at many spectral lines at once."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lfrtorch._types import Complex

DEPENDENT = 1e-10
"""A column whose part across the columns before it is relatively below this depends on them."""


class Regression(NamedTuple):
    """Solution of Y = X Θ by line, of which the last nu columns of X are of interest.

    Args:
        G: transpose of the last nu rows of Θ.
        weights: the same rows of the pseudo-inverse of X, so that G = (weights Y)ᵀ.
        residual: Y - X Θ.
        determined: where the columns of X are independent; elsewhere the rest means nothing.

    Shape:
        G: (F, ny, nu), weights: (F, nu, R), residual: (F, R, ny), determined: (F,).
    """

    G: Complex
    weights: Complex
    residual: Complex
    determined: NDArray[np.bool_]


def regress(X: Complex, Y: Complex, nu: int) -> Regression:
    """Least-squares solution of Y = X Θ at every line, by QR.

    With X = Q R only the last block of R acts on the last nu unknowns.

    Shape:
        X: (F, R, p), Y: (F, R, ny), p >= nu, R >= p.
    """
    Q, R = np.linalg.qr(X)
    across = np.abs(np.diagonal(R, axis1=1, axis2=2))
    determined = (across > DEPENDENT * np.linalg.norm(X, axis=1)).all(axis=1)
    R = np.where(determined[:, None, None], R, np.eye(R.shape[-1]))
    Qh = Q.conj().swapaxes(1, 2)
    QhY = Qh @ Y
    last = np.concatenate([QhY[:, -nu:], Qh[:, -nu:]], axis=2)
    solved = np.asarray(np.linalg.solve(R[:, -nu:, -nu:], last), dtype=np.complex128)
    G, weights = solved[:, :, : Y.shape[2]].swapaxes(1, 2), solved[:, :, Y.shape[2] :]
    return Regression(G, weights, Y - Q @ QhY, determined)


def outer(errors: Complex, other: Complex | None = None) -> Complex:
    """Sum over the rows r of e_r e_rᴴ at every line (or of e_r o_rᴴ).

    Shape:
        errors: (F, R, n) -> (F, n, n).
    """
    other = errors if other is None else other
    return errors.swapaxes(1, 2) @ other.conj()


def covariance(C: Complex, weights: Complex) -> Complex:
    """Covariance of vec(G), row-major, where the rows of Y have independent errors of covariance C.

    δG = Σ_r v_r w_r with E[v vᴴ] = C, so that E[δG_yu δG_y'u'*] = C_yy' Σ_r w_ru w_ru'*.

    Shape:
        C: (F, ny, ny), weights: (F, nu, R) -> (F, ny nu, ny nu).
    """
    A = weights @ weights.conj().swapaxes(1, 2)
    size = C.shape[1] * A.shape[1]
    return np.einsum("fab,fcd->facbd", C, A).reshape(-1, size, size)
