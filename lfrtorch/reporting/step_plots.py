"""Responses to steps of several heights: if a model is linear, all have the same shape."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.figure import Figure

from lfrtorch._support.drawing import CHANNELS, LINEAR, legend_above, panels
from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array
from lfrtorch.data.records import Record
from lfrtorch.linear.model import LinearModel
from lfrtorch.model.model import Model

_MOST = 3  # at most so many inputs and outputs are drawn
_HEIGHTS = (-1.0, -0.5, 0.5, 1.0)  # heights, relative to the largest step that is drawn
_SELDOM = 2.0  # per cent of the training inputs are beyond the largest step
_LEFT = 0.02  # part of a step that is left when the response has settled
_DRIFT = 0.15  # change in the last quarter, over the step, of a response that has not settled
_STILL = 1e-3  # part of an output's standard deviation below which the output does not move
_FEWEST, _LONGEST = 20, 10_000  # smallest and largest number of samples of a step


def steps(model: Model, linear: LinearModel, records: list[Record]) -> Figure:
    """Draw the change of each output over the step that an input makes from its mean.

    The input was at its mean until the model was at rest. Heights go to where 2 % of the training
    input lie beyond; lines that differ are the nonlinearity.

    Raises:
        ValueError: the linear model is unstable, or the model does not come to rest at the mean.
    """
    rest = np.mean([record.u.mean(axis=0) for record in records], axis=0)
    settled = _settling(linear, max(record.samples for record in records))
    inputs, outputs = model.inputs[:_MOST], model.outputs[:_MOST]
    size = 1.0 + 4.0 * len(inputs), 0.8 + 2.6 * len(outputs)
    figure, grid = panels(size, len(outputs), len(inputs), sharex=True)
    t = np.arange(settled) / model.fs
    still = _STILL * np.std(np.concatenate([record.y for record in records]), axis=0)
    for j, source in enumerate(inputs):
        every = np.concatenate([record.u[:, j] for record in records]) - rest[j]
        low, high = np.percentile(every, [_SELDOM, 100.0 - _SELDOM])
        heights = [part * (high if part > 0 else -low) for part in _HEIGHTS]
        for height, colour in zip(heights, CHANNELS, strict=False):
            if abs(height) < 1e-9 * max(abs(low), abs(high)) or not height:
                continue
            found = _step(model, rest, j, height, settled, still) / height
            for i in range(len(outputs)):
                label = f"{height:+.3g} {source.unit}".rstrip()
                grid[i, j].plot(t, found[:, i], lw=1.2, color=colour, label=label)
        found = _step(linear, rest, j, 1.0, settled, still)
        for i, output in enumerate(outputs):
            ax = grid[i, j]
            ax.plot(t, found[:, i], "--", lw=1.2, color=LINEAR, label="linear")
            per = "/".join(channel.unit or "1" for channel in (output, source))
            own = f" ({per})" if output.unit or source.unit else ""
            ax.set_ylabel(f"{output.name} per {source.name}{own}")
            ax.grid(True, alpha=0.2)
            ax.margins(x=0)
    for ax in grid[0]:
        legend_above(ax)
    for ax in grid[-1]:
        ax.set_xlabel("time after the step (s)" if model.fs != 1.0 else "samples after the step")
    return figure


def _settling(linear: LinearModel, most: int) -> int:
    """Samples until 2 % of the step are left in the response of the slowest pole."""
    radius = float(np.abs(linear.poles).max(initial=0.0))
    if not radius < 1.0:
        raise InputError("the linear model does not come to rest: it has no step to show.")
    samples = math.log(_LEFT) / math.log(radius) if radius > 0 else 0.0
    return int(min(max(_FEWEST, 1.2 * samples), most, _LONGEST))


def _step(
    model: Model | LinearModel, rest: Array, j: int, height: float, settled: int, still: Array
) -> Array:
    """Change of the outputs (settled, ny) after a step of input j from rest."""
    u = np.tile(rest, (4 * settled, 1))
    u[3 * settled :, j] += height
    y = model.simulate(u)
    change = y[3 * settled :] - y[3 * settled - 1]
    last = settled // 4  # samples before the step, and of the step, in which little moves
    moved = [np.ptp(part[-last:], axis=0) for part in (y[: 3 * settled], change)]
    least = np.maximum(_DRIFT * np.abs(change).max(axis=0), still)
    if not np.isfinite(y).all() or (np.maximum(*moved) > least).any():
        raise InputError("the model does not come to rest at the mean of its inputs.")
    return change
