"""Whether a model stays stable on louder inputs than those of its data."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lfrtorch.model import Model
from lfrtorch.records import Record

LOUDER = (1.25, 1.5, 2.0)
"""Amplitudes, over those of the data, that a model is tried at."""

RUNAWAY = 100.0
"""Output, over the rms in the data, of a model that diverges."""


def loudest(model: Model, records: Sequence[Record]) -> float:
    """How many times as loud as in the data the input may be before the model diverges.

    A simulation of finite data says nothing of others: a static map that was fitted where it is
    bounded may feed back more than it did.

    Args:
        model: what is simulated, from rest.
        records: the data; the deviations of their inputs from the model's operating point are
            multiplied.

    Returns:
        The largest of ``LOUDER`` at which no output runs away, 1 where none is.
    """
    offset, scale = model.scaler.u_offset, model.scaler.y_scale
    found = 1.0
    for factor in LOUDER:
        for record in records:
            y = model.simulate(offset + factor * (record.u - offset))
            far = np.abs((y - model.scaler.y_offset) / scale)
            if not (far < RUNAWAY * factor).all():  # NaN counts
                return found
        found = factor
    return found
