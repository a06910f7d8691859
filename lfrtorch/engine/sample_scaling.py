"""Scaling of one sample in machine code: a call of NumPy takes as long as a small model's step."""

from __future__ import annotations

import math

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def normalise(given, offset, scale, out):
    """Write (given - offset) / scale into out; returns whether all given is finite."""
    finite = True
    for i in range(len(out)):
        finite = finite and math.isfinite(given[i])
        out[i] = (given[i] - offset[i]) / scale[i]
    return finite


@njit(cache=True, nogil=True, error_model="numpy")
def innovation(given, offset, scale, predicted, out, e):
    """The same, with e = out - predicted; returns whether none is infinite: NaN is missing."""
    normalise(given, offset, scale, out)
    known = True
    for i in range(len(out)):
        known = known and not math.isinf(given[i])
        e[i] = out[i] - predicted[i]
    return known


@njit(cache=True, nogil=True, error_model="numpy")
def restored(normalised, offset, scale):
    """Physical values of normalised ones."""
    found = np.empty(len(scale))
    for i in range(len(scale)):
        found[i] = offset[i] + scale[i] * normalised[i]
    return found
