"""Rows of the Jacobian in machine code, for models with many states: blocks of samples.

``jacobian_kernel`` propagates every column through every sample, with nx² products each. Here a few
samples form a block, and the responses within a block are computed once for all columns. They are
the responses of the state after the block, and of the outputs in it, to three causes: the state
before the block, Q; a change of the state after sample b, P(b); and a change of w at sample b,
W(b). The rows are then products of large matrices::

    [S_after; dy] = Q S_before + Σ_b P(b) G(b) + W(b) dw(b)

with the direct terms G(b) of the state equation and dw(b) of w, see ``sensitivity``. The responses
are computed backwards: P(b-1) = P(b) F(b), with H(b) below it for the output at b, down to
Q = P(-1); and W(b) = P(b) Bw, with Dyw below it. A column of G(b) has one nonzero entry, so it
needs one column of P(b). For blocks of B samples, each sample takes about nx ny + nx²/B products a
column.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from lfrtorch.engine.jacobian_kernel import copy_to, signals
from lfrtorch.engine.linear_recurrence import NOTHING
from lfrtorch.engine.simulation_kernel import matrices
from lfrtorch.maps.machine_code import call_slope, prepared

SAMPLES = 12
"""Number of samples in a block. For 12 to 28 states, 8 to 16 samples are equally fast; the
responses then fit in cache."""

_WIDER = 2
"""Number of samples after which the growing responses are copied to a wider array."""

_TOGETHER = 32
"""Smallest number of columns of a product, except for the last product."""


@njit(cache=True, nogil=True, error_model="numpy")
def blocked_rows(
    first, jobs, step, sizes, weights, code, u, x, z, w, r0, t0,
    x_entries, z_entries, y_entries, static, chunks, S, rows,
):  # fmt: skip
    """Call ``_rows`` for every job first, first + step, ... below ``jobs``."""
    for job in range(first, jobs, step):
        _rows(
            job, sizes, weights, code, u, x, z, w, r0, t0, x_entries, z_entries, y_entries, static,
            chunks, S, rows,
        )  # fmt: skip


@njit(nogil=True, error_model="numpy", fastmath={"contract"})
def _rows(
    job, sizes, weights, code, u, x, z, w, r0, t_first,
    x_entries, z_entries, y_entries, static, chunks, S, rows,
):  # fmt: skip
    """Write the rows that ``jacobian_rows`` writes, from the same arguments.

    Rounding in BLAS depends on the sizes of a product, so these sizes are the same for any number
    of jobs.
    """
    A, _, Bw, Cz, _, Cy, _, Dyw, phi = matrices(sizes, weights)
    r, chunk = job // chunks, job % chunks
    u, x, z, w, rows, S = u[r0 + r], x[r0 + r], z[r0 + r], w[r0 + r], rows[r], S[r]
    slope, ints, constants, work = code[2], code[3], code[4], prepared(code, phi)
    (nx, nw), nz, (T, ny) = Bw.shape, len(Cz), rows.shape[:2]
    n_x, n_z, n_y, C = len(x_entries), len(z_entries), len(y_entries), S.shape[1]
    # The columns are those of x, z, y, the static map and the initial state, in this order.
    column, start, edges = _sorted(x_entries, n_z, n_y, C, nx)
    k0 = np.searchsorted(edges[1:] * chunks, chunk * len(column), "right")
    k1 = np.searchsorted(edges[1:] * chunks, (chunk + 1) * len(column), "right")
    c0, c1 = edges[k0], edges[k1]
    # The columns of this job, the number of columns of x among them, and the first other column.
    own, n_own, w0 = column[c0:c1], max(0, min(c1, n_x) - c0), max(0, c0 - n_x)

    # A response begins with the rows of the state after the block. The outputs follow, the last
    # output first, so that each step backwards adds rows at the end. All arrays are transposed.
    wide = nx + SAMPLES * ny
    P = np.zeros((nx, SAMPLES, wide), rows.dtype)
    QW = np.zeros((nx + nw * SAMPLES, wide), rows.dtype)
    room = np.empty((nx + nw) * wide, rows.dtype), np.empty((nx + nw) * wide, rows.dtype)
    M = np.zeros((nx + nw, nx), rows.dtype)
    copy_to(Bw.T, M[nx:], 0)
    AT, CyT, DywT = A.T.copy(), Cy.T.copy(), Dyw.T.copy()
    # Also transposed: columns of x have S and direct terms; other columns have S, with d_w beside.
    Sx, direct = np.zeros((n_own, nx), rows.dtype), np.zeros((n_own, SAMPLES), rows.dtype)
    Sw = np.zeros((len(own) - n_own, len(QW)), rows.dtype)
    by, of_direct = np.empty((len(own), wide), rows.dtype), np.empty((n_own, wide), rows.dtype)
    d_w = np.zeros((nw, len(column) - n_x))
    J, by_weight = np.zeros((SAMPLES, nw, nz)), np.zeros((nw, len(phi)))
    stride = len(phi) if len(static) else 0
    v = np.empty((SAMPLES, nx + u.shape[1] + nw))
    for i in range(nx):
        for n in range(n_own):
            Sx[n, i] = S[i, own[n]]
        for n in range(len(Sw)):
            Sw[n, i] = S[i, own[n_own + n]]

    for t0 in range(0, T, SAMPLES):
        count = min(SAMPLES, T - t0)
        if count < SAMPLES:
            P[:], QW[:] = 0.0, 0.0
        for b in range(count):
            t = t_first + t0 + b
            signals(x, u, w, t, v[b])
            if nw:
                call_slope(slope, ints, constants, phi, z[t], J[b], by_weight, stride, work)
            for q in range(nw if len(Sw) > 0 else 0):
                row = d_w[q]
                for n in range(n_z):
                    row[n] = J[b, q, z_entries[n, 1]] * v[b, z_entries[n, 2]]
                for n in range(len(static)):
                    row[n_z + n] = by_weight[q, static[n]]
                for n in range(len(Sw)):
                    Sw[n, nx + q * SAMPLES + b] = row[w0 + n]
            for n in range(n_own):
                direct[n, b] = v[b, x_entries[own[n], 2]]
        _responses(AT, Cz, CyT, DywT, J[:count], M, room, P, QW)
        for k in range(k0, k1):
            n0, n1 = edges[k] - c0, edges[k + 1] - c0
            if n1 <= n_own:
                np.dot(Sx[n0:n1], QW[:nx], by[n0:n1])
            else:
                np.dot(Sw[n0 - n_own : n1 - n_own], QW, by[n0:n1])
        for i in range(nx):
            n0, n1 = start[i] - c0, start[i + 1] - c0
            if 0 <= n0 < n1 <= n_own:
                np.dot(direct[n0:n1], P[i], of_direct[n0:n1])
        for n in range(n_own):
            for t in range(wide):
                by[n, t] += of_direct[n, t]

        for b in range(count):
            for i in range(ny):
                t, out = nx + (count - 1 - b) * ny + i, rows[t0 + b, i]
                for n in range(len(own)):
                    out[own[n]] = by[n, t]
        if chunk == 0:
            rows[t0 : t0 + count, :, n_x + n_z : n_x + n_z + n_y] = 0.0
            for b in range(count):
                for n in range(n_y):
                    rows[t0 + b, y_entries[n, 1], y_entries[n, 0]] = v[b, y_entries[n, 2]]
        _without_dust(by[:n_own], Sx, nx)
        _without_dust(by[n_own:], Sw, nx)

    for i in range(nx):
        for n in range(n_own):
            S[i, own[n]] = Sx[n, i]
        for n in range(len(Sw)):
            S[i, own[n_own + n]] = Sw[n, i]


@njit(nogil=True, fastmath={"contract"})
def _responses(AT, Cz, CyT, DywT, J, M, room, P, QW):
    """Fill P (nx, b, row of a response) and QW, the rows of Q and then of W (nw, b), transposed.

    M has Bwᵀ below the place of Fᵀ. Entries that a block does not write stay zero.
    """
    (nx, ny), nw = CyT.shape, len(DywT)
    width, steps = nx, P.shape[1]
    latest, (now, after) = np.eye(nx, dtype=P.dtype), room
    for done in range(len(J)):
        b, at = len(J) - 1 - done, nx + done * ny
        if done % _WIDER == 0:
            wider = now[: (nx + nw) * (width + _WIDER * ny)].reshape(nx + nw, width + _WIDER * ny)
            wider[:] = 0.0
            copy_to(latest[:nx], wider, 0)
            latest, now, after = wider, after, now
            width += _WIDER * ny
        for i in range(nx):
            for t in range(width):
                P[i, b, t] = latest[i, t]
            for j in range(nx):
                M[i, j] = AT[i, j]
        add_feedback(M[nx:], J[b], Cz, M)
        found = now[: (nx + nw) * width].reshape(nx + nw, width)
        np.dot(M, latest[:nx], found)
        for o in range(ny):
            for i in range(nx):
                found[i, at + o] = CyT[i, o]
            for q in range(nw):
                found[nx + q, at + o] = DywT[q, o]
        add_feedback(DywT, J[b], Cz, found[:, at:])
        for q in range(nw):
            for t in range(width):
                QW[nx + q * steps + b, t] = found[nx + q, t]
        latest, now, after = found, after, now
    copy_to(latest[:nx], QW, 0)


@njit(nogil=True, fastmath={"contract"})
def add_feedback(driveT, J, Cz, out):
    """Add (drive J Cz)ᵀ to out."""
    for i in range(Cz.shape[1]):
        for q in range(len(driveT)):
            a = out.dtype.type(0)
            for j in range(len(Cz)):
                a += J[q, j] * Cz[j, i]
            for c in range(driveT.shape[1]):
                out[i, c] += driveT[q, c] * a


@njit(nogil=True)
def _sorted(x_entries, n_z, n_y, C, nx):
    """All columns except those of y, which do not change S, and the beginnings of their products.

    Columns of x come first, sorted by the state that they drive; the first column of each state is
    also returned. A product has all columns of a state, as these share its P.
    """
    n_x, start = len(x_entries), np.zeros(nx + 1, np.int64)
    for n in range(n_x):
        start[x_entries[n, 1] + 1] += 1
    start = np.cumsum(start)
    column, at = np.arange(C - n_y), start.copy()
    column[n_x + n_z :] += n_y
    for n in range(n_x):
        column[at[x_entries[n, 1]]] = n
        at[x_entries[n, 1]] += 1
    edges = [0]
    for i in range(1, nx + 1):
        if start[i] - edges[-1] >= _TOGETHER or (i == nx and n_x > edges[-1]):
            edges.append(start[i])
    while edges[-1] < len(column):
        edges.append(min(edges[-1] + _TOGETHER, len(column)))
    return column, start, np.array(edges)


@njit(nogil=True)
def _without_dust(source, target, n):
    """Copy the first n columns; entries near denormal numbers, which are slow, become 0."""
    for c in range(len(source)):
        for i in range(n):
            a = source[c, i]
            target[c, i] = a if abs(a) > NOTHING else source.dtype.type(0)
