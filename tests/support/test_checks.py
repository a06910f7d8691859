"""Checks at the door: what passes, and the message that names what does not."""

import math

import numpy as np
import pytest

import lfrtorch
from lfrtorch._support.checks import integer, number


@pytest.mark.parametrize("value", [2, 3.0, 2.5, "3", None, True, math.nan])
def test_whole_numbers_pass_and_anything_else_is_named(value):
    for good in (3, np.int64(3), 4):
        integer("nx", good, 3)
    with pytest.raises(ValueError, match=f"nx is {value!r}; give a whole number of at least 3"):
        integer("nx", value, 3)


@pytest.mark.parametrize("value", [2**63, 10**20, 10**5000, -(10**5000)], ids=int.bit_length)
def test_whole_numbers_of_more_than_64_bits_are_refused(value):
    with pytest.raises(ValueError, match="seed has more than 64 bits; give a smaller whole number"):
        integer("seed", value, 0)


@pytest.mark.parametrize("value", [-1, "1", None, True, math.nan, math.inf])
def test_numbers_pass_and_anything_else_is_named(value):
    for good in (0, 0.5, np.float64(2), 7):
        number("ridge", good)
    with pytest.raises(ValueError, match=f"ridge is {value!r}; give a number of at least 0"):
        number("ridge", value)
    with pytest.raises(ValueError, match="damping is 0; give a positive number"):
        number("damping", 0, positive=True)


def test_a_name_that_is_not_there_is_an_error():
    with pytest.raises(AttributeError, match=r"no attribute 'nothing'$"):
        _ = lfrtorch.nothing  # pyright: ignore[reportAttributeAccessIssue]
