"""Signals near 1, by powers of two: their products are numbers, and no digit changes."""

from __future__ import annotations

import numpy as np

from lfrtorch._support.types import Array


def near_one(x: Array, axis: int | None = None) -> Array:
    """Divide finite signals by the power of two above their largest value; zeros remain."""
    return np.ldexp(x, -np.frexp(np.max(np.abs(x), axis=axis, keepdims=True, initial=0.0))[1])
