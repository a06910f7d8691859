"""Local polynomial method: the frequency response from any excitation, transients included.

In a record that is not periodic, the spectrum of the output is G U plus a transient, as the states
at its beginning and end differ. Both G and the transient are smooth functions of frequency. So in
a window of a few neighbouring lines they are polynomials with few coefficients, found by least
squares; what these do not explain is noise and nonlinear distortion.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Complex128, Int64

from lfrtorch._support.types import Booleans, Complex, Integers
from lfrtorch.linear.regression import DEPENDENT, covariance, divided, outer, regress

CHUNK = 2**21
"""Complex numbers of the windows that are in memory at a time: 32 MiB, and as many in copies."""


def half_width(order: int, degrees_of_freedom: int, nu: int, records: int) -> int:
    """Smallest n for which a window of 2 n + 1 lines leaves ``degrees_of_freedom``.

    R (2 n + 1) equations have (order + 1) (nu + R) unknowns: G, and the transient of each record.
    """
    rows = -(-((order + 1) * nu + degrees_of_freedom) // records)  # of a record, without transient
    return (rows + order + 1) // 2


def fit_local_polynomials(
    U: Complex128[Complex, "lines R nu"],
    Y: Complex128[Complex, "lines R driven"],
    centres: Int64[Integers, " F"],
    *,
    order: int,
    n: int,
    outputs: int | None = None,
) -> tuple[
    Complex128[Complex, "F ny nu"],
    Complex128[Complex, "F ny*nu ny*nu"],
    Bool[Booleans, " F"],
]:
    """Frequency response at lines of spectra that hold transients, and its covariance.

    About each centre k, for the 2 n + 1 lines k + r nearest to it (shifted at the ends)::

        Y(k + r) = (Σ_s g_s rˢ) U(k + r) + Σ_s t_s rˢ + V(k + r),    s = 0 .. order

    The records share g, and each has its own t. A projection across all polynomials of the order,
    the same for all windows, removes t. The result is g_0 = G(k).

    Args:
        U, Y: spectra at successive lines.
        centres: at which lines, counted from the first one of the spectra.
        order: of the polynomials.
        n: half width of the window.
        outputs: how many of Y are outputs if U is a reference: the others are the inputs, and G is
            the response from these to the outputs. Default: all.

    Returns:
        G, the covariance of vec(G) from the residuals (noise and nonlinear distortion together),
        and whether the input determines G about each centre.

    References:
        Pintelon and Schoukens, "System Identification: A Frequency Domain Approach", 2nd ed.,
        2012, chapter 7.
    """
    records, nu = U.shape[1:]
    width = 2 * n + 1
    powers = np.arange(order, -1, -1)  # g_0 last: see regress
    vandermonde = (np.arange(-n, n + 1)[:, None] / n) ** powers
    complement = np.linalg.qr(vandermonde, mode="complete")[0][:, order + 1 :]
    rows = records * complement.shape[1]
    freedom = rows - (order + 1) * nu
    first = np.clip(centres - n, 0, len(U) - width)

    parts = []
    size = max(1, CHUNK // (records * width * (order + 1) * (nu + Y.shape[2])))
    for start in range(0, len(centres), size):
        part = slice(start, start + size)
        window = first[part, None] + np.arange(width)
        r = ((window - centres[part, None]) / n)[:, :, None] ** powers
        X = np.einsum("wm,fwru,fws->frmsu", complement, U[window], r, optimize=True)
        projected = np.einsum("wm,fwry->frmy", complement, Y[window], optimize=True)
        shape = len(window), rows, -1
        fitted = regress(X.reshape(shape), projected.reshape(shape), nu)
        if outputs is not None:
            fitted = divided(fitted, outputs)
        C = outer(fitted.residual) / freedom
        # If one line alone has power, some columns are rounding errors, which pass as independent.
        sizes = np.linalg.norm(X, axis=(1, 2))  # (line, s, input)
        determined = (sizes > DEPENDENT * sizes.max(axis=1, keepdims=True)).all(axis=(1, 2))
        parts.append((fitted.G, covariance(C, fitted.weights), fitted.determined & determined))
    G, cov, determined = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return G, cov, determined
