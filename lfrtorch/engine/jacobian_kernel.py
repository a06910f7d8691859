"""Rows of the Jacobian in machine code.

The sensitivities S(k+1) = F(k) S(k) + G(k) are computed sample by sample. The rows
dy(k)/dθ = H(k) S(k) + E(k) are written on the way, and no S is stored over time. Each job has one
record and some of the columns. ``sensitivity`` explains the equations, and has the same computation
in torch.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from lfrtorch.engine.linear_recurrence import flush
from lfrtorch.engine.simulation_kernel import matrices
from lfrtorch.maps.machine_code import call_slope, prepared

_TILE = 4
"""The number of terms of a sum is filled up with zeros to a multiple of this number."""


@njit(cache=True, nogil=True, error_model="numpy")
def jacobian_rows(
    first, jobs, step, sizes, weights, code, u, x, z, w, r0, t0,
    x_entries, z_entries, y_entries, static, chunks, S, rows,
):  # fmt: skip
    """Call ``record_rows`` for every job first, first + step, ... below ``jobs``.

    Job r * chunks + c is chunk c of the columns of record r0 + r.

    Shape:
        S: (R, nx, C), rows: (R, B, ny, at least C).
    """
    for job in range(first, jobs, step):
        r, chunk, C = job // chunks, job % chunks, S.shape[2]
        record_rows(
            sizes, weights, code, u[r0 + r], x[r0 + r], z[r0 + r], w[r0 + r], t0,
            x_entries, z_entries, y_entries, static, C * chunk // chunks,
            C * (chunk + 1) // chunks, S[r], rows[r],
        )  # fmt: skip


@njit(nogil=True, error_model="numpy", fastmath={"contract"})
def record_rows(
    sizes, weights, code, u, x, z, w, t0,
    x_entries, z_entries, y_entries, static, c0, c1, S, rows,
):  # fmt: skip
    """Write columns c0 to c1 of a record's rows from sample t0, and advance S to the block's end.

    Entries are those of ``sensitivity.DirectTerms``.

    Shape:
        S: (nx, C), rows: (B, ny, at least C).
    """
    A, _, Bw, Cz, _, Cy, _, Dyw, phi = matrices(sizes, weights)
    B, ny = rows.shape[0], rows.shape[1]
    (nx, nw), nz, nu, P = Bw.shape, len(Cz), u.shape[1], len(phi)
    slope, ints, constants, room = code[2], code[3], code[4], prepared(code, phi)
    x_own, z_own, y_own = (
        _between(x_entries, c0, c1), _between(z_entries, c0, c1), _between(y_entries, c0, c1)
    )  # fmt: skip
    # Columns of the static map follow those of the matrices.
    first = len(x_entries) + len(z_entries) + len(y_entries)
    s0 = min(max(first, c0), c1)
    s1 = max(min(first + len(static), c1), s0)
    whole = s1 - s0 == P > 0  # this job has all weights of the map, in their order
    # [S(k+1); dy(k)] = M(k) X(k) with X = [S; direct terms of w] and M = [F Bw; H Dyw], padded with
    # zeros to an even number of rows and a multiple of ``_TILE`` columns. Arrays are reused in
    # place, as passing them on takes as long as a product.
    width, tall, depth = _padded(c1 - c0, 8), _padded(nx + ny, 2), _padded(nx + nw, _TILE)
    M, X, Y = np.zeros((tall, depth)), np.zeros((depth, width)), np.empty((tall, width))
    J, by_weight, v = np.zeros((nw, nz)), np.zeros((nw, P)), np.empty(nx + nu + nw)
    in_place = X.reshape(depth * width)[nx * width + s0 - c0 :]
    for i in range(nx):
        for q in range(nw):
            M[i, nx + q] = Bw[i, q]
        for c in range(c1 - c0):
            X[i, c] = S[i, c0 + c]
    for i in range(ny):
        for q in range(nw):
            M[nx + i, nx + q] = Dyw[i, q]
    for k in range(B):
        t = t0 + k
        signals(x, u, w, t, v)
        if whole:
            call_slope(slope, ints, constants, phi, z[t], J, in_place, width, room)
        elif nw:
            call_slope(slope, ints, constants, phi, z[t], J, by_weight, P * (s1 > s0), room)
            for q in range(nw):
                for c in range(s0, s1):
                    X[nx + q, c - c0] = by_weight[q, static[c - first]]
        for n in range(len(z_own)):
            for q in range(nw):
                X[nx + q, z_own[n, 0]] = J[q, z_own[n, 1]] * v[z_own[n, 2]]
        _add_slope(A, J, Cz, 0, M)
        _add_slope(Cy, J, Cz, nx, M)
        _product(M, X, Y)
        # Scalars are stored well before vector instructions load them, which would wait otherwise.
        for i in range(nx):
            for c in range(width):
                X[i, c] = Y[i, c]
        for n in range(len(x_own)):
            X[x_own[n, 1], x_own[n, 0]] += v[x_own[n, 2]]
        for i in range(ny):
            for c in range(c1 - c0):
                rows[k, i, c0 + c] = Y[nx + i, c]
        for n in range(len(y_own)):
            rows[k, y_own[n, 1], c0 + y_own[n, 0]] += v[y_own[n, 2]]
        if k % 256 == 0:
            flush(X[:nx])
    for i in range(nx):
        for c in range(c1 - c0):
            S[i, c0 + c] = X[i, c]


@njit(nogil=True, inline="always")
def _padded(count, to):
    return to * (-(-count // to))


@njit(nogil=True, inline="always")
def signals(x, u, w, t, v):
    """Write v = [x; u; w] at sample t."""
    nx, nu = x.shape[1], u.shape[1]
    for i in range(nx):
        v[i] = x[t, i]
    for i in range(nu):
        v[nx + i] = u[t, i]
    for i in range(w.shape[1]):
        v[nx + nu + i] = w[t, i]


# Loops are used instead of slices and masks, which numba takes seconds to compile.
@njit(nogil=True)
def copy_to(source, target, column):
    """Copy source to target[:, column:]."""
    for i in range(source.shape[0]):
        for j in range(source.shape[1]):
            target[i, column + j] = source[i, j]


@njit(nogil=True, inline="always")
def _add_slope(constant, J, Cz, first, M):
    """M[first:, :nx] = constant + M[first:, nx:] J Cz."""
    n, nx = constant.shape
    for i in range(n):
        for c in range(nx):
            M[first + i, c] = constant[i, c]
        for j in range(len(Cz)):
            a = 0.0
            for q in range(J.shape[0]):
                a += M[first + i, nx + q] * J[q, j]
            for c in range(nx):
                M[first + i, c] += a * Cz[j, c]


@njit(nogil=True)
def _between(entries, c0, c1):
    """Entries whose columns lie between c0 and c1, counted from c0."""
    own, count = np.empty_like(entries), 0
    for n in range(len(entries)):
        if c0 <= entries[n, 0] < c1:
            own[count, 0] = entries[n, 0] - c0
            own[count, 1], own[count, 2] = entries[n, 1], entries[n, 2]
            count += 1
    return own[:count]


@njit(nogil=True, error_model="numpy", fastmath={"contract"})
def _product(M, X, out):
    """Out = M X, two rows and four products at a time, so that factors stay in registers."""
    for i in range(0, M.shape[0], 2):
        for j in range(0, M.shape[1], 4):
            a0, a1, a2, a3 = M[i, j], M[i, j + 1], M[i, j + 2], M[i, j + 3]
            b0, b1, b2, b3 = M[i + 1, j], M[i + 1, j + 1], M[i + 1, j + 2], M[i + 1, j + 3]
            if j == 0:
                for t in range(X.shape[1]):
                    p, q, r, s = X[0, t], X[1, t], X[2, t], X[3, t]
                    out[i, t] = a0 * p + a1 * q + a2 * r + a3 * s
                    out[i + 1, t] = b0 * p + b1 * q + b2 * r + b3 * s
            else:
                for t in range(X.shape[1]):
                    p, q, r, s = X[j, t], X[j + 1, t], X[j + 2, t], X[j + 3, t]
                    out[i, t] += a0 * p + a1 * q + a2 * r + a3 * s
                    out[i + 1, t] += b0 * p + b1 * q + b2 * r + b3 * s
