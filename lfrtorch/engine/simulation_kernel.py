"""Simulation of a record in machine code."""

from __future__ import annotations

from numba import njit

from lfrtorch.maps.machine_code import call_value, prepared


@njit(nogil=True, inline="always")
def matrices(sizes, weights):
    """Matrices and weights of the map as views of the vector of all numbers; see ``Layout``."""
    nx, nu, ny, nz, nw = sizes
    a = nx * nx
    b = a + nx * nu
    c = b + nx * nw
    d = c + nz * nx
    e = d + nz * nu
    f = e + ny * nx
    g = f + ny * nu
    h = g + ny * nw
    return (
        weights[:a].reshape(nx, nx), weights[a:b].reshape(nx, nu), weights[b:c].reshape(nx, nw),
        weights[c:d].reshape(nz, nx), weights[d:e].reshape(nz, nu), weights[e:f].reshape(ny, nx),
        weights[f:g].reshape(ny, nu), weights[g:h].reshape(ny, nw), weights[h:],
    )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def simulate_records(first, jobs, step, sizes, weights, code, u, met_within, x, z, w, y):
    """Call ``simulate_record`` for every record first, first + step, ... below ``jobs``."""
    for r in range(first, jobs, step):
        simulate_record(sizes, weights, code, u[r], met_within, x[r], z[r], w[r], y[r])


@njit(nogil=True, error_model="numpy", fastmath={"contract"})
def simulate_record(sizes, weights, code, u, met_within, x, z, w, y):
    """Simulate a record from x[0]: write its signals over those in x, z, w and y.

    The simulation stops once a state agrees, within ``met_within``, with the one that it would
    overwrite: the rest of the earlier trajectory then holds. A negative value means never.

    Shape:
        x: (T + 1, nx), u: (T, nu), z: (T, nz), w: (T, nw), y: (T, ny).
    """
    A, Bu, Bw, Cz, Dzu, Cy, Dyu, Dyw, phi = matrices(sizes, weights)
    value, ints, constants, room = code[1], code[3], code[4], prepared(code, phi)
    for k in range(len(u)):
        affine(Cz, x[k], Dzu, u[k], z[k])
        if len(Cz):
            call_value(value, ints, constants, phi, z[k], w[k], room)
        affine(Cy, x[k], Dyu, u[k], y[k])
        for i in range(len(Dyw)):
            for j in range(w.shape[1]):
                y[k, i] += Dyw[i, j] * w[k, j]
        met = True
        for i in range(len(A)):
            a = 0.0
            for j in range(len(A)):
                a += A[i, j] * x[k, j]
            for j in range(u.shape[1]):
                a += Bu[i, j] * u[k, j]
            for j in range(w.shape[1]):
                a += Bw[i, j] * w[k, j]
            met = met and abs(a - x[k + 1, i]) <= met_within * (1.0 + abs(a))
            x[k + 1, i] = a
        if met:
            return


@njit(nogil=True, inline="always")
def affine(C, x, D, u, out):
    """Write C x + D u into out."""
    for i in range(len(out)):
        a = 0.0
        for j in range(len(x)):
            a += C[i, j] * x[j]
        for j in range(len(u)):
            a += D[i, j] * u[j]
        out[i] = a
