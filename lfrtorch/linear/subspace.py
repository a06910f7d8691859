"""Subspace estimates of A and C, from spectra or from signals: where a linear fit starts.

A least-squares fit of a state-space model has many minima, and needs a model to start from. A
subspace method gives one without iterations. It stacks outputs, at several times or multiplied by
several powers of z, into a large matrix and removes what follows directly from the inputs. The
rest is spanned by the extended observability matrix [C; C A; C A²; ...]: a singular value
decomposition finds it, its first rows are C, and A moves each block of rows to the next one. The
singular values that stand out of the noise are as many as the data carry states.

The result depends on the number of block rows, on the weighting and on the frequency axis. Several
choices cost little compared to a poor start, so all of them are returned, and the caller keeps the
one that simulates best.

References:
    McKelvey, Akçay and Ljung, "Subspace-based multivariable system identification from frequency
    response data", IEEE Trans. Automatic Control 41, 1996.
    Pintelon, "Frequency-domain subspace system identification using non-parametric noise models",
    Automatica 38, 2002.
    Verhaegen, "Identification of the deterministic part of MIMO state space models given in
    innovations form from input-output data", Automatica 30, 1994 (PO-MOESP).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Complex128, Float

from lfrtorch._support.types import Array, Complex

LARGEST_POLE = 1.0 - 1e-6
"""Limit for the radius of poles: the margin keeps a model stable when its coordinates change."""

MOVED_POLE = 0.999
"""Largest radius of an unstable pole after it is moved."""

_SPECTRAL_HORIZONS = (1, 2)
"""Block rows for spectra, in multiples of nx + 1. The smallest number that tells the states apart
is tried as well."""

HORIZONS = (2, 3, 5, 10)
"""Block rows for signals, in multiples of nx + 1."""

MOST_OPERATIONS = 1e10
"""Largest number of multiplications of a decomposition; larger horizons are skipped."""


class SubspaceEstimate(NamedTuple):
    """Subspace estimate of A and C."""

    A: Float[Array, "nx nx"]  # with unstable poles moved into the unit circle
    C: Float[Array, "ny nx"]
    singular_values: Float[Array, " n"]  # they drop after the order that the data carry
    unstable: Float[Array, "nx nx"] | None  # A before its poles were moved


def from_spectra(
    z: Complex128[Complex, " F"],
    U: Complex128[Complex, "F nu m"],
    Y: Complex128[Complex, "F ny m"],
    nx: int,
) -> list[SubspaceEstimate]:
    """Estimates from spectra Y = G(z) U of one or several experiments.

    The powers of z that tell the states apart are almost equal if the lines cover a small part of
    the unit circle. A bilinear map of the circle to itself spreads the lines: from a tenth of the
    frequency axis, a noise-free system of order 12 is found to 1e-14 with the map, to 1e-7 without.
    """
    # Several outputs tell states apart better than further powers of z: order 12 with 3 outputs is
    # found on a tenth of the axis to 1e-14 by 5 block rows, to 1e-6 by 13.
    fewest = -(-nx // Y.shape[1]) + 1
    # Few lines carry few block rows, which must still tell nx states apart.
    most = _most_rows(U, Y)
    wanted = (fewest, *(multiple * (nx + 1) for multiple in _SPECTRAL_HORIZONS))
    rows = [q for q in sorted({min(q, most) for q in wanted}) if q >= fewest]
    ny, nu, m = Y.shape[1], *U.shape[1:]
    limit = MOST_OPERATIONS / 5  # there are three frequency axes
    cheap = [q for q in rows if (q * (nu + ny)) ** 2 * 2 * len(U) * m <= limit]
    rows = cheap or rows[:1]
    found = (subspace.estimate(nx) for q in rows for subspace in _subspaces(z, U, Y, q))
    return [estimate for estimate in found if estimate is not None]


class SpectralSubspace(NamedTuple):
    """Directions that hold estimates of every order, from one decomposition."""

    directions: Array  # of the part of the outputs that inputs do not explain, the main one first
    singular_values: Array
    size: float  # norm of the outputs
    whiten: Array  # what the noise of the outputs was divided by
    warp: float  # a of the bilinear map of the frequency axis
    ny: int

    def estimate(self, nx: int) -> SubspaceEstimate | None:
        """Return the estimate of an order, if there are directions for it and an inverse map."""
        if nx > len(self.directions):
            return None
        observability = _main(self.directions, self.singular_values, nx)
        A_axis, C = _shift(self.whiten @ observability, self.ny)
        a, eye = self.warp, np.eye(nx)
        try:  # A = (A_axis + a I) (I + a A_axis)⁻¹ takes the bilinear map back
            A = np.linalg.solve((eye + a * A_axis).T, (A_axis + a * eye).T).T
        except np.linalg.LinAlgError:
            return None
        s = self.singular_values / self.size
        return _stable(np.asarray(A, dtype=np.float64), C, s)


def spectral_subspaces(
    z: Complex128[Complex, " F"],
    U: Complex128[Complex, "F nu m"],
    Y: Complex128[Complex, "F ny m"],
    most: int,
) -> list[SpectralSubspace]:
    """Subspaces for the orders up to ``most``, or what these lines carry; see ``from_spectra``."""
    rows = {min(multiple * (most + 1), _most_rows(U, Y)) for multiple in _SPECTRAL_HORIZONS}
    return [each for q in sorted(rows) if q > 1 for each in _subspaces(z, U, Y, q)]


def _most_rows(U: Complex, Y: Complex) -> int:
    """Block rows that these lines carry."""
    return 2 * len(U) * U.shape[2] // (U.shape[1] + Y.shape[1])


def _subspaces(z: Complex, U: Complex, Y: Complex, q: int) -> list[SpectralSubspace]:
    """Return subspaces of q block rows, on several frequency axes, with and without equal noise."""
    ny, half = Y.shape[1], np.angle(z) / 2
    power = (np.abs(Y) ** 2).sum(axis=(1, 2))
    centres = [np.median(half), np.average(half, weights=power if power.any() else None)]
    warps = [0.0, *(np.clip(np.tan(np.pi / 4 - c), -0.99, 0.99) for c in centres)]
    found = []
    for a in warps:
        axis = (z - a) / (1.0 - a * z)
        powers = axis ** np.arange(q)[:, None]
        stacked = [
            (powers[:, None, :, None] * S.swapaxes(0, 1)).reshape(q * S.shape[1], -1)
            for S in (U, Y)
        ]
        rows = np.vstack(stacked)
        # L = [L_uu 0; L_yu L_yy]: L_yy is the part of the outputs that is orthogonal to the
        # inputs, and spans the observability matrix.
        L = _lower(np.hstack([np.real(rows), np.imag(rows)]))
        first = q * U.shape[1]
        noise = np.real(powers @ powers.conj().T)  # covariance of white errors in Y
        noise += 1e-14 * np.trace(noise) * np.eye(q)
        for root in (np.eye(q), np.linalg.cholesky(noise)):
            # The inverse root gives all rows the same noise; it is undone on the subspace.
            whiten = np.asarray(np.kron(root, np.eye(ny)), dtype=np.float64)
            outputs = scipy.linalg.solve_triangular(whiten, L[first:], lower=True)
            directions, s, size = _directions(outputs, slice(first, None))
            found.append(SpectralSubspace(directions, s, size, whiten, float(a), ny))
    return found


def from_signals(
    us: Sequence[Float[Array, "_ nu"]], ys: Sequence[Float[Array, "_ ny"]], nx: int
) -> list[SubspaceEstimate]:
    """Estimates from the normalised signals (T, nu) and (T, ny) of records, by MOESP.

    Past inputs and outputs, or past inputs alone, are the instruments.
    """
    nu, ny = us[0].shape[1], ys[0].shape[1]
    estimates = []
    for multiple in HORIZONS:
        i = multiple * (nx + 1)
        pairs = [(u, y) for u, y in zip(us, ys, strict=True) if len(u) >= 2 * i]
        columns = sum(len(u) - 2 * i + 1 for u, _ in pairs)
        rows = 2 * i * (nu + ny)
        if columns < rows or (estimates and rows**2 * columns > MOST_OPERATIONS):
            break
        U = np.hstack([_hankel(u, 2 * i) for u, _ in pairs])
        Y = np.hstack([_hankel(y, 2 * i) for _, y in pairs])
        # Rows: future inputs, past inputs, past outputs, future outputs. The future inputs come
        # first, so that the columns of L after them hold what these do not explain.
        L = _lower(np.vstack([U[i * nu :], U[: i * nu], Y[: i * ny], Y[i * ny :]]))
        inputs, past_u, past = i * nu, 2 * i * nu, i * (2 * nu + ny)
        for instruments in (past, past_u):
            directions, s, size = _directions(L[past:], slice(inputs, instruments))
            A, C = _shift(_main(directions, s, nx), ny)
            estimates.append(_stable(A, C, s / size))
    return estimates


def shortest(nx: int, nu: int, ny: int) -> int:
    """Samples that one record must have for ``from_signals``."""
    return 2 * HORIZONS[0] * (nx + 1) * (nu + ny + 1)


def suffice(lengths: Sequence[int], nx: int, nu: int, ny: int) -> bool:
    """Tell if records of these lengths together are enough for ``from_signals``."""
    window = 2 * HORIZONS[0] * (nx + 1)
    return sum(max(0, T - window + 1) for T in lengths) > window * (nu + ny)


def _lower(rows: Array) -> Array:
    """Square lower triangular L of rows = L Q with orthogonal Q."""
    (R,) = scipy.linalg.qr(rows.T, mode="r", overwrite_a=True, check_finite=False)
    L = np.zeros((len(rows), len(rows)))
    L[:, : len(R[: len(rows)])] = R[: len(rows)].T
    return L


def _directions(outputs: Array, seen: slice) -> tuple[Array, Array, float]:
    """Main directions of the columns ``seen``, their singular values, and the outputs' size."""
    U, s, _ = np.linalg.svd(outputs[:, seen])
    return U, s, max(float(np.linalg.norm(outputs)), np.finfo(float).tiny)


def _main(directions: Array, s: Array, nx: int) -> Array:
    """Return the first nx directions, scaled."""
    return directions[:, :nx] * np.sqrt(np.pad(s, (0, max(0, nx - len(s))))[:nx])


def _shift(observability: Array, ny: int) -> tuple[Array, Array]:
    """Return A and C from the extended observability matrix [C; C A; C A²; ...]."""
    A = np.linalg.lstsq(observability[:-ny], observability[ny:], rcond=None)[0]
    return np.asarray(A, dtype=np.float64), observability[:ny]


def _stable(A: Array, C: Array, singular_values: Array) -> SubspaceEstimate:
    """Return the estimate with unstable poles reflected into the unit circle, to MOVED_POLE."""
    values, vectors = np.linalg.eig(A)
    radius = np.abs(values)
    unstable = radius > LARGEST_POLE
    if not unstable.any():
        return SubspaceEstimate(A, C, singular_values, None)
    factor = np.minimum(1.0 / np.maximum(radius, 1.0), MOVED_POLE)
    values = values * np.where(unstable, factor / np.maximum(radius, 1e-300), 1.0)
    moved = np.real(vectors * values @ np.linalg.pinv(vectors))
    return SubspaceEstimate(moved, C, singular_values, A)


def _hankel(signal: Array, rows: int) -> Array:
    """Block Hankel matrix (rows * n, T - rows + 1) of a signal (T, n)."""
    windows = np.lib.stride_tricks.sliding_window_view(signal, rows, axis=0)  # (columns, n, rows)
    return windows.transpose(2, 1, 0).reshape(-1, windows.shape[0])
