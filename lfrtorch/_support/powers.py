"""Scale signals by powers of two: exact, and products cannot overflow."""

from __future__ import annotations

import numpy as np

from lfrtorch._support.types import Array


def near_one(x: Array, axis: int | None = None) -> Array:
    """Divide finite signals by the power of two above their largest value; zeros stay."""
    return np.ldexp(x, -np.frexp(np.max(np.abs(x), axis=axis, keepdims=True, initial=0.0))[1])
