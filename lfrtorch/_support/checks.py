"""Checks of arguments: the right type and size, or an error that names the argument."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from numbers import Integral, Real
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array, Integers


def integer(name: str, value: Any, least: int, *, word: str = "") -> None:
    """Refuse all but a whole number of at least ``least``, or a word, with a ValueError."""
    if word and isinstance(value, str) and value == word:
        return
    whole = isinstance(value, Integral) and not isinstance(value, bool)
    if whole and abs(int(value)) > sys.maxsize:
        raise InputError(f"{name} has more than 64 bits; give a smaller whole number.")
    if not whole or int(value) < least:
        other = f", or {word}" if word else ""
        raise InputError(f"{name} is {value!r}; give a whole number of at least {least}{other}.")


def true_or_false(name: str, value: Any) -> None:
    """Refuse all but True and False with a ValueError."""
    if not isinstance(value, bool):
        raise InputError(f"{name} is {value!r}; give True or False.")


def band(given: Any) -> None:
    """Refuse all but a pair of numbers with a ValueError."""
    pair = isinstance(given, Sequence | np.ndarray) and len(given) == 2
    if not pair or not all(isinstance(f, Real) for f in given):
        raise InputError(f"band is {given}; give two numbers, the lowest and the highest in Hz.")


def reals(name: str, given: ArrayLike) -> Array:
    """Real numbers of any shape, NaN where they are masked; refuse all else with a ValueError."""
    values: Any = given
    try:
        if hasattr(values, "detach"):  # a tensor, maybe one with a gradient or on a device
            values = values.detach().cpu()
        elif isinstance(values, list | tuple) and any(map(np.ma.is_masked, values)):
            values = np.ma.stack(values)
        array = np.asarray(values)
    except (RuntimeError, TypeError, ValueError) as error:
        reason = str(error).split(". ")[0].split("\n")[0].rstrip(".")
        raise InputError(f"{name} is no array of real numbers ({reason}).") from None
    if array.dtype.kind not in "biuf":
        raise InputError(f"{name} has type {array.dtype}; give real numbers.")
    array = array.astype(np.float64, copy=False)
    return np.where(np.ma.getmask(values), np.nan, array) if np.ma.is_masked(values) else array


def dft_lines(given: ArrayLike, samples: int) -> Integers:
    """DFT lines, rising; refuse all but whole numbers between 0 and samples / 2."""
    found, last = np.asarray(given), (samples - 1) // 2
    if found.ndim != 1 or found.size == 0 or found.dtype.kind not in "iu":
        raise InputError(f"lines is {given}; give a list of whole numbers, one a line.")
    if found.min() < 1 or found.max() > last:
        raise InputError(
            f"the lines go from {found.min()} to {found.max()}; {samples} samples have lines 1 to "
            f"{last} between 0 and fs / 2: use these, or a longer period."
        )
    return np.unique(found).astype(np.int64)


def number(name: str, value: Any, *, positive: bool = False, most: float | None = None) -> None:
    """Refuse all but a real number of at least (``positive``: above) 0 with a ValueError."""
    wanted = "a positive number" if positive else "a number of at least 0"
    wanted += "" if most is None else f", {most} at most"
    real = isinstance(value, Real) and not isinstance(value, bool) and float(value) < math.inf
    small = not real or not (float(value) > 0 if positive else float(value) >= 0)
    if small or (most is not None and float(value) > most):
        raise InputError(f"{name} is {value!r}; give {wanted}.")
