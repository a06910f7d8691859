"""A linear model as a system of python-control."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from lfrtorch._support.optional import imported
from lfrtorch.data.records import Channel


def control_system(model: Any) -> Any:
    """Return the deviations of a linear model from its operating point as ``control.StateSpace``.

    Dots in channel names, which that package does not allow, become underscores. If two names
    become the same, the second one gets another underscore.

    Raises:
        ValueError: the package ``control`` is not installed.
    """
    labels = {side: control_labels(getattr(model, side)) for side in ("inputs", "outputs")}
    system = imported("control", "control").ss
    return system(model.A, model.B, model.C, model.D, 1.0 / model.fs, **labels)


def control_labels(channels: Sequence[Channel]) -> list[str]:
    """Make labels for python-control from channel names: without dots, and all different."""
    labels: list[str] = []
    for channel in channels:
        label = channel.name.replace(".", "_")
        while label in labels:
            label += "_"
        labels.append(label)
    return labels
