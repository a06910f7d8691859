"""Functions of scalars as tables of operations, which torch, kernels and exports evaluate.

A function written with torch's functions is called once with symbols in place of numbers. Its
operations are recorded, one in each row. So a checkpoint stores the function without code, and
every export can write its equations.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lfrtorch._support.errors import InputError


class Operation(NamedTuple):
    """Row of a table: the name of an operation, and its operands."""

    name: str
    operands: tuple[int, ...] = ()
    """Rows, counted from 0."""
    number: float = 0.0
    """Value of a constant, or position of an input."""


def _softplus(v: Tensor) -> Tensor:
    return torch.nn.functional.softplus(v, threshold=700.0)


OPERATIONS: dict[str, Callable[..., Any]] = {
    "add": operator.add, "sub": operator.sub, "mul": operator.mul, "div": operator.truediv,
    "neg": operator.neg, "pow": operator.pow, "sqrt": torch.sqrt, "exp": torch.exp,
    "log": torch.log, "sin": torch.sin, "cos": torch.cos, "tan": torch.tan, "asin": torch.asin,
    "acos": torch.acos, "atan": torch.atan, "atan2": torch.atan2, "sinh": torch.sinh,
    "cosh": torch.cosh, "tanh": torch.tanh, "sigmoid": torch.sigmoid, "relu": torch.relu,
    "softplus": _softplus, "abs": torch.abs, "sign": torch.sign, "maximum": torch.maximum,
    "minimum": torch.minimum, "where": torch.where, "lt": operator.lt, "le": operator.le,
    "gt": operator.gt, "ge": operator.ge, "and": torch.logical_and, "or": torch.logical_or,
    "not": torch.logical_not,
}  # fmt: skip
"""Operations that a row may have, besides constants and inputs."""

_SAME = {
    "true_divide": "div", "truediv": "div", "divide": "div", "multiply": "mul", "subtract": "sub",
    "negative": "neg", "arcsin": "asin", "arccos": "acos", "arctan": "atan", "arctan2": "atan2",
    "absolute": "abs", "fmax": "maximum", "fmin": "minimum", "max": "maximum", "min": "minimum",
    "less": "lt", "less_equal": "le", "greater": "gt", "greater_equal": "ge",
    "logical_and": "and", "logical_or": "or", "logical_not": "not", "bitwise_and": "and",
    "bitwise_or": "or", "bitwise_not": "not", "expit": "sigmoid",
}  # fmt: skip
"""Other names in torch of the same operations."""


class UntraceableError(InputError):
    """Error of a function that is not composed of ``OPERATIONS``."""


def _operator(name: str, *, swapped: bool = False) -> Callable[..., Symbol]:
    """Make a method that records an operation."""

    def method(self: Symbol, *others: Any) -> Symbol:
        return _row(self.table, name, (*others, self) if swapped else (self, *others))

    return method


class Symbol:
    """Scalar in a traced function; every operation on it becomes a row."""

    def __init__(self, table: list[Operation], row: int) -> None:
        self.table, self.row = table, row

    @classmethod
    def __torch_function__(
        cls, func: Any, types: Any, args: Sequence[Any] = (), kwargs: Any = None
    ) -> Symbol | tuple[Any, ...]:
        """Record a function of torch."""
        if func.__name__ == "stack" and len(args) == 1 and not kwargs:
            return tuple(args[0])  # numbers as results of a function
        given = _flat((*args, *(kwargs or {}).values()))
        if not given:
            raise UntraceableError(f"it calls {func.__name__} with a list; use single numbers.")
        table = given[0].table
        return _row(table, func.__name__, args, kwargs or {})

    def __getattr__(self, name: str) -> Callable[..., Symbol]:
        if name.startswith("__") or not (name in OPERATIONS or name in _DERIVED or name in _SAME):
            raise AttributeError(name)
        return lambda *args, **kwargs: _row(self.table, name, (self, *args), kwargs)

    __add__, __radd__ = _operator("add"), _operator("add", swapped=True)
    __sub__, __rsub__ = _operator("sub"), _operator("sub", swapped=True)
    __mul__, __rmul__ = _operator("mul"), _operator("mul", swapped=True)
    __truediv__, __rtruediv__ = _operator("div"), _operator("div", swapped=True)
    __pow__, __rpow__ = _operator("pow"), _operator("pow", swapped=True)
    __lt__, __le__, __gt__, __ge__ = map(_operator, ("lt", "le", "gt", "ge"))
    __and__, __or__, __invert__ = map(_operator, ("and", "or", "not"))
    __neg__, __abs__ = _operator("neg"), _operator("abs")

    def __repr__(self) -> str:
        return "<a number>"

    def constant(self, value: float) -> Symbol:
        """Record a number in the same table."""
        return _symbol(self.table, value)

    def __bool__(self) -> bool:
        raise UntraceableError("it branches in Python on a value; use torch.where.")

    def __float__(self) -> float:
        raise UntraceableError("it makes a plain number of a value; use torch's functions.")


def _square(v: Any) -> Any:
    return v * v


def _clamp(v: Any, min: Any = None, max: Any = None) -> Any:
    v = v if min is None else v.maximum(min)
    return v if max is None else v.minimum(max)


def _hypot(a: Any, b: Any) -> Any:
    return torch.sqrt(a * a + b * b)


_DERIVED: dict[str, Callable[..., Any]] = {
    "square": _square, "clamp": _clamp, "clip": _clamp, "hypot": _hypot,
    "clamp_min": _clamp, "clamp_max": lambda v, max: _clamp(v, None, max),
    "reciprocal": lambda v: 1.0 / v, "rsqrt": lambda v: 1.0 / torch.sqrt(v),
    "expm1": lambda v: torch.exp(v) - 1.0, "log1p": lambda v: torch.log(1.0 + v),
    "rsub": lambda a, b: b - a, "positive": lambda v: v,
}  # fmt: skip
"""Functions of torch composed of these operations."""


def _flat(parts: Sequence[Any]) -> list[Symbol]:
    return [part for part in parts if isinstance(part, Symbol)]


def _row(
    table: list[Operation], name: str, args: Sequence[Any], kwargs: dict[str, Any] | None = None
) -> Symbol:
    """Record an operation."""
    name = name.strip("_")
    if name in _DERIVED:
        args = [_symbol(table, args[0]), *args[1:]] if name in ("clamp", "clip") else args
        return _DERIVED[name](*args, **(kwargs or {}))
    name = _SAME.get(name, name)
    if name not in OPERATIONS or kwargs:
        given = f" with {', '.join(kwargs)}" if kwargs else ""
        raise UntraceableError(
            f"it calls {name}{given}; there are {', '.join(OPERATIONS)}, {', '.join(_DERIVED)}."
        )
    rows = tuple(_symbol(table, part).row for part in args)
    return _appended(table, Operation(name, rows))


def _applied(table: list[Operation], name: str, *operands: Any) -> Symbol:
    return _row(table, name, operands)


def _symbol(table: list[Operation], part: Any) -> Symbol:
    """Return a symbol unchanged, and any number as a constant."""
    if isinstance(part, Symbol):
        return part
    try:
        return _appended(table, Operation("constant", number=float(part)))
    except (TypeError, ValueError, RuntimeError):
        raise UntraceableError(f"it uses {part!r}, which is not a single number.") from None


def _appended(table: list[Operation], row: Operation) -> Symbol:
    table.append(row)
    return Symbol(table, len(table) - 1)


class Formula(NamedTuple):
    """A function of scalars v -> w.

    Args:
        inputs: number of scalars v, which are the first rows.
        rows: operations.
        results: positions of the rows of w.
    """

    inputs: int
    rows: tuple[Operation, ...]
    results: tuple[int, ...]

    @classmethod
    def traced(cls, function: Callable[..., Any], inputs: int) -> Formula:
        """Table of a function of ``inputs`` scalars that returns scalars.

        Raises:
            UntraceableError: the function uses operations that a table cannot have.
        """
        table = [Operation("input", number=float(i)) for i in range(inputs)]
        found = function(*(Symbol(table, i) for i in range(inputs)))
        if isinstance(found, Symbol | float | int) or not hasattr(found, "__len__"):
            raise UntraceableError("it returns one value; return a tuple or a list.")
        results = tuple(_symbol(table, part).row for part in found)
        return cls(inputs, tuple(table), results).pruned()

    def pruned(self) -> Formula:
        """Remove duplicates and rows that no result needs."""
        needed, stack = set(range(self.inputs)), [*self.results]
        while stack:
            if (row := stack.pop()) not in needed:
                needed.add(row)
                stack += self.rows[row].operands
        place: dict[int, int] = {}
        rows: dict[Operation, int] = {}
        for number in sorted(needed):
            operands = tuple(place[i] for i in self.rows[number].operands)
            row = self.rows[number]._replace(operands=operands)
            place[number] = rows.setdefault(row, len(rows))
        return Formula(self.inputs, tuple(rows), tuple(place[i] for i in self.results))

    @property
    def used(self) -> set[int]:
        """Inputs on which a result of a pruned table depends."""
        rows = {i for row in self.rows for i in row.operands} | {*self.results}
        return {i for i in rows if i < self.inputs}

    def evaluated(
        self, inputs: Sequence[Any], operations: dict[str, Callable[..., Any]], constant: Any
    ) -> list[Any]:
        """Evaluate the results with the operations of a library; ``constant`` makes constants."""
        values: list[Any] = []
        for row in self.rows:
            if row.name == "input":
                values.append(inputs[int(row.number)])
            elif row.name == "constant":
                values.append(constant(row.number))
            else:
                values.append(operations[row.name](*(values[i] for i in row.operands)))
        return [values[i] for i in self.results]

    def __call__(self, *v: Tensor) -> list[Tensor]:
        """Evaluate w for tensors v of the same shape."""
        like = v[0] if v else torch.zeros(())
        found = self.evaluated(v, OPERATIONS, like.new_tensor)
        return [torch.as_tensor(w).expand_as(like) for w in found]

    def of_symbols(self, v: Sequence[Symbol]) -> list[Symbol]:
        """Evaluate w for symbols v, whose table gets the rows."""
        table = v[0].table
        apply = {name: partial(_applied, table, name) for name in OPERATIONS}
        return [_symbol(table, w) for w in self.evaluated(v, apply, partial(_symbol, table))]

    def described(self) -> dict[str, Any]:
        """Describe the table for JSON."""
        rows = [[row.name, [*row.operands], row.number] for row in self.rows]
        return {"inputs": self.inputs, "rows": rows, "results": [*self.results]}

    @classmethod
    def of(cls, description: Any) -> Formula:
        """Table of a description; an invalid description raises a ValueError."""
        rows = [Operation(str(n), tuple(map(int, o)), float(v)) for n, o, v in description["rows"]]
        inputs, results = int(description["inputs"]), tuple(map(int, description["results"]))
        for place, row in enumerate(rows):
            fits = all(0 <= i < place for i in row.operands) and math.isfinite(row.number)
            known = row.name in OPERATIONS or row.name in ("constant", "input")
            if not (fits and known and (row.name != "input" or 0 <= row.number < inputs)):
                raise InputError(f"row {place} of its table of operations is {row}")
        if not all(0 <= i < len(rows) for i in results):
            raise InputError("its table of operations has no such results")
        return cls(inputs, tuple(rows), results)
