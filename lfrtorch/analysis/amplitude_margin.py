"""Amplitude margin: stability of a model on louder inputs than those of its data."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lfrtorch.data.records import Record
from lfrtorch.model.model import Model

LOUDER = (1.25, 1.5, 2.0)
"""Amplitudes at which a model is tried, relative to those of the data."""


def largest_stable_amplitude(model: Model, records: Sequence[Record]) -> float:
    """Return the largest of 1 and ``LOUDER`` at which no output diverges; 0 if 1 diverges already.

    Beyond the amplitudes that it was fitted at, a model's static nonlinearity may feed back more.
    """
    offset, scale = model.scaler.u_offset, model.scaler.y_scale
    found = 0.0
    for factor in (1.0, *LOUDER):
        for record in records:
            y = model.simulate(offset + factor * (record.u - offset))
            far = np.abs((y - model.scaler.y_offset) / scale)
            if not (far < 100.0 * factor).all():  # it diverges; also if NaN
                return found
        found = factor
    return found
