"""Rows of the Jacobian in machine code, for models with many states: blocks of samples.

``jacobian_kernel`` takes every column through every sample, nx² products each. Here a few samples
make a block, and what goes on inside it is found once for all columns: how the state after it and
its outputs respond to the state before it, Q, to a change of the state after sample b, P(b), and to
one of w at sample b, W(b). The rows then are products of large matrices::

    [S_after; dy] = Q S_before + Σ_b P(b) G(b) + W(b) dw(b)

with the direct terms G(b) of the state equation and dw(b) of w, see ``sensitivity``. The responses
are found backwards: P(b-1) = P(b) F(b), with H(b) below it for the output at b, ends in Q = P(-1),
and W(b) = P(b) Bw, with Dyw below it. A column of G(b) has one entry, so that it takes one column
of P(b). A sample takes about nx ny + nx²/B products a column, for a block of B samples.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from lfrtorch.engine.jacobian_kernel import between, copy_to, network_by_weight
from lfrtorch.engine.linear_recurrence import NOTHING

SAMPLES = 12
"""Samples in a block: 8 to 16 are as fast for 12 to 28 states; the responses then fit in cache."""


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def blocked_rows(
    job, A, Bw, Cz, Cy, Dyw, J, v, by_weight, slope, h, Ww, z, x_entries, z_entries, y_entries,
    first, chunks, S, rows,
):  # fmt: skip
    """What ``jacobian_rows`` writes, from the same arguments."""
    r, chunk = job // chunks, job % chunks
    T, ny, C = rows.shape[1], rows.shape[2], S.shape[2]
    c0, c1 = C * chunk // chunks, C * (chunk + 1) // chunks
    m = min(r, len(A) - 1)  # which model
    A, Bw, Cz, Cy, Dyw = A[m], Bw[m], Cz[m], Cy[m], Dyw[m]
    J, v, by_weight, rows, S = J[r], v[r], by_weight[r], rows[r, :, :, c0:c1], S[r, :, c0:c1]
    slope, h, z, Ww = slope[r], h[r], z[r], Ww[min(m, len(Ww) - 1)]
    (nx, nw), nn = Bw.shape, h.shape[1]
    n_weights = nn * (z.shape[1] + 1 + nw) + nw if nn > 0 else by_weight.shape[2]
    x_own, z_own, y_own = (
        between(x_entries, c0, c1), between(z_entries, c0, c1), between(y_entries, c0, c1)
    )  # fmt: skip
    # The columns are those of x, z, y, the static map and the initial state, in this order.
    s0 = min(max(first, c0), c1)
    s1 = max(min(first + n_weights, c1), s0)
    n_x, n_z, n_y, n_static = len(x_own), len(z_own), len(y_own), s1 - s0
    to_static = n_x + n_z + n_y
    to_initial = to_static + n_static
    n_initial = c1 - c0 - to_initial
    place, start = _by_state(x_own, nx)

    # The first rows of a response are those of the state after the block; the outputs follow, the
    # last one first, so that each step backwards adds rows at the end. All are transposed.
    wide = nx + SAMPLES * ny
    P = np.zeros((nx, SAMPLES, wide), rows.dtype)
    QW = np.zeros((nx + nw * SAMPLES, wide), rows.dtype)
    room = np.zeros((2 * nx + nw) * wide, rows.dtype)
    M = np.zeros((nx + nw, nx), rows.dtype)
    copy_to(Bw.T, M[nx:], 0)
    # Columns that w drives: S, and below it d_w. Columns of x, and of the initial state: S.
    Sw = np.zeros((nx + nw * SAMPLES, n_z + n_static), rows.dtype)
    Sx = np.zeros((nx, n_x + n_initial), rows.dtype)
    by_w, by_x = (
        np.zeros((wide, Sw.shape[1]), rows.dtype),
        np.zeros((wide, Sx.shape[1]), rows.dtype),
    )
    direct = np.zeros((n_x, SAMPLES), rows.dtype)
    of_direct = np.zeros((n_x, wide), rows.dtype)
    d_w = np.zeros((nw, n_weights), rows.dtype)
    for i in range(nx):
        _gather(S[i], Sx[i], 0, n_x, 0)
        _gather(S[i], Sx[i], to_initial, n_initial, n_x)
        _gather(S[i], Sw[i], n_x, n_z, 0)
        _gather(S[i], Sw[i], to_static, n_static, n_z)

    for t0 in range(0, T, SAMPLES):
        count = min(SAMPLES, T - t0)
        if count < SAMPLES:
            P[:], QW[:], Sw[nx:], direct[:] = 0.0, 0.0, 0.0, 0.0
        _responses(A, Bw, Cz, Cy, Dyw, J[t0 : t0 + count], M, room, P, QW)
        for b in range(count):
            k = t0 + b
            for q in range(nw):
                row = Sw[nx + q * SAMPLES + b]
                for n in range(n_z):
                    row[n] = J[k, q, z_own[n, 1]] * v[k, z_own[n, 2]]
                if nn > 0:
                    network_by_weight(Ww, slope, h, z, k, q, d_w[q], 0)
                    for n in range(n_static):
                        row[n_z + n] = d_w[q, s0 - first + n]
                else:
                    for n in range(n_static):
                        row[n_z + n] = by_weight[k, q, s0 - first + n]
            for n in range(n_x):
                direct[place[n], b] = v[k, x_own[n, 2]]
        np.dot(QW.T, Sw, by_w)
        np.dot(QW[:nx].T, Sx, by_x)
        for i in range(nx):
            if start[i] < start[i + 1]:
                own = slice(start[i], start[i + 1])
                np.dot(direct[own], P[i], of_direct[own])
        for t in range(nx + count * ny):
            for n in range(n_x):
                by_x[t, n] += of_direct[place[n], t]

        for b in range(count):
            for i in range(ny):
                t, out = nx + (count - 1 - b) * ny + i, rows[t0 + b, i]
                _gather(by_x[t], out, 0, n_x, 0)
                _gather(by_w[t], out, 0, n_z, n_x)
                for n in range(n_y):
                    out[n_x + n_z + n] = 0.0
                _gather(by_w[t], out, n_z, n_static, to_static)
                _gather(by_x[t], out, n_x, n_initial, to_initial)
            for n in range(n_y):
                rows[t0 + b, y_own[n, 1], y_own[n, 0]] = v[t0 + b, y_own[n, 2]]
        _without_dust(by_x, Sx, nx)
        _without_dust(by_w, Sw, nx)

    for i in range(nx):
        _gather(Sx[i], S[i], 0, n_x, 0)
        _gather(Sw[i], S[i], 0, n_z, n_x)
        _gather(Sw[i], S[i], n_z, n_static, to_static)
        _gather(Sx[i], S[i], n_x, n_initial, to_initial)


@njit(nogil=True, fastmath={"contract"})
def _responses(A, Bw, Cz, Cy, Dyw, J, M, room, P, QW):
    """Fill P (nx, b, row of a response) and QW, the rows of Q and then of W (nw, b), transposed.

    M has Bwᵀ below the place of Fᵀ. What a block leaves untouched stays zero.
    """
    (nx, nw), ny = Bw.shape, len(Cy)
    steps, width = P.shape[1], nx
    latest = room[: nx * nx].reshape(nx, nx)
    for i in range(nx):
        for j in range(nx):
            latest[i, j] = 0.0
        latest[i, i] = 1.0
    for b in range(len(J) - 1, -1, -1):
        for i in range(nx):
            for t in range(width):
                P[i, b, t] = latest[i, t]
            for j in range(nx):
                M[i, j] = A[j, i]
        add_feedback(Bw, J[b], Cz, M)
        found = room[nx * len(P[0, 0]) :][: (nx + nw) * width].reshape(nx + nw, width)
        np.dot(M, latest, found)
        latest = room[: nx * (width + ny)].reshape(nx, width + ny)
        for i in range(nx):
            for t in range(width):
                latest[i, t] = found[i, t]
            for o in range(ny):
                latest[i, width + o] = Cy[o, i]
        add_feedback(Dyw, J[b], Cz, latest[:, width:])
        for q in range(nw):
            response = QW[nx + q * steps + b]
            for t in range(width):
                response[t] = found[nx + q, t]
            for o in range(ny):
                response[width + o] = Dyw[o, q]
        width += ny
    for i in range(nx):
        for t in range(width):
            QW[i, t] = latest[i, t]


@njit(nogil=True, fastmath={"contract"})
def add_feedback(drive, J, Cz, out):
    """out += (drive J Cz)ᵀ."""
    nw, nz = J.shape
    column = np.empty(len(drive), out.dtype)
    for j in range(nz):
        for c in range(len(drive)):
            a = out.dtype.type(0)
            for q in range(nw):
                a += drive[c, q] * J[q, j]
            column[c] = a
        for i in range(Cz.shape[1]):
            for c in range(len(drive)):
                out[i, c] += Cz[j, i] * column[c]


@njit(nogil=True)
def _by_state(entries, nx):
    """Places of the columns sorted by the state that they drive, and where each state's begin."""
    start = np.zeros(nx + 1, np.int64)
    for n in range(len(entries)):
        start[entries[n, 1] + 1] += 1
    start = np.cumsum(start)
    place, next_one = np.empty(len(entries), np.int64), start.copy()
    for n in range(len(entries)):
        place[n] = next_one[entries[n, 1]]
        next_one[entries[n, 1]] += 1
    return place, start


@njit(nogil=True, inline="always")
def _gather(source, target, first, count, at):
    """target[at : at + count] = source[first : first + count]."""
    for n in range(count):
        target[at + n] = source[first + n]


@njit(nogil=True)
def _without_dust(source, target, n):
    """The first n rows, with zeros for what would fade to denormal numbers: these are slow."""
    for i in range(n):
        for c in range(source.shape[1]):
            a = source[i, c]
            target[i, c] = a if abs(a) > NOTHING else source.dtype.type(0)
