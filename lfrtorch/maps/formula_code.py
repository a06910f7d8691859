"""Formulas and their derivatives as source text of a language, and as machine code."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Any

import torch

from lfrtorch.maps.operations import Formula, Operation, Symbol

PYTHON = {
    "add": "{0} + {1}", "sub": "{0} - {1}", "mul": "{0} * {1}", "div": "{0} / {1}", "neg": "-{0}",
    "pow": "{0} ** {1}", "sigmoid": "1.0 / (1.0 + math.exp(-{0}))", "abs": "abs({0})",
    "relu": "{0} if {0} > 0.0 else 0.0", "where": "{1} if {0} else {2}",
    "softplus": "({0} if {0} > 0.0 else 0.0) + math.log(1.0 + math.exp(-abs({0})))",
    "sign": "1.0 if {0} > 0.0 else (-1.0 if {0} < 0.0 else 0.0)",
    "maximum": "{0} if {0} >= {1} else {1}", "minimum": "{0} if {0} <= {1} else {1}",
    "lt": "{0} < {1}", "le": "{0} <= {1}", "gt": "{0} > {1}", "ge": "{0} >= {1}",
    "and": "{0} and {1}", "or": "{0} or {1}", "not": "not {0}", "atan2": "math.atan2({0}, {1})",
} | {
    name: f"math.{name}({{0}})" for name in (
        "sqrt", "exp", "log", "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh"
    )
}  # fmt: skip
"""Operations in Python; operands are names or numbers in brackets."""

SLOPES: dict[str, Callable[..., tuple[Any, ...]]] = {
    "add": lambda w, a, b: (1.0, 1.0), "sub": lambda w, a, b: (1.0, -1.0),
    "mul": lambda w, a, b: (b, a), "div": lambda w, a, b: (1.0 / b, -w / b),
    "neg": lambda w, a: (-1.0,), "pow": lambda w, a, b: (b * a ** (b - 1.0), w * torch.log(a)),
    "sqrt": lambda w, a: (0.5 / w,), "exp": lambda w, a: (w,), "log": lambda w, a: (1.0 / a,),
    "sin": lambda w, a: (torch.cos(a),), "cos": lambda w, a: (-torch.sin(a),),
    "tan": lambda w, a: (1.0 + w * w,), "asin": lambda w, a: (1.0 / torch.sqrt(1.0 - a * a),),
    "acos": lambda w, a: (-1.0 / torch.sqrt(1.0 - a * a),),
    "atan": lambda w, a: (1.0 / (1.0 + a * a),),
    "atan2": lambda w, a, b: (b / (a * a + b * b), -a / (a * a + b * b)),
    "sinh": lambda w, a: (torch.cosh(a),), "cosh": lambda w, a: (torch.sinh(a),),
    "tanh": lambda w, a: (1.0 - w * w,), "sigmoid": lambda w, a: (w * (1.0 - w),),
    "relu": lambda w, a: (torch.where(a > 0.0, 1.0, 0.0),),
    "softplus": lambda w, a: (torch.sigmoid(a),), "abs": lambda w, a: (torch.sign(a),),
    "maximum": lambda w, a, b: (torch.where(a >= b, 1.0, 0.0), torch.where(a >= b, 0.0, 1.0)),
    "minimum": lambda w, a, b: (torch.where(a <= b, 1.0, 0.0), torch.where(a <= b, 0.0, 1.0)),
}  # fmt: skip
"""Partial derivatives of operations, from result and operands; 0 for operations not listed."""


@lru_cache(maxsize=32)
def with_slopes(formula: Formula) -> Formula:
    """Table of the results, followed by the derivatives of each result by all inputs.

    At a kink, such as that of an absolute value, the derivative is that of one side, or 0.
    """
    table = [*formula.rows]
    tangents: list[dict[int, Any]] = []  # nonzero derivatives of each row, by input

    def symbol(row: int) -> Symbol:
        return Symbol(table, row)

    def is_one(value: Any) -> bool:
        return isinstance(value, float) and value == 1.0

    def product(a: Any, b: Any) -> Any:
        return b if is_one(a) else a if is_one(b) else a * b

    for number, row in enumerate(formula.rows):
        found: dict[int, Any] = {}
        if row.name == "input":
            found[int(row.number)] = 1.0
        elif row.name == "where":
            condition, *sides = row.operands
            for j in tangents[sides[0]] | tangents[sides[1]]:
                yes, no = (tangents[side].get(j, 0.0) for side in sides)
                found[j] = torch.where(symbol(condition), yes, no)  # pyright: ignore
        elif row.name in SLOPES and any(tangents[place] for place in row.operands):
            partials = SLOPES[row.name](symbol(number), *map(symbol, row.operands))
            for place, partial in zip(row.operands, partials, strict=True):
                for j, tangent in tangents[place].items():
                    term = product(partial, tangent)
                    found[j] = found[j] + term if j in found else term
        tangents.append(found)
    results = [*formula.results]
    for row in formula.results:
        for j in range(formula.inputs):
            slope = tangents[row].get(j, 0.0)
            if not isinstance(slope, Symbol):
                table.append(Operation("constant", number=slope))
                slope = symbol(len(table) - 1)
            results.append(slope.row)
    return Formula(formula.inputs, tuple(table), tuple(results)).pruned()


def statements(
    formula: Formula, inputs: Sequence[str], texts: Mapping[str, str]
) -> tuple[list[tuple[str, str]], list[str]]:
    """Names and expressions of temporaries in order, and results, in the syntax of a language.

    Args:
        formula: the table to write.
        inputs: text of each input in the language.
        texts: text of each operation.
    """
    names: list[str] = []
    made: list[tuple[str, str]] = []
    for row in formula.rows:
        if row.name == "input":
            names.append(inputs[int(row.number)])
        elif row.name == "constant":
            names.append(repr(row.number) if row.number >= 0 else f"({row.number!r})")
        else:
            expression = texts[row.name].format(*(names[i] for i in row.operands))
            made.append((f"t{len(made)}", expression))
            names.append(made[-1][0])
    return made, [names[i] for i in formula.results]


@lru_cache(maxsize=32)
def machine_code(formula: Formula, *, slopes: bool = False) -> Any:
    """Compile a function of pointers (v, out); with ``slopes``, derivatives follow the results.

    Kernels take the function as an argument, so they are compiled once for all formulas.
    """
    from numba import cfunc, types

    formula = with_slopes(formula) if slopes else formula
    made, results = statements(formula, [f"v[{i}]" for i in range(formula.inputs)], PYTHON)
    lines = [f"{name} = {expression}" for name, expression in made]
    lines += [f"out[{i}] = {result}" for i, result in enumerate(results)]
    source = "def function(v, out):\n    " + "\n    ".join(lines) + "\n"
    known: dict[str, Any] = {"math": math}
    exec(compile(source, "<formula>", "exec"), known)  # operations of the table alone
    pointer = types.CPointer(types.float64)
    return cfunc(types.void(pointer, pointer), error_model="numpy")(known["function"])
