"""Activations of a hidden layer in machine code."""

from __future__ import annotations

import math
from typing import Any

from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

TANH, SIGMOID, RELU, RBF, SOFTPLUS = range(5)
"""Numbers of the activations in compiled code; their rows are in ``activations``."""


@njit(nogil=True, fastmath={"contract", "reassoc"})
def dot(a, b):
    """Inner product; sums in any order become vector instructions, the states' sums keep theirs."""
    total = 0.0
    for n in range(len(a)):
        total += a[n] * b[n]
    return total


LANES = 16
"""A hidden layer has room for a multiple of so many neurons: loops over all of it are vector
instructions, twice as fast as over 15 neurons."""


@njit(nogil=True, error_model="numpy", fastmath={"contract"})
def activate(activation, v, h):
    """h = σ(v) of all neurons, in loops that the compiler turns into vector instructions."""
    # A division that is checked for zero stays one instruction for each number: numpy's errors.
    if activation == TANH:
        for n in range(len(h)):
            e = _exp(-2.0 * abs(v[n]))
            t = math.copysign((1.0 - e) / (1.0 + e), v[n])
            h[n] = t if v[n] == v[n] else v[n]  # NaN stays
    elif activation == SIGMOID:
        for n in range(len(h)):
            e = _exp(-abs(v[n]))
            t = (1.0 if v[n] > 0.0 else e) / (1.0 + e)
            h[n] = t if v[n] == v[n] else v[n]
    elif activation == RELU:
        for n in range(len(h)):
            h[n] = max(v[n], 0.0)
    elif activation == RBF:
        for n in range(len(h)):
            t = _exp(-v[n] * v[n])
            h[n] = t if v[n] == v[n] else v[n]
    else:
        for n in range(len(h)):
            t = max(v[n], 0.0) + math.log1p(_exp(-abs(v[n])))
            h[n] = t if v[n] == v[n] else v[n]


@njit(nogil=True, error_model="numpy", fastmath={"contract"})
def slopes(activation, v, h, s):
    """s = σ'(v) of all neurons with h = σ(v)."""
    if activation == TANH:
        for n in range(len(s)):
            s[n] = 1.0 - h[n] * h[n]
    elif activation == SIGMOID:
        for n in range(len(s)):
            s[n] = h[n] * (1.0 - h[n])
    elif activation == RELU:
        for n in range(len(s)):
            s[n] = 1.0 if v[n] > 0.0 else 0.0
    elif activation == RBF:
        for n in range(len(s)):
            s[n] = -2.0 * v[n] * h[n]
    else:
        for n in range(len(s)):
            s[n] = 1.0 / (1.0 + math.exp(-v[n]))


def _cast(kind: Any, to: Any) -> Any:
    """A compiled function that takes the bits of a number for one of another type."""

    def typed(typingctx, x):
        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            return builder.bitcast(args[0], to)

        return kind(x), codegen

    return intrinsic(typed)


_bits: Any = _cast(types.int64, ir.IntType(64))
_number: Any = _cast(types.float64, ir.DoubleType())


_LOWEST = -700.0
_PER_OCTAVE = 1.0 / math.log(2.0)
_HIGH = 6.93147180369123816490e-01  # sum: ln 2; products with small integers are exact
_LOW = 1.90821492927058770002e-10
_ROUNDED = 1.5 * 2.0**52  # added to a number it leaves the nearest integer in the lowest bits
_ONE = 1023 << 52  # bits of 1.0
_C2, _C3, _C4, _C5, _C6, _C7, _C8, _C9, _C10, _C11, _C12, _C13 = (
    1.0 / math.factorial(n) for n in range(2, 14)
)


@njit(nogil=True, inline="always")
def _exp(v):
    """exp(v) for v <= 0, to rounding: exp(v) = 2^k exp(r) with |r| <= ln(2) / 2.

    Faster than the library's in a loop over neurons, as it has neither branch nor table.
    """
    v = v if v > _LOWEST else _LOWEST  # NaN, too
    t = v * _PER_OCTAVE + _ROUNDED
    k = t - _ROUNDED
    r = (v - k * _HIGH) - k * _LOW
    s = r * r
    first = _C2 + _C3 * r + s * (_C4 + _C5 * r)
    second = _C6 + _C7 * r + s * (_C8 + _C9 * r) + s * s * (_C10 + _C11 * r + s * (_C12 + _C13 * r))
    power = _number((_bits(t) << 52) + _ONE)
    return power + power * (r + s * (first + s * s * second))
