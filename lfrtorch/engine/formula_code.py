"""Formulas as sympy's expressions, with their derivatives, and as machine code."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

from lfrtorch.engine.operations import Formula


class Code(NamedTuple):
    """Assignments in order: of temporaries, by name, and of results."""

    temporaries: list[tuple[Any, Any]]
    results: list[Any]


def expressions(formula: Formula, inputs: Sequence[Any]) -> list[Any]:
    """The results as expressions of sympy in symbols for the inputs."""
    import sympy

    def choice(condition: Any, yes: Any, no: Any) -> Any:
        return sympy.Piecewise((yes, condition), (no, True))

    def softplus(v: Any) -> Any:
        return choice(v > 0, v, 0.0) + sympy.log(1 + sympy.exp(-sympy.Abs(v)))

    same = "sqrt exp log sin cos tan asin acos atan atan2 sinh cosh tanh"
    operations: dict[str, Callable[..., Any]] = {n: getattr(sympy, n) for n in same.split()}
    operations |= {
        "add": lambda a, b: a + b, "sub": lambda a, b: a - b, "mul": lambda a, b: a * b,
        "div": lambda a, b: a / b, "neg": lambda a: -a, "pow": lambda a, b: a**b,
        "sigmoid": lambda v: 1 / (1 + sympy.exp(-v)), "softplus": softplus, "abs": sympy.Abs,
        "relu": lambda v: choice(v > 0, v, 0.0), "where": choice,
        "sign": lambda v: sympy.Piecewise((1, v > 0), (-1, v < 0), (0, True)),
        "maximum": lambda a, b: choice(a >= b, a, b), "minimum": lambda a, b: choice(a <= b, a, b),
        "lt": sympy.Lt, "le": sympy.Le, "gt": sympy.Gt, "ge": sympy.Ge,
        "and": sympy.And, "or": sympy.Or, "not": sympy.Not,
    }  # fmt: skip

    def constant(value: float) -> Any:
        return sympy.Integer(int(value)) if value.is_integer() else sympy.Float(value, 17)

    return formula.evaluated(inputs, operations, constant)


@lru_cache(maxsize=32)
def code(formula: Formula, *, slopes: bool = False) -> Code:
    """The results, and with ``slopes`` their derivatives by all inputs, row by row, as assignments.

    The inputs are the symbols v0, v1, ...
    """
    import sympy

    v = sympy.symbols(f"v:{formula.inputs}", real=True)
    found = [sympy.sympify(each) for each in expressions(formula, v)]
    if slopes:
        found += [each.diff(by) for each in found for by in v]
    # A derivative at a point where there is none counts as 0.
    found = [each.replace(sympy.DiracDelta, lambda *_: sympy.Integer(0)) for each in found]
    temporaries, results = sympy.cse(found, symbols=sympy.numbered_symbols("t"), list=True)
    return Code(temporaries, list(results))


@lru_cache(maxsize=32)
def machine_code(formula: Formula, *, slopes: bool = False) -> Any:
    """A function of pointers (v, out) in machine code; ``slopes``: derivatives follow the results.

    Kernels take it as an argument, and are compiled once for all of them.
    """
    from numba import cfunc, types
    from sympy import pycode

    made = code(formula, slopes=slopes)
    lines = [f"v{i} = v[{i}]" for i in range(formula.inputs)]
    lines += [f"{name} = {pycode(value)}" for name, value in made.temporaries]
    lines += [f"out[{i}] = {pycode(value)}" for i, value in enumerate(made.results)]
    source = "def function(v, out):\n    " + "\n    ".join(lines) + "\n"
    known: dict[str, Any] = {"math": math}
    exec(compile(source, "<formula>", "exec"), known)  # of operations of the table alone
    pointer = types.CPointer(types.float64)
    return cfunc(types.void(pointer, pointer), error_model="numpy")(known["function"])
