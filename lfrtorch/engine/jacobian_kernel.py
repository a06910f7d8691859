"""Rows of the Jacobian in machine code.

The sensitivities S(k+1) = F(k) S(k) + G(k) go from sample to sample, and the rows
dy(k)/dθ = H(k) S(k) + E(k) are written on the way; no S is stored over time. Each job has one
record and some of the columns.
``sensitivity`` has the equations, and the same computation in torch.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from lfrtorch.engine.linear_recurrence import flush

_TILE = 4
"""Rows and columns of the tiles in which matrices are multiplied."""


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def jacobian_rows(
    job, A, Bw, Cz, Cy, Dyw, J, v, by_weight, slope, h, Ww, z, x_entries, z_entries, y_entries,
    first, chunks, S, rows,
):  # fmt: skip
    """Write the rows of one record and one chunk of the columns; S goes on to the block's end.

    Job r * chunks + c is chunk c of the columns of record r. The derivatives of the static map are
    ``by_weight``, or come from slope, h, Ww and z of a network; the others are empty. Entries are
    those of ``sensitivity.DirectTerms``.

    Shape:
        S: (R, nx, C), J: (R, B, nw, nz), v: (R, B, nx + nu + nw), by_weight: (R, B, nw, columns),
        slope, h: (R, B, nn), z: (R, B, nz), rows: (R, B, ny, at least C).
    """
    r, chunk = job // chunks, job % chunks
    B, ny, C = rows.shape[1], rows.shape[2], S.shape[2]
    c0, c1 = C * chunk // chunks, C * (chunk + 1) // chunks
    J, v, by_weight, rows, S = J[r], v[r], by_weight[r], rows[r], S[r]
    slope, h, z = slope[r], h[r], z[r]
    (nx, nw), nn, nz = Bw.shape, h.shape[1], z.shape[1]
    network = nn > 0
    n_weights = nn * (nz + 1 + nw) + nw if network else by_weight.shape[2]
    x_own, z_own, y_own = (
        _between(x_entries, c0, c1), _between(z_entries, c0, c1), _between(y_entries, c0, c1)
    )  # fmt: skip
    s0 = min(max(first, c0), c1)
    s1 = max(min(first + n_weights, c1), s0)
    whole = network and s1 - s0 == n_weights  # all weights of the network are this job's
    d_w = np.zeros((nw, n_weights), rows.dtype)
    # S(k+1) = M(k) X(k) and dy(k) = N(k) X(k) with X = [S; direct terms of w], M = [F Bw] and
    # N = [H Dyw], padded with zeros to whole tiles.
    tall, depth = _TILE * (-(-nx // _TILE)), _TILE * (-(-(nx + nw) // _TILE))
    M, N = np.zeros((tall, depth), rows.dtype), np.zeros((ny, depth), rows.dtype)
    X, X_next = np.zeros((depth, c1 - c0), rows.dtype), np.zeros((depth, c1 - c0), rows.dtype)
    copy_to(Bw, M, nx)
    copy_to(Dyw, N, nx)
    for i in range(nx):
        for c in range(c1 - c0):
            X[i, c] = S[i, c0 + c]
    for k in range(B):
        _add_slope(A, M, J, k, Cz)
        _add_slope(Cy, N, J, k, Cz)
        for q in range(nw):
            for n in range(len(z_own)):
                X[nx + q, z_own[n, 0]] = J[k, q, z_own[n, 1]] * v[k, z_own[n, 2]]
            if whole:
                network_by_weight(Ww, slope, h, z, k, q, X[nx + q], first - c0)
            elif network:
                network_by_weight(Ww, slope, h, z, k, q, d_w[q], 0)
                for c in range(s0, s1):
                    X[nx + q, c - c0] = d_w[q, c - first]
            else:
                for c in range(s0, s1):
                    X[nx + q, c - c0] = by_weight[k, q, c - first]
        _state_rows(M, X, X_next)
        _output_rows(N, X, rows, k, c0)
        for n in range(len(x_own)):
            X_next[x_own[n, 1], x_own[n, 0]] += v[k, x_own[n, 2]]
        for n in range(len(y_own)):
            rows[k, y_own[n, 1], c0 + y_own[n, 0]] += v[k, y_own[n, 2]]
        X, X_next = X_next, X
        if k % 256 == 0:
            flush(X[:nx])
    for i in range(nx):
        for c in range(c1 - c0):
            S[i, c0 + c] = X[i, c]


# Loops for assignments of slices and masks: the latter take numba seconds to compile.
@njit(nogil=True)
def copy_to(source, target, column):
    """target[:, column:] = source."""
    for i in range(source.shape[0]):
        for j in range(source.shape[1]):
            target[i, column + j] = source[i, j]


@njit(nogil=True, inline="always")
def network_by_weight(Ww, slope, h, z, k, q, d_w, first):
    """Row q of what ``NetworkJacobian.by_weight`` computes, at sample k, from a column on."""
    nn, nz = h.shape[1], z.shape[1]
    bz = first + nn * nz
    for n in range(nn):
        a = Ww[q, n] * slope[k, n]
        for j in range(nz):
            d_w[first + n * nz + j] = a * z[k, j]
        d_w[bz + n] = a
        d_w[bz + nn * (1 + q) + n] = h[k, n]
    d_w[bz + nn * (1 + len(Ww)) + q] = 1.0


@njit(nogil=True, inline="always")
def _add_slope(constant, M, J, k, Cz):
    """M[:, :nx] = constant + M[:, nx:] J(k) Cz."""
    n, nx = constant.shape
    for i in range(n):
        for c in range(nx):
            M[i, c] = constant[i, c]
        for j in range(len(Cz)):
            a = M.dtype.type(0)
            for q in range(J.shape[1]):
                a += M[i, nx + q] * J[k, q, j]
            for c in range(nx):
                M[i, c] += a * Cz[j, c]


@njit(nogil=True)
def _between(entries, c0, c1):
    """The entries whose column lies between c0 and c1, counted from c0."""
    own, count = np.empty_like(entries), 0
    for n in range(len(entries)):
        if c0 <= entries[n, 0] < c1:
            own[count, 0] = entries[n, 0] - c0
            own[count, 1], own[count, 2] = entries[n, 1], entries[n, 2]
            count += 1
    return own[:count]


@njit(nogil=True, fastmath={"contract"})
def _state_rows(M, X, out):
    """out[:len(M)] = M @ X, tile by tile: 16 coefficients stay in registers."""
    for i in range(0, len(M), 4):
        ya, yb, yc, yd = out[i], out[i + 1], out[i + 2], out[i + 3]
        for j in range(0, M.shape[1], 4):
            a0, a1, a2, a3 = M[i, j], M[i, j + 1], M[i, j + 2], M[i, j + 3]
            b0, b1, b2, b3 = M[i + 1, j], M[i + 1, j + 1], M[i + 1, j + 2], M[i + 1, j + 3]
            c0, c1, c2, c3 = M[i + 2, j], M[i + 2, j + 1], M[i + 2, j + 2], M[i + 2, j + 3]
            d0, d1, d2, d3 = M[i + 3, j], M[i + 3, j + 1], M[i + 3, j + 2], M[i + 3, j + 3]
            x0, x1, x2, x3 = X[j], X[j + 1], X[j + 2], X[j + 3]
            if j == 0:
                for t in range(X.shape[1]):
                    p, q, r, s = x0[t], x1[t], x2[t], x3[t]
                    ya[t] = a0 * p + a1 * q + a2 * r + a3 * s
                    yb[t] = b0 * p + b1 * q + b2 * r + b3 * s
                    yc[t] = c0 * p + c1 * q + c2 * r + c3 * s
                    yd[t] = d0 * p + d1 * q + d2 * r + d3 * s
            else:
                for t in range(X.shape[1]):
                    p, q, r, s = x0[t], x1[t], x2[t], x3[t]
                    ya[t] += a0 * p + a1 * q + a2 * r + a3 * s
                    yb[t] += b0 * p + b1 * q + b2 * r + b3 * s
                    yc[t] += c0 * p + c1 * q + c2 * r + c3 * s
                    yd[t] += d0 * p + d1 * q + d2 * r + d3 * s


@njit(nogil=True, fastmath={"contract"})
def _output_rows(N, X, rows, k, first):
    """rows[k, :, first:] = N @ X."""
    for i in range(len(N)):
        out = rows[k, i]
        for j in range(0, N.shape[1], 4):
            a0, a1, a2, a3 = N[i, j], N[i, j + 1], N[i, j + 2], N[i, j + 3]
            x0, x1, x2, x3 = X[j], X[j + 1], X[j + 2], X[j + 3]
            if j == 0:
                for t in range(X.shape[1]):
                    out[first + t] = a0 * x0[t] + a1 * x1[t] + a2 * x2[t] + a3 * x3[t]
            else:
                for t in range(X.shape[1]):
                    out[first + t] += a0 * x0[t] + a1 * x1[t] + a2 * x2[t] + a3 * x3[t]
