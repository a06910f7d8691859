"""Whether a model stays stable on louder inputs than those of its data."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lfrtorch.model import Model
from lfrtorch.records import Record

LOUDER = (1.25, 1.5, 2.0)
"""Amplitudes at which a model is tried, relative to those of the data."""

_RUNAWAY = 100.0
"""A model diverges if its output exceeds this many times the rms in the data."""


def largest_stable_amplitude(model: Model, records: Sequence[Record]) -> float:
    """How many times as loud as in the data the input may be before the model diverges.

    A model that is stable on its data may be unstable on others: beyond the amplitudes that it was
    fitted at, its static nonlinearity may feed back more.

    Args:
        model: what is simulated, from rest.
        records: the data; the deviations of their inputs from the model's operating point are
            multiplied.

    Returns:
        The largest of ``LOUDER`` up to which no output diverges; 1 if there is none.

    Example:
        >>> from lfrtorch.analysis.amplitude_margin import largest_stable_amplitude
        >>> largest_stable_amplitude(model, [record])
        2.0
    """
    offset, scale = model.scaler.u_offset, model.scaler.y_scale
    found = 1.0
    for factor in LOUDER:
        for record in records:
            y = model.simulate(offset + factor * (record.u - offset))
            far = np.abs((y - model.scaler.y_offset) / scale)
            if not (far < _RUNAWAY * factor).all():  # NaN counts
                return found
        found = factor
    return found
