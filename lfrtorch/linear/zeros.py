"""Finite zeros of a linear state-space model."""

from __future__ import annotations

import numpy as np

from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array, Complex


def finite_zeros(A: Array, B: Array, C: Array, D: Array) -> Complex:
    """Finite invariant zeros, after those at infinity are taken out one by one.

    The eigenvalues of the pencil [A - zI, B; C, D] will not do: rounding moves an infinite zero of
    multiplicity k to a radius of about eps^(-1/k), 2e3 for a delay of five samples.

    References:
        Emami-Naeini and Van Dooren, "Computation of zeros of linear multivariable systems",
        Automatica 18, 1982.
    """
    if D.shape[0] != D.shape[1]:
        raise InputError(
            f"a model of {D.shape[1]} input(s) and {D.shape[0]} output(s) has no transmission "
            "zeros in general; ask for those of a channel: zeros(output, input)."
        )
    for _ in range(2):  # an input in tiny units makes its outputs tiny the first time
        by_y = np.linalg.norm(np.hstack([C, D]), axis=1)
        C, D = (M / np.where(by_y > 0, by_y, 1.0)[:, None] for M in (C, D))
        by_u = np.linalg.norm(np.vstack([B, D]), axis=0)
        B, D = (M / np.where(by_u > 0, by_u, 1.0) for M in (B, D))
    limit = 1e-12 * float(np.linalg.norm(np.block([[A, B], [C, D]]), 2))
    A, B, C, D = _outputs_reduced(A, B, C, D, limit)
    A, C, B, D = (M.T for M in _outputs_reduced(A.T, C.T, B.T, D.T, limit))
    zeros = np.linalg.eigvals(A - B @ np.linalg.solve(D, C))  # D is square and regular now
    return np.asarray(zeros, dtype=np.complex128)


def _outputs_reduced(
    A: Array, B: Array, C: Array, D: Array, limit: float
) -> tuple[Array, Array, Array, Array]:
    """Return a system with the same finite zeros whose D has full row rank."""
    while True:
        U, rank = _range(D, limit)
        C, D = U.T @ C, (U.T @ D)[:rank]
        V, free = _range(C[rank:].T, limit)
        C = C[:rank]
        if not free:
            return A, B, C, D
        # At a zero, an output without direct term is 0, and so are the states that it sees.
        V = np.roll(V, -free, axis=1)
        A, B, C = V.T @ A @ V, V.T @ B, C @ V
        n = len(A) - free
        C, D = np.vstack([C[:, :n], A[n:, :n]]), np.vstack([D, B[n:]])
        A, B = A[:n, :n], B[:n]


def _range(M: Array, limit: float) -> tuple[Array, int]:
    """Return an orthogonal matrix, and how many of its first columns span the range of M."""
    U, s, _ = np.linalg.svd(M)
    return U, int((s > limit).sum())
