"""Checks at the door: an argument of the right type and size, or a message that names it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from numbers import Integral, Real
from typing import Any

import numpy as np


def integer(name: str, value: Any, least: int) -> None:
    """Refuse what is not a whole number of at least ``least`` with a ValueError."""
    if isinstance(value, bool) or not isinstance(value, Integral) or int(value) < least:
        raise ValueError(f"{name} is {value!r}; give a whole number of at least {least}.")


def band(given: Any) -> None:
    """Refuse what is not a pair of numbers with a ValueError."""
    pair = isinstance(given, Sequence | np.ndarray) and len(given) == 2
    if not pair or not all(isinstance(f, Real) for f in given):
        raise ValueError(f"band is {given}; give two numbers, the lowest and the highest in Hz.")


def number(name: str, value: Any, *, positive: bool = False) -> None:
    """Refuse what is not a real number of at least (``positive``: above) 0 with a ValueError."""
    wanted = "a positive number" if positive else "a number of at least 0"
    real = isinstance(value, Real) and not isinstance(value, bool) and float(value) < math.inf
    if not real or not (float(value) > 0 if positive else float(value) >= 0):
        raise ValueError(f"{name} is {value!r}; give {wanted}.")
