"""A linear model as a system of python-control."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from lfrtorch._support.optional import imported
from lfrtorch.data.records import Channel


def control_system(model: Any) -> Any:
    """The deviations of a linear model from its operating point as a ``control.StateSpace``.

    Dots in channel names, which that package does not allow, become underscores; of two names that
    are the same then, the second one has one more.

    Raises:
        ValueError: the package ``control`` is not installed.
    """
    labels = {side: control_labels(getattr(model, side)) for side in ("inputs", "outputs")}
    system = imported("control", "control").ss
    return system(model.A, model.B, model.C, model.D, 1.0 / model.fs, **labels)


def control_labels(channels: Sequence[Channel]) -> list[str]:
    """Make labels of python-control from channel names: without dots, and each another one."""
    labels: list[str] = []
    for channel in channels:
        label = channel.name.replace(".", "_")
        while label in labels:
            label += "_"
        labels.append(label)
    return labels
