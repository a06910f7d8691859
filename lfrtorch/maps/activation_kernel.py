"""Activations of a hidden layer in machine code."""

from __future__ import annotations

import math
from typing import Any

from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

TANH, SIGMOID, RELU, RBF, SOFTPLUS = range(5)
"""Numbers of the activations in compiled code; ``activations`` has a row for each."""


@njit(nogil=True, fastmath={"contract", "reassoc"})
def dot(x, a, y, b, count):
    """Inner product of x from a on and y from b on, summed in any order by vector instructions."""
    total = 0.0
    for n in range(count):
        total += x[a + n] * y[b + n]
    return total


LANES = 16
"""The number of neurons of a hidden layer is padded to a multiple of this. Loops over all neurons
then become vector instructions, which are twice as fast as a loop over 15 neurons."""


@njit(nogil=True, error_model="numpy", fastmath={"contract"})
def hidden(activation, nz, lanes, room, z, v):
    """Write values σ(v) and slopes σ'(v) of all neurons, v = Wz z + bz, behind the place of v.

    Args:
        room: array that begins with Wzᵀ and bz, with ``lanes`` entries in each row.
        v: position of v in ``room``; v itself need not be written.
    """
    # The compiler turns loops over all neurons into vector instructions. The loop that computes v
    # also computes σ, as vectors stored in one loop and read in the next take 20 ns to arrive.
    # Numbers are addressed by their positions, as making a view takes 2 ns.
    if activation == TANH:
        _over(_tanh, nz, lanes, room, z, v)
    elif activation == SIGMOID:
        _over(_sigmoid, nz, lanes, room, z, v)
    elif activation == RELU:
        _over(_relu, nz, lanes, room, z, v)
    elif activation == RBF:
        _over(_rbf, nz, lanes, room, z, v)
    else:
        _over(_softplus, nz, lanes, room, z, v)


@njit(nogil=True, inline="always")
def _over(sigma, nz, lanes, room, z, v):
    """Make the loop that ``hidden`` runs for one activation."""
    bz, h = nz * lanes, v + lanes
    s, z0 = h + lanes, z[0]
    if nz == 1:
        for n in range(lanes):
            room[h + n], room[s + n] = sigma(room[bz + n] + room[n] * z0)
    elif nz == 2:
        z1 = z[1]
        for n in range(lanes):
            both = room[bz + n] + room[n] * z0 + room[lanes + n] * z1
            room[h + n], room[s + n] = sigma(both)
    else:
        z1 = z[1]
        for n in range(lanes):
            room[v + n] = room[bz + n] + room[n] * z0 + room[lanes + n] * z1
        for j in range(2, nz):
            zj = z[j]
            for n in range(lanes):
                room[v + n] += room[j * lanes + n] * zj
        for n in range(lanes):
            room[h + n], room[s + n] = sigma(room[v + n])


# σ(v) and σ'(v) of one neuron; NaN stays NaN. Callers set numpy's error model, as a division with a
# check for zero is not turned into vector instructions.


@njit(nogil=True, inline="always")
def _tanh(v):
    e = _exp(-2.0 * abs(v))
    t = math.copysign((1.0 - e) / (1.0 + e), v)
    h = t if v == v else v  # noqa: PLR0124
    return h, 1.0 - h * h


@njit(nogil=True, inline="always")
def _sigmoid(v):
    e = _exp(-abs(v))
    t = (1.0 if v > 0.0 else e) / (1.0 + e)
    h = t if v == v else v  # noqa: PLR0124
    return h, h * (1.0 - h)


@njit(nogil=True, inline="always")
def _relu(v):
    return max(v, 0.0), 1.0 if v > 0.0 else 0.0


@njit(nogil=True, inline="always")
def _rbf(v):
    t = _exp(-v * v)
    h = t if v == v else v  # noqa: PLR0124
    return h, -2.0 * v * h


@njit(nogil=True, inline="always")
def _softplus(v):
    e = _exp(-abs(v))
    t = max(v, 0.0) + math.log1p(e)
    h = t if v == v else v  # noqa: PLR0124
    return h, (1.0 if v > 0.0 else e) / (1.0 + e)


def _cast(kind: Any, to: Any) -> Any:
    """A compiled function that reads the bits of a number as another type."""

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
_ROUNDED = 1.5 * 2.0**52  # added to a number, it leaves the nearest integer in the lowest bits
_ONE = 1023 << 52  # bits of 1.0
_C2, _C3, _C4, _C5, _C6, _C7, _C8, _C9, _C10, _C11, _C12, _C13 = (
    1.0 / math.factorial(n) for n in range(2, 14)
)


@njit(nogil=True, inline="always")
def _exp(v):
    """Exponential for v <= 0, to rounding: exp(v) = 2^k exp(r) with |r| <= ln(2) / 2.

    Without branches or tables, it is faster than the library's exp in a loop over neurons.
    """
    v = v if v > _LOWEST else _LOWEST  # also for NaN
    t = v * _PER_OCTAVE + _ROUNDED
    k = t - _ROUNDED
    r = (v - k * _HIGH) - k * _LOW
    s = r * r
    first = _C2 + _C3 * r + s * (_C4 + _C5 * r)
    second = _C6 + _C7 * r + s * (_C8 + _C9 * r) + s * s * (_C10 + _C11 * r + s * (_C12 + _C13 * r))
    power = _number((_bits(t) << 52) + _ONE)
    return power + power * (r + s * (first + s * s * second))
