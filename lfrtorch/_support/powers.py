"""Signals near 1, by powers of two: their products are numbers, and no digit changes."""

from __future__ import annotations

import numpy as np

from lfrtorch._support.types import Array


def near_one(x: Array, axis: int | None = None) -> Array:
    """Signals over the power of two above their largest value; zeros remain.

    Args:
        x: the signals, of finite values.
        axis: along which a signal runs. Default: one signal.

    Example:
        >>> from lfrtorch._support.powers import near_one
        >>> near_one(np.array([3e200, -6e200])).round(3).tolist()
        [0.49, -0.98]
    """
    return np.ldexp(x, -np.frexp(np.max(np.abs(x), axis=axis, keepdims=True, initial=0.0))[1])
