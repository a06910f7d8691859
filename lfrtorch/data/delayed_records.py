"""Records of delayed inputs: each input as it acts, whole samples after it was applied."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array
from lfrtorch.data.records import Record

Delay = tuple[int, ...]
"""Whole samples by which each input acts later."""


def delayed_records(records: Sequence[Record], delay: Delay, level: Array) -> list[Record]:
    """Records with their inputs as they act; unknown first inputs are cut off with their outputs.

    Args:
        records: the records.
        delay: whole samples of each input.
        level: inputs before a record that begins at rest, (nu,).
    """
    found, longest = [], max(delay, default=0)
    for record in records:
        later = record.delayed(delay, level)
        if longest and record.start in ("estimated", "measured"):
            if record.samples <= longest + 1:
                raise InputError(
                    f"record '{record.name}' has {record.samples} samples, and the delay is "
                    f"{longest}; give longer records or a smaller delay."
                )
            skip = max(record.skip - longest, int(record.start == "measured" and record.skip > 0))
            later = replace(later, valid=record.valid).part(
                slice(longest, None), start=record.start, skip=skip, period=None
            )
        found.append(later)
    return found


def resting_level(records: Sequence[Record], delay: Delay) -> Array:
    """Mean of each input (nu,) over the samples that act within the records."""
    columns = []
    for j, d in enumerate(delay):
        acting = [r.u[: r.samples - d if r.start == "zero" else None, j] for r in records]
        columns.append(np.concatenate(acting).mean())
    return np.array(columns)
