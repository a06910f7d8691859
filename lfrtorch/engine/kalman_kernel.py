"""The extended Kalman filter in machine code, on square roots of covariances.

The states have the error covariance P = U Uᵀ. The noise of a sample, on the outputs and then on
the states, has the covariance G Gᵀ = [R Sᵀ; S Q]. Let H = ∂y/∂x at the predicted state. The
innovation e, the states x and their noise w together have the root M::

        [ e ]   [ Gy  H U ]                   [ Λ½         ]
        [ x ] : [ 0   U   ]  reflected to M = [ Lx  rest   ]
        [ w ]   [ Gw  0   ]                   [ Lw  of M   ]

Reflections of the columns (QR) make the first rows lower triangular. The state estimate given the
output is then x + Lx Λ^-½ e, the noise estimate is Lw Λ^-½ e, and the rest of M is the root of
their joint error covariance: no covariance is ever a difference of two. Let F = ∂x+/∂x at that
state: the root of the next covariance is [F I] times the rest. A missing output has no row in M.

References:
    Kailath, Sayed and Hassibi, "Linear Estimation", 2000, chapter 12 (array algorithms).
    Anderson and Moore, "Optimal Filtering", 1979, section 8.2 (extended Kalman filter).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from lfrtorch.engine.simulation_kernel import affine, matrices
from lfrtorch.engine.small_matrices import reflect
from lfrtorch.maps.machine_code import call_slope, call_value, prepared


@njit(cache=True, nogil=True, error_model="numpy")
def filter_record(u, y, sizes, weights, code, G, x, U):
    """Filter all samples: advance x and U to the end, and return log p(y); NaN marks missing y.

    Shape:
        u: (T, nu), y: (T, ny), G: (ny + nx, ny + nx), x: (nx,), U: (nx, nx).
    """
    w_hat, total = np.empty(len(x)), 0.0
    for k in range(len(u)):
        M, known, log_p = correct_sample(u[k], y[k], sizes, weights, code, G, x, U, w_hat)
        advance_sample(u[k], sizes, weights, code, M, known, w_hat, x, U)
        total += log_p
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def correct_sample(u, y, sizes, weights, code, G, x, U, w_hat):
    """Call ``correct`` with the input (nu,) and the outputs (ny,) of a sample."""
    _, _, Bw, Cz, Dzu, Cy, Dyu, Dyw, phi = matrices(sizes, weights)
    (nx, nw), ny = Bw.shape, len(Cy)
    e, H, by_x = np.empty(ny), np.empty((ny, nx)), np.empty((nw, nx))
    w, J = _static(Cz, x, Dzu, u, nw, phi, code)
    affine(Cy, x, Dyu, u, e)
    for i in range(ny):
        e[i] = y[i] - e[i]
        for q in range(nw):
            e[i] -= Dyw[i, q] * w[q]
    _slope(Cy, Dyw, J, Cz, by_x, H)
    return correct(e, H, G, x, U, w_hat)


@njit(cache=True, nogil=True, error_model="numpy")
def advance_sample(u, sizes, weights, code, M, known, w_hat, x, U):
    """Advance x and U to the next sample, from the result of ``correct_sample``."""
    A, Bu, Bw, Cz, Dzu, _, _, _, phi = matrices(sizes, weights)
    nx, nw = Bw.shape
    x_next, F, by_x = np.empty(nx), np.empty((nx, nx)), np.empty((nw, nx))
    w, J = _static(Cz, x, Dzu, u, nw, phi, code)
    affine(A, x, Bu, u, x_next)
    for i in range(nx):
        x_next[i] += w_hat[i]
        for q in range(nw):
            x_next[i] += Bw[i, q] * w[q]
    _slope(A, Bw, J, Cz, by_x, F)
    propagate(F, M, known, U)
    for i in range(nx):
        x[i] = x_next[i]


@njit(cache=True, nogil=True, error_model="numpy")
def correct(e, H, G, x, U, w_hat):
    """Update x by the output; write the expected noise of the states into w_hat.

    Returns the reflected M, the number of known outputs and log p(e). NaN in e is a missing output.

    Shape:
        e: (ny,), H: (ny, nx), G: (ny + nx, ny + nx), x, w_hat: (nx,), U: (nx, nx).
    """
    ny, nx = H.shape
    total, known = ny + nx, 0
    for i in range(ny):
        known += e[i] == e[i]
    M, found = np.zeros((known + 2 * nx, total + nx)), np.empty(known)
    row = 0
    for i in range(ny):
        if e[i] == e[i]:
            found[row] = e[i]
            for j in range(total):
                M[row, j] = G[i, j]
            for n in range(nx):
                for j in range(nx):
                    M[row, total + j] += H[i, n] * U[n, j]
            row += 1
    for i in range(nx):
        for j in range(nx):
            M[known + i, total + j] = U[i, j]
        for j in range(total):
            M[known + nx + i, j] = G[ny + i, j]
        w_hat[i] = 0.0
    reflect(M, known)
    log_p = 0.0
    for a in range(known):
        for b in range(a):
            found[a] -= M[a, b] * found[b]
        found[a] /= M[a, a]
        log_p -= 0.5 * (found[a] * found[a] + math.log(2.0 * math.pi * M[a, a] * M[a, a]))
        for i in range(nx):
            x[i] += M[known + i, a] * found[a]
            w_hat[i] += M[known + nx + i, a] * found[a]
    return M, known, log_p


@njit(cache=True, nogil=True, error_model="numpy")
def propagate(F, M, known, U):
    """Overwrite U by the root at the next sample, from the M and the count of ``correct``."""
    nx, first = len(U), known + len(U)
    N = M[first:, known:].copy()
    for i in range(nx):
        for n in range(nx):
            for j in range(N.shape[1]):
                N[i, j] += F[i, n] * M[known + n, known + j]
    reflect(N, nx)
    for i in range(nx):
        for j in range(nx):
            U[i, j] = N[i, j]


@njit(nogil=True, error_model="numpy")
def _static(Cz, x, Dzu, u, nw, phi, code):
    """The output w = f(z) of the static map and J = ∂w/∂z."""
    z, w, J, room = np.empty(len(Cz)), np.empty(nw), np.empty((nw, len(Cz))), prepared(code, phi)
    affine(Cz, x, Dzu, u, z)
    if nw:
        call_value(code[1], code[3], code[4], phi, z, w, room)
        call_slope(code[2], code[3], code[4], phi, z, J, np.empty(0), 0, room)
    return w, J


@njit(nogil=True, error_model="numpy")
def _slope(constant, B, J, Cz, by_x, out):
    """Out = constant + B J Cz; by_x is scratch space for J Cz."""
    for q in range(len(by_x)):
        for n in range(Cz.shape[1]):
            by_x[q, n] = 0.0
            for j in range(len(Cz)):
                by_x[q, n] += J[q, j] * Cz[j, n]
    for i in range(len(out)):
        for n in range(Cz.shape[1]):
            out[i, n] = constant[i, n]
            for q in range(len(by_x)):
                out[i, n] += B[i, q] * by_x[q, n]
