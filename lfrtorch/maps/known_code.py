"""A known model in machine code: one step and its derivatives.

Formulas are called by their addresses, see ``formula_code.machine_code``. Signals v = [x; u; p] are
in physical units; z and w are normalised.
"""

from __future__ import annotations

from numba import njit
from numba.np.numpy_support import carray

from lfrtorch.maps.machine_code import call_formula

DISCRETE, EULER, RK4 = range(3)
"""Numbers of the integrations in compiled code."""


def known_value(ints, constants, weights, z, w, room):
    """Write w = [x+; y] of z = [x; u]; y is computed after ``before`` of the substeps.

    ``ints`` has the addresses of f and h, and of both with slopes, then nx, nz, nw, the numbers of
    parameters, method, substeps, and substeps before the output. ``constants`` has the step, then
    offsets and scales of z and w, and the scales of the parameters.
    """
    f, h, nx, nz, nw, P = ints[0], ints[1], ints[4], ints[5], ints[6], ints[7]
    method, substeps, before, step = ints[8], ints[9], ints[10], constants[0]
    of_w = 1 + 2 * nz
    inside = carray(room, (nz + P + 3 * nx + nw,))
    v, inside = inside[: nz + P], inside[nz + P :]
    x, k, total, found = inside[:nx], inside[nx : 2 * nx], inside[2 * nx : 3 * nx], inside[3 * nx :]
    for i in range(nz):
        v[i] = constants[1 + 2 * i] + constants[2 + 2 * i] * z[i]
    for i in range(P):
        v[nz + i] = weights[i] * constants[of_w + 2 * nw + i]
    if method == DISCRETE:
        call_formula(h, v, found)
        call_formula(f, v, x)
    else:
        for i in range(nx):
            x[i] = v[i]
        for n in range(substeps):
            if n == before:
                call_formula(h, v, found)
            call_formula(f, v, k)
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
                    call_formula(f, v, k)
                    for i in range(nx):
                        total[i] += k[i] if stage == 3 else 2.0 * k[i]
                for i in range(nx):
                    x[i] += step / 6.0 * total[i]
            for i in range(nx):
                v[i] = x[i]
    for i in range(nw):
        w[i] = (x[i] if i < nx else found[i - nx]) - constants[of_w + 2 * i]
        w[i] /= constants[of_w + 2 * i + 1]


def known_slope(ints, constants, weights, z, J, by_weight, stride, room):
    """Write ∂w/∂z and ∂w/∂p; the arguments are those of ``known_value``."""
    f, h, nx, nz, nw, P = ints[2], ints[3], ints[4], ints[5], ints[6], ints[7]
    method, substeps, before, step = ints[8], ints[9], ints[10], constants[0]
    of_w, q, ny = 1 + 2 * nz, nz + P, nw - nx
    p_scale = of_w + 2 * nw
    inside = carray(room, (q + 2 * nx + nw * (1 + q) + ny * q + 4 * nx * q,))
    v, inside = inside[:q], inside[q:]
    x, sum_k, inside = inside[:nx], inside[nx : 2 * nx], inside[2 * nx :]
    of_f, inside = inside[: nx * (1 + q)], inside[nx * (1 + q) :]
    of_h, inside = inside[: ny * (1 + q)], inside[ny * (1 + q) :]
    Y, inside = inside[: ny * q].reshape((ny, q)), inside[ny * q :]
    four = inside.reshape((4, nx, q))
    S, at, K, total = four[0], four[1], four[2], four[3]  # an unpacked array takes 100 ns
    for i in range(P):
        v[nz + i] = weights[i] * constants[p_scale + i]
    for i in range(nz):
        v[i] = constants[1 + 2 * i] + constants[2 + 2 * i] * z[i]
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
            slope = (S[i, j] if i < nx else Y[i - nx, j]) / constants[of_w + 2 * i + 1]
            if j < nz:
                J[i * nz + j] = slope * constants[2 + 2 * j]
            elif stride:
                by_weight[i * stride + j - nz] = slope * constants[p_scale + j - nz]


@njit(nogil=True, error_model="numpy")
def _chained(f, v, of_f, S, K):
    """Evaluate f at v, and compute K = Fx S + [0 Fu Fp]."""
    call_formula(f, v, of_f)
    nx, q = S.shape
    for i in range(len(K)):
        row = len(K) + i * q
        for j in range(q):
            a = of_f[row + j] if j >= nx else 0.0
            for n in range(nx):
                a += of_f[row + n] * S[n, j]
            K[i, j] = a
