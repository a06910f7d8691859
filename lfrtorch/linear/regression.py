"""Complex least squares at many DFT lines at once, and the covariance of its solution."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex128

from lfrtorch._support.types import Booleans, Complex

DEPENDENT = 1e-10
"""A column is dependent if its part orthogonal to those before it is below this share of it."""


class Regression(NamedTuple):
    """Solution of Y = X Θ at each line; the response belongs to the last nu columns of X."""

    G: Complex128[Complex, "F ny nu"]
    weights: Complex128[Complex, "F nu R"]  # G = (weights Y)ᵀ
    residual: Complex128[Complex, "F R ny"]
    determined: Bool[Booleans, " F"]  # if not, the rest means nothing


def regress(
    X: Complex128[Complex, "F R p"], Y: Complex128[Complex, "F R ny"], nu: int
) -> Regression:
    """Least-squares solution of Y = X Θ at every line, by QR; nu <= p <= R.

    In X = Q R only the last block of R acts on the last nu unknowns.
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


def divided(fitted: Regression, ny: int) -> Regression:
    """Return the response between columns of Y, from the last nu of them to the first ny.

    Y = [y, u] follows from X as y = G_y X and u = G_u X, and so y = G_y G_u⁻¹ u: what X drives
    through u, without what else moves y and u together.
    """
    Gy, Gu = fitted.G[:, :ny], fitted.G[:, ny:]
    size = np.linalg.svd(Gu, compute_uv=False)
    determined = fitted.determined & (size[:, -1] > DEPENDENT * size[:, 0])
    inverse = np.linalg.inv(np.where(determined[:, None, None], Gu, np.eye(Gu.shape[1])))
    G = Gy @ inverse
    residual = fitted.residual[:, :, :ny] - fitted.residual[:, :, ny:] @ G.swapaxes(1, 2)
    return Regression(G, inverse.swapaxes(1, 2) @ fitted.weights, residual, determined)


def outer(errors: Complex128[Complex, "F R n"]) -> Complex128[Complex, "F n n"]:
    """Sum over the rows r of e_r e_rᴴ at every line."""
    return errors.swapaxes(1, 2) @ errors.conj()


def covariance(
    C: Complex128[Complex, "F ny ny"], weights: Complex128[Complex, "F nu R"]
) -> Complex128[Complex, "F ny*nu ny*nu"]:
    """Covariance of vec(G), row-major, if the rows of Y have independent errors of covariance C.

    δG = Σ_r v_r w_r with E[v vᴴ] = C, so that E[δG_yu δG_y'u'*] = C_yy' Σ_r w_ru w_ru'*.
    """
    A = weights @ weights.conj().swapaxes(1, 2)
    size = C.shape[1] * A.shape[1]
    return np.einsum("fab,fcd->facbd", C, A).reshape(-1, size, size)
