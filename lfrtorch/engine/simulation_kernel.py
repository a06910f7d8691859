"""One record of a model in machine code: linear, or with a ``Network`` or a ``Polynomial``."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

TANH, SIGMOID, RELU, RBF, SOFTPLUS = range(5)
"""Numbers of the activations in compiled code; their rows are in ``activations``."""


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def simulate_record(
    r, u, A, Bu, Bw, Cz, Dzu, Cy, Dyu, Dyw, WzT, Ww, bz, bw, activation, growth,
    met_within, x, z, w, y,
):  # fmt: skip
    """Simulate record r: write its signals over those in x, z, w and y.

    It stops once a state agrees, within ``met_within``, with the one that it would overwrite: the
    rest of the earlier trajectory then holds for this one, too.

    The hidden layer is σ(Wz z + bz), or has the monomials of a polynomial if these have a growth.

    Shape:
        growth: (nn - 1, 2) as that of ``Polynomial``, or (0, 2), x: (R, T + 1, nx),
        u: (R, T, nu), z: (R, T, nz), w: (R, T, nw), y: (R, T, ny).
    """
    u, x, z, w, y = u[r], x[r], z[r], w[r], y[r]
    h = np.empty(Ww.shape[1], u.dtype)
    for k in range(len(u)):
        affine(Cz, x[k], Dzu, u[k], z[k])
        if len(growth):
            h[0] = 1.0
            for n in range(len(growth)):
                h[n + 1] = h[growth[n, 0]] * z[k, growth[n, 1]]
        else:
            for n in range(len(h)):
                h[n] = bz[n]
            for j in range(z.shape[1]):
                for n in range(len(h)):  # neighbours in memory
                    h[n] += WzT[j, n] * z[k, j]
            activate(activation, h)
        for i in range(w.shape[1]):
            w[k, i] = bw[i] + dot(Ww[i], h)
        affine(Cy, x[k], Dyu, u[k], y[k])
        for i in range(len(Dyw)):
            for j in range(w.shape[1]):
                y[k, i] += Dyw[i, j] * w[k, j]
        met = True
        for i in range(len(A)):
            a = u.dtype.type(0)
            for j in range(len(A)):
                a += A[i, j] * x[k, j]
            for j in range(u.shape[1]):
                a += Bu[i, j] * u[k, j]
            for j in range(w.shape[1]):
                a += Bw[i, j] * w[k, j]
            # What stood there is the other trajectory, or NaN, which nothing meets.
            met = met and abs(a - x[k + 1, i]) <= met_within * (1.0 + abs(a))
            x[k + 1, i] = a
        if met:
            return


@njit(nogil=True, inline="always")
def affine(C, x, D, u, out):
    """Out = C x + D u."""
    for i in range(len(out)):
        a = out.dtype.type(0)
        for j in range(len(x)):
            a += C[i, j] * x[j]
        for j in range(len(u)):
            a += D[i, j] * u[j]
        out[i] = a


@njit(nogil=True, fastmath={"contract", "reassoc"})
def dot(a, b):
    """Inner product; sums in any order become vector instructions, the states' sums keep theirs."""
    total = a.dtype.type(0)
    for n in range(len(a)):
        total += a[n] * b[n]
    return total


@njit(nogil=True, fastmath={"contract"})
def activate(activation, h):
    """σ of all neurons in place, in loops that the compiler can turn into vector instructions."""
    if activation == TANH:
        for n in range(len(h)):
            e = _exp(-2.0 * abs(h[n]))
            t = math.copysign((1.0 - e) / (1.0 + e), h[n])
            h[n] = t if h[n] == h[n] else h[n]  # NaN stays
    elif activation == SIGMOID:
        for n in range(len(h)):
            e = _exp(-abs(h[n]))
            t = (1.0 if h[n] > 0.0 else e) / (1.0 + e)
            h[n] = t if h[n] == h[n] else h[n]
    elif activation == RELU:
        for n in range(len(h)):
            h[n] = max(h[n], 0.0)
    elif activation == RBF:
        for n in range(len(h)):
            t = _exp(-h[n] * h[n])
            h[n] = t if h[n] == h[n] else h[n]
    else:
        for n in range(len(h)):
            t = max(h[n], 0.0) + math.log1p(_exp(-abs(h[n])))
            h[n] = t if h[n] == h[n] else h[n]


@njit(nogil=True, error_model="numpy")
def slope_of(activation, v, h):
    """σ'(v) of one neuron with h = σ(v)."""
    if activation == TANH:
        return 1.0 - h * h
    if activation == SIGMOID:
        return h * (1.0 - h)
    if activation == RELU:
        return 1.0 if v > 0.0 else 0.0
    if activation == RBF:
        return -2.0 * v * h
    return 1.0 / (1.0 + math.exp(-v))


_STEPS = 32  # of an octave
_POWERS = 2.0 ** (-np.arange(_STEPS * 1024) / _STEPS)
_LOWEST = -700.0
_PER_STEP = _STEPS / math.log(2.0)
_STEP_HIGH = 6.93147180369123816490e-01 / _STEPS  # sum: ln 2 / 32; products with integers are exact
_STEP_LOW = 1.90821492927058770002e-10 / _STEPS
_C2, _C3, _C4, _C5, _C6 = (1.0 / math.factorial(n) for n in range(2, 7))


@njit(nogil=True, inline="always")
def _exp(v):
    """exp(v) for v <= 0, to rounding: exp(v) = 2^(-k / 32) exp(r) with |r| <= ln(2) / 64.

    Twice as fast as the library's in a loop over neurons, as it has no branch.
    """
    v = v if v > _LOWEST else _LOWEST  # NaN, too: the index must stay in the table
    k = np.int32(0.5 - v * _PER_STEP)
    r = v + k * _STEP_HIGH + k * _STEP_LOW
    p = r * r * (_C2 + r * (_C3 + r * (_C4 + r * (_C5 + r * _C6))))
    return _POWERS[k] + _POWERS[k] * (r + p)
