"""A linear system in a few lines of text: its poles and its gains at rest."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import zip_longest
from typing import Any

import numpy as np

from lfrtorch._support.roots import beyond, frequency_and_damping
from lfrtorch._support.tables import Cell, factor_of, number, radius, table
from lfrtorch._support.types import Array
from lfrtorch.data.records import Channel
from lfrtorch.engine.operating_point import StateSpace

_MOST_POLES = 6
"""Largest number of rows in the table of poles; the poles of the largest radius are shown."""

_MOST_GAINS = 4
"""Largest number of rows in the table of gains."""

_INTEGRATES = 1e-9
"""Distance from 1 up to which a pole counts as an integrator, without a static gain."""

_ROUNDING = 1e-12
"""An offset below this part of the rms about it counts as a rounding error."""

_LISTED = 4
"""Largest number of inputs, or of outputs, that a line names."""


def listed(channels: Sequence[Channel]) -> str:
    """Names and units of the channels; only the first ones if there are many."""
    more = ["..."] * (len(channels) > _LISTED)
    return ", ".join([*map(str, channels[:_LISTED]), *more])


def levels(channels: Sequence[Channel], offset: Array, scale: Array | None = None) -> str:
    """Offset of each channel and rms about it; only the first channels if there are many."""
    said = []
    for i, channel in enumerate(channels[:_LISTED]):
        value = number(offset[i])
        if scale is not None:
            small = abs(offset[i]) < _ROUNDING * scale[i]
            value = f"{number(0.0 if small else offset[i])} ± {number(scale[i])}"
        said.append(f"{channel.name} {value} {channel.unit}".rstrip())
    return ", ".join(said + ["..."] * (len(channels) > _LISTED))


def delays(channels: Sequence[Channel], delay: Sequence[int]) -> str:
    """Delay of each input in samples; empty if there is none."""
    pairs = zip(channels, delay, strict=True) if any(delay) else ()
    return ", ".join(f"{channel.name} {d} sample{'s' * (d != 1)}" for channel, d in pairs)


def in_columns(facts: Sequence[tuple[str, str | None]]) -> list[str]:
    """Lines of names with their texts; names without a text are left out."""
    width = max(len(name) for name, _ in facts)
    return [f"{name:<{width}}  {text}" for name, text in facts if text]


def linear_text(model: Any) -> str:
    """A linear model in words: its data, its poles and its static gains."""
    fit = model.fit
    facts = [
        ("sampled at", f"{model.fs:g} Hz"),
        ("inputs", levels(model.inputs, model.u_offset)),
        ("outputs", levels(model.outputs, model.y_offset)),
        ("delay", delays(model.inputs, model.delay)),
        ("order", f"{model.nx}"),
        ("outside of the data", model.outside),
        ("fit", fit and f"{fit.criterion} error {number(fit.rmse)} (normalised), {fit.reason}"),
    ]
    system = {"": StateSpace(model.A, model.B, model.C, model.D)}
    lines = system_lines(system, model.fs, model.inputs, model.outputs)
    return "\n".join(["Linear model", *in_columns(facts), *lines])


def system_lines(
    systems: Mapping[str, StateSpace],
    fs: float,
    inputs: Sequence[Channel],
    outputs: Sequence[Channel],
) -> list[str]:
    """Tables of poles and gains at rest, in physical units, of named systems side by side."""
    head, columns, count, fast = [], [], 0, False
    for name, system in systems.items():
        roots = frequency_and_damping(np.linalg.eigvals(system.A).astype(complex), fs)
        count = max(count, len(roots))
        kept = sorted(roots, key=lambda root: -(root["radius"] or 0.0))[:_MOST_POLES]
        fast |= any(map(beyond, kept))
        head += [f"{name}: pole (Hz)" if name else "pole (Hz)", "damping", "radius"]
        columns.append(
            [
                [number(root["frequency"], 4), number(root["damping"], 3), radius(root["radius"])]
                for root in roots
                if root in kept
            ]
        )
    found = zip_longest(*columns, fillvalue=["", "", ""])
    rows = [[text for part in row for text in part] for row in found]
    lines = ["", *table(head, rows).splitlines()]
    remarks = []
    if count > _MOST_POLES:
        remarks.append(f"The {_MOST_POLES} poles of the largest radius; a pair counts once.")
    if fast:
        remarks.append(f"Poles faster than fs / 2 are given as {number(fs / 2, 4)} Hz.")
    lines += [" ".join(remarks)] if remarks else []
    pairs = [(i, j) for i in range(len(outputs)) for j in range(len(inputs))]
    units = [_unit(outputs[i].unit, inputs[j].unit) for i, j in pairs[:_MOST_GAINS]]
    gains = [_gain(system) for system in systems.values()]
    head = ["constant input", *["unit"] * any(units)]
    head += [f"{name}: gain" if name else "gain" for name in systems]
    body: list[list[Cell]] = [
        [
            f"{outputs[i].name} / {inputs[j].name}",
            *[unit] * any(units),
            *(None if gain is None else float(gain[i, j]) for gain in gains),
        ]
        for (i, j), unit in zip(pairs, units, strict=False)
    ]
    lines += ["", *table(head, body).splitlines()]
    if len(pairs) > _MOST_GAINS:
        lines.append(f"The first {_MOST_GAINS} of {len(pairs)} gains.")
    return lines


def _gain(system: StateSpace) -> Array | None:
    """C (I - A)⁻¹ B + D; None if the system integrates."""
    A, B, C, D = system
    if (np.abs(np.linalg.eigvals(A) - 1.0) < _INTEGRATES).any():
        return None
    return C @ np.linalg.solve(np.eye(len(A)) - A, B) + D


def _unit(output: str, source: str) -> str:
    if not (output or source):
        return ""
    return f"{factor_of(output) or '1'}/{factor_of(source)}" if source else output
