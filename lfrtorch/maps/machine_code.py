"""Static maps in machine code: functions that the loops over time call by their address.

A loop takes the address as a number, so it is compiled once for all maps. A call takes a tenth of
the time of fifteen neurons. Signals and weights are float64.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import cfunc, njit, types
from numba.extending import intrinsic

from lfrtorch._support.types import Array, Integers

_INTS, _DOUBLES = types.CPointer(types.int64), types.CPointer(types.float64)

PREPARE = types.void(_INTS, _DOUBLES, _DOUBLES, _DOUBLES)
"""Type of a preparation for many values and slopes: (ints, constants, weights, room) -> None."""

VALUE = types.void(_INTS, _DOUBLES, _DOUBLES, _DOUBLES, _DOUBLES, _DOUBLES)
"""Type of a value: (ints, constants, weights, z, w, room) -> None, which writes w (nw,)."""

SLOPE = types.void(
    _INTS, _DOUBLES, _DOUBLES, _DOUBLES, _DOUBLES, _DOUBLES, types.int64, _DOUBLES
)  # fmt: skip
"""Type of a slope: (ints, constants, weights, z, J, by_weight, stride, room) -> None. It writes
∂w/∂z (nw, nz) and ∂w/∂weights (nw, P) with rows ``stride`` numbers apart; 0 omits the latter."""


class Code(NamedTuple):
    """A static map for compiled loops.

    Args:
        prepare, value, slope: addresses of functions of the types ``PREPARE``, ``VALUE`` and
            ``SLOPE``; 0 if there is nothing to prepare.
        ints, constants: numbers that these functions need beside the weights.
        room: number of float64 entries of their scratch array, which holds prepared numbers.
        keep: objects that must live as long as the addresses.
    """

    prepare: int
    value: int
    slope: int
    ints: Integers
    constants: Array
    room: int
    keep: Any = None

    @property
    def arguments(self) -> tuple[int, int, int, Integers, Array, int]:
        """Arguments of a compiled loop."""
        return self[:6]


NOTHING = Code(0, 0, 0, np.zeros(0, np.int64), np.zeros(0), 0)
"""Code in place of a missing map; it is never called."""


@cache
def address(function: Callable[..., None], signature: Any = VALUE) -> int:
    """Address of a function, compiled at the first use and kept on disk."""
    made = cfunc(signature, cache=True, error_model="numpy", fastmath={"contract"})(function)
    _KEPT.append(made)
    return int(made.address or 0)


_KEPT: list[Any] = []
"""Functions whose addresses are in use."""


def _called(*names: str) -> Any:
    """Compile a call of an address; arrays are passed by address, numbers by value."""
    whole, double = ir.IntType(64), ir.DoubleType().as_pointer()
    kinds = {"ints": whole.as_pointer(), "stride": whole}
    types_of = [kinds.get(name, double) for name in names]

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data = [
            value if name == "stride" else context.make_array(kind)(context, builder, value).data
            for name, kind, value in zip(names, signature.args[1:], args[1:], strict=True)
        ]
        function = ir.FunctionType(ir.VoidType(), types_of).as_pointer()
        builder.call(builder.inttoptr(args[0], function), data)
        return context.get_dummy_value()

    return codegen


def _prepare(typingctx, address, ints, constants, weights, room):
    given = (address, ints, constants, weights, room)
    return types.void(*given), _called("ints", "constants", "weights", "room")


def _value(typingctx, address, ints, constants, weights, z, w, room):
    given = (address, ints, constants, weights, z, w, room)
    return types.void(*given), _called("ints", "constants", "weights", "z", "w", "room")


def _slope(typingctx, address, ints, constants, weights, z, J, by_weight, stride, room):
    given = (address, ints, constants, weights, z, J, by_weight, types.int64, room)
    names = "ints", "constants", "weights", "z", "J", "by_weight", "stride", "room"
    return types.void(*given), _called(*names)


def _formula(typingctx, address, v, out):
    return types.void(address, v, out), _called("v", "out")


call_prepare: Any = intrinsic(_prepare)
call_value: Any = intrinsic(_value)
call_slope: Any = intrinsic(_slope)
call_formula: Any = intrinsic(_formula)
"""Call a function by its address with contiguous arrays, in compiled code."""


@njit(nogil=True, inline="always")
def prepared(code, weights):
    """Scratch array of a map, prepared for its values and slopes with these weights."""
    room = np.empty(code[5])
    if code[0]:
        call_prepare(code[0], code[3], code[4], weights, room)
    return room
