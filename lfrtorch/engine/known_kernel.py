"""A known model in machine code: one step, its derivatives, and a record of an LFR around it.

Formulas come as functions of pointers, see ``formula_code.machine_code``. Signals of v = [x; u; p]
are in physical units, those of z and w normalised.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from lfrtorch.engine.simulation_kernel import activate, affine, dot

DISCRETE, EULER, RK4 = range(3)
"""Numbers of the integrations in compiled code."""


@njit(nogil=True, error_model="numpy")
def known_step(z, of_z, of_w, p, f, h, nx, method, step, substeps, before, work, w):
    """Write w = [x+; y] of z = [x; u]; y is that after ``before`` of the substeps.

    Shape:
        of_z: (nz, 2) and of_w: (nw, 2), offsets and scales, work: (5, at least nz + p and nw).
    """
    v, x, k, total, found = work[0], work[1], work[2], work[3], work[4]
    for i in range(len(z)):
        v[i] = of_z[i, 0] + of_z[i, 1] * z[i]
    for i in range(len(p)):
        v[len(z) + i] = p[i]
    if method == DISCRETE:
        h(v.ctypes, found.ctypes)
        f(v.ctypes, x.ctypes)
    else:
        for i in range(nx):
            x[i] = v[i]
        for n in range(substeps):
            if n == before:
                h(v.ctypes, found.ctypes)
            f(v.ctypes, k.ctypes)
            if method == EULER:
                for i in range(nx):
                    x[i] += step * k[i]
            else:
                for i in range(nx):
                    total[i] = k[i]
                for stage in range(1, 4):
                    part = step if stage == 3 else 0.5 * step
                    for i in range(nx):
                        v[i] = x[i] + part * k[i]
                    f(v.ctypes, k.ctypes)
                    for i in range(nx):
                        total[i] += k[i] if stage == 3 else 2.0 * k[i]
                for i in range(nx):
                    x[i] += step / 6.0 * total[i]
            for i in range(nx):
                v[i] = x[i]
    for i in range(len(w)):
        w[i] = ((x[i] if i < nx else found[i - nx]) - of_w[i, 0]) / of_w[i, 1]


@njit(cache=True, nogil=True, error_model="numpy")
def known_slopes(
    part, parts, z, of_z, of_w, p, p_scale, f, h, nx, method, step, substeps, before, by_z, by_p
):  # fmt: skip
    """Write ∂w/∂z and ∂w/∂p of all samples of every ``parts``-th record.

    One call has many records: to hand over ``f`` and ``h`` takes as long as 100 samples.

    Shape:
        z: (R, T, nz), by_z: (R, T, nw, nz), by_p: (R, T, nw, p).
    """
    for r in range(part, len(z), parts):
        _slopes(
            z[r], of_z, of_w, p, p_scale, f, h, nx, method, step, substeps, before, by_z[r], by_p[r]
        )


@njit(nogil=True, error_model="numpy")
def _slopes(
    z, of_z, of_w, p, p_scale, f, h, nx, method, step, substeps, before, by_z, by_p
):  # fmt: skip
    """The same of one record."""
    nz, nw = z.shape[1], by_z.shape[1]
    q = nz + len(p)
    v, x = np.empty(q), np.empty(nx)
    of_f, of_h, Y = np.empty(nx * (1 + q)), np.empty((nw - nx) * (1 + q)), np.empty((nw - nx, q))
    S, at, K, total = np.empty((nx, q)), np.empty((nx, q)), np.empty((nx, q)), np.empty((nx, q))
    sum_k = np.empty(nx)
    for i in range(len(p)):
        v[nz + i] = p[i]
    for t in range(len(z)):
        for i in range(nz):
            v[i] = of_z[i, 0] + of_z[i, 1] * z[t, i]
        for i in range(nx):
            x[i] = v[i]
            for j in range(q):
                S[i, j] = 1.0 if i == j else 0.0
        for n in range(substeps):
            if n == before:
                _chained(h, v, of_h, S, Y)
            _chained(f, v, of_f, S, K)
            if method != RK4:
                for i in range(nx):
                    if method == EULER:
                        x[i] += step * of_f[i]
                    for j in range(q):
                        S[i, j] = S[i, j] + step * K[i, j] if method == EULER else K[i, j]
            else:
                for i in range(nx):
                    sum_k[i] = of_f[i]
                    for j in range(q):
                        total[i, j] = K[i, j]
                for stage in range(1, 4):
                    part = step if stage == 3 else 0.5 * step
                    for i in range(nx):
                        v[i] = x[i] + part * of_f[i]
                        for j in range(q):
                            at[i, j] = S[i, j] + part * K[i, j]
                    _chained(f, v, of_f, at, K)
                    factor = 1.0 if stage == 3 else 2.0
                    for i in range(nx):
                        sum_k[i] += factor * of_f[i]
                        for j in range(q):
                            total[i, j] += factor * K[i, j]
                for i in range(nx):
                    x[i] += step / 6.0 * sum_k[i]
                    for j in range(q):
                        S[i, j] += step / 6.0 * total[i, j]
            if method != DISCRETE:
                for i in range(nx):
                    v[i] = x[i]
        for i in range(nw):
            for j in range(q):
                slope = S[i, j] if i < nx else Y[i - nx, j]
                if j < nz:
                    by_z[t, i, j] = slope * of_z[j, 1] / of_w[i, 1]
                else:
                    by_p[t, i, j - nz] = slope * p_scale[j - nz] / of_w[i, 1]


@njit(nogil=True, error_model="numpy")
def _chained(f, v, of_f, S, K):
    """Evaluate f at v, and K = Fx S + [0 Fu Fp]."""
    f(v.ctypes, of_f.ctypes)
    nx, q = S.shape
    for i in range(len(K)):
        row = len(K) + i * q
        for j in range(q):
            a = of_f[row + j] if j >= nx else 0.0
            for n in range(nx):
                a += of_f[row + n] * S[n, j]
            K[i, j] = a


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def simulate_known_records(
    part, parts, u, A, Bu, Bw, Cz, Dzu, Cy, Dyu, Dyw, WzT, Ww, bz, bw, activation, growth,
    of_z, of_w, p, f, h, n_states, method, step, substeps, before, met_within, x, z, w, y,
):  # fmt: skip
    """Simulate every ``parts``-th record; see ``_simulate``."""
    for r in range(part, len(u), parts):
        _simulate(
            u[r], A, Bu, Bw, Cz, Dzu, Cy, Dyu, Dyw, WzT, Ww, bz, bw, activation, growth, of_z, of_w,
            p, f, h, n_states, method, step, substeps, before, met_within, x[r], z[r], w[r], y[r],
        )  # fmt: skip


@njit(nogil=True, error_model="numpy", fastmath={"contract"})
def _simulate(
    u, A, Bu, Bw, Cz, Dzu, Cy, Dyu, Dyw, WzT, Ww, bz, bw, activation, growth,
    of_z, of_w, p, f, h, n_states, method, step, substeps, before, met_within, x, z, w, y,
):  # fmt: skip
    """Simulate a record of a static map that is a known model and then a network or polynomial.

    All else is as in ``simulation_kernel.simulate_record``, and written again: in functions that
    both call, the recurrence of a network takes 1.4 times as long.
    """
    neurons, work = np.empty(Ww.shape[1]), np.empty((5, len(of_z) + len(p) + len(of_w)))
    known_z, known_w = np.empty(len(of_z)), np.empty(len(of_w))
    first, last = len(known_z), len(known_w)
    for k in range(len(u)):
        affine(Cz, x[k], Dzu, u[k], z[k])
        for i in range(first):
            known_z[i] = z[k, i]
        known_step(
            known_z, of_z, of_w, p, f, h, n_states, method, step, substeps, before, work, known_w
        )
        for i in range(last):
            w[k, i] = known_w[i]
        if len(Ww):
            _learned_map(WzT, Ww, bz, bw, activation, growth, z[k, first:], neurons, w[k, last:])
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
def _learned_map(WzT, Ww, bz, bw, activation, growth, z, h, w):
    """Write w of z, by way of the hidden layer h."""
    if len(growth):
        h[0] = 1.0
        for n in range(len(growth)):
            h[n + 1] = h[growth[n, 0]] * z[growth[n, 1]]
    else:
        for n in range(len(h)):
            h[n] = bz[n]
        for j in range(len(z)):
            for n in range(len(h)):
                h[n] += WzT[j, n] * z[j]
        activate(activation, h)
    for i in range(len(w)):
        w[i] = bw[i] + dot(Ww[i], h)
