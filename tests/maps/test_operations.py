"""Traced functions against the functions themselves, in torch, in machine code, and as text."""

import ctypes
import json
import math

import numpy as np
import pytest
import torch
from torch.func import jacrev
from torch.testing import assert_close

from lfrtorch._support.errors import InputError
from lfrtorch.maps.formula_code import machine_code
from lfrtorch.maps.operations import OPERATIONS, Formula, UntraceableError

pytestmark = pytest.mark.numeric


def of_torch(name: str):
    return lambda a, b: [getattr(torch, name)(a)]


NAMES = (
    "sqrt exp log sin cos tan asin acos atan sinh cosh tanh sigmoid relu abs sign square "
    "reciprocal rsqrt expm1 log1p neg"
)
ONE = {name: of_torch(name) for name in NAMES.split()}
TWO = {
    "add": lambda a, b: [a + 2 * b], "sub": lambda a, b: [1 - a - b], "mul": lambda a, b: [a * b],
    "div": lambda a, b: [a / b + 3 / b], "pow": lambda a, b: [a**2 + a**b + 2.0**b],
    "atan2": lambda a, b: [torch.atan2(a, b)], "maximum": lambda a, b: [torch.maximum(a, b)],
    "minimum": lambda a, b: [torch.minimum(a, b)], "hypot": lambda a, b: [torch.hypot(a, b)],
    "where": lambda a, b: [torch.where((a > b) | ~(a >= 0.2), a * a, torch.sin(b))],
    "and": lambda a, b: [torch.where((a < 1) & (b <= 0.5), a, b)],
    "clamp": lambda a, b: [torch.clamp(a, min=0.4, max=0.6), b.clip(max=0.1), a.clamp(0.5)],
    "softplus": lambda a, b: [torch.nn.functional.softplus(30 * a - 10 * b)],
    "shared": lambda a, b: [torch.exp(-a) * b, torch.exp(-a) + torch.exp(-a) ** 2, b],
    "abs of python": lambda a, b: [abs(a - b), -a, a * torch.tensor(2.0)],
}  # fmt: skip
FUNCTIONS = ONE | TWO


def in_machine_code(formula: Formula, v: list[float], *, slopes: bool) -> np.ndarray:
    count = len(formula.results)
    out = np.zeros(count * (1 + formula.inputs * slopes))
    given = np.array(v)
    pointers = (a.ctypes.data_as(ctypes.POINTER(ctypes.c_double)) for a in (given, out))
    machine_code(formula, slopes=slopes).ctypes(*pointers)
    return out


@pytest.mark.parametrize("name", FUNCTIONS)
def test_traced_function_and_its_derivatives(name: str):
    function = FUNCTIONS[name]
    formula = Formula.traced(function, 2)
    assert Formula.of(json.loads(json.dumps(formula.described()))) == formula
    for v in ([0.3, 0.7], [0.55, 0.12]):
        point = torch.tensor(v, dtype=torch.float64)
        expected = torch.stack(function(*point))
        slopes = jacrev(lambda p: torch.stack(function(*p)))(point)
        assert_close(torch.stack(formula(*point)), expected)
        found = torch.as_tensor(in_machine_code(formula, v, slopes=True))
        assert_close(found[: len(expected)], expected, rtol=1e-12, atol=1e-12)
        assert_close(found[len(expected) :].view(-1, 2), slopes, rtol=1e-12, atol=1e-12)
        assert_close(torch.as_tensor(in_machine_code(formula, v, slopes=False)), expected)


def test_every_operation_is_tried():
    used = {row.name for f in FUNCTIONS.values() for row in Formula.traced(f, 2).rows}
    assert set(OPERATIONS) <= used


def test_a_table_has_each_operation_once_and_none_in_vain():
    formula = Formula.traced(lambda a, b: [torch.exp(a) + 0 * 1.0, torch.exp(a) * b], 2)
    names = [row.name for row in formula.rows]
    assert names.count("exp") == 1
    formula = Formula.traced(lambda a: [a, (torch.sin(a), a)[1]], 1)
    assert [row.name for row in formula.rows] == ["input"]


def test_overflow_is_infinite_and_no_error():
    formula = Formula.traced(lambda a: [torch.exp(a), 1 / (a - a), torch.sqrt(-a)], 1)
    found = in_machine_code(formula, [1000.0], slopes=False)
    assert found[0] == math.inf
    assert not np.isfinite(found[1:]).any()


@pytest.mark.parametrize(
    ("function", "said"),
    [
        (lambda a: [a if a > 0 else -a], r"torch\.where"),
        (lambda a: [torch.lgamma(a)], "lgamma"),
        (lambda a: [float(a)], "plain number"),
        (lambda a: a, "tuple"),
        (lambda a: [a * torch.ones(2)], "not a single number"),
        (lambda a: [torch.sqrt(a, out=None)], "out"),
    ],
    ids=["branch", "operation", "float", "single", "vector", "keyword"],
)
def test_what_has_no_table_is_refused(function, said):
    with pytest.raises(UntraceableError, match=said):
        Formula.traced(function, 1)


@pytest.mark.parametrize(
    "change",
    [
        {"rows": [["open", [], 0.0]]},
        {"rows": [["sqrt", [5], 0.0]]},
        {"rows": [["input", [], 7.0]]},
        {"results": [9]},
    ],
    ids=["operation", "operand", "input", "result"],
)
def test_damaged_table_is_refused(change):
    good = Formula.traced(lambda a: [torch.sqrt(a)], 1).described()
    with pytest.raises(InputError, match="table"):
        Formula.of(good | change)
