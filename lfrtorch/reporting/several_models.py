"""One record, simulated by several models."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lfrtorch._support.drawing import CHANNELS, LINEAR, OUTPUT, legend_above, unit_axis
from lfrtorch._support.tables import factor_of
from lfrtorch._support.types import Array
from lfrtorch.analysis.densities import power_density
from lfrtorch.records import Record
from lfrtorch.reporting.plots import BEYOND, fit_text, worst_stretch

COLOURS = tuple(colour for colour in CHANNELS if colour != LINEAR)
"""Of the models; there are no more of them in a figure."""

SIZE = (11.0, 3.6)
"""Width of the figure, and height of an output in it, in inches."""

LONGEST = 40
"""Characters of a setting in a figure."""


def short(label: str) -> str:
    """A setting as a figure has room for it, its beginning and its end.

    Example:
        >>> from lfrtorch.reporting import several_models
        >>> several_models.short("trainer.max_iter=100 trainer.tolerance=1e-9 nn=5")
        'trainer.max_iter=100….tolerance=1e-9 nn=5'
    """
    half = LONGEST // 2
    return label if len(label) <= LONGEST else f"{label[:half]}…{label[-half:]}"


def side_by_side(
    record: Record, simulated: Mapping[str, Array], linear: Mapping[str, Array] | None = None
) -> Figure:
    """Each output about the largest error of the first model, and power spectral densities of the
    errors. The legend has the fit of each model to all scored samples, 100 % - NRMSE.

    Args:
        record: the measurement.
        simulated: outputs in physical units, by the names of their models. Five are drawn.
        linear: the same of linear models.

    Shape:
        simulated, linear: (T, ny) each.

    Example:
        >>> from lfrtorch.reporting import several_models
        >>> simulated = {"4 neurons": model.simulate(record), "damped": 0.9 * record.y}
        >>> linear = {"linear": bla.simulate(record)}
        >>> figure = several_models.side_by_side(record, simulated, linear)
        >>> [line.get_label() for line in figure.axes[1].lines]
        ['output', 'linear', '4 neurons', 'damped']
    """
    models = [(name, y, LINEAR, "--") for name, y in (linear or {}).items()]
    models += [
        (name, y, colour, "-")
        for (name, y), colour in zip(simulated.items(), COLOURS, strict=False)
    ]
    ny = len(record.outputs)
    figure = Figure(figsize=(SIZE[0], SIZE[1] * ny), layout="constrained")
    axes = figure.subplots(ny, 2, squeeze=False, sharex="col", width_ratios=[3, 2])
    near = worst_stretch(record, next(iter(simulated.values())))
    for i, (in_time, spectrum) in enumerate(axes):
        _in_time(in_time, record, models, i, near)
        _spectrum(spectrum, record, models, i)
    sampled = record.fs != 1.0
    axes[-1, 0].set_xlabel("time in the record (s)" if sampled else "sample of the record")
    axes[-1, 1].set_xlabel("frequency (Hz)" if sampled else "frequency (1/sample)")
    figure.suptitle(f"{record.name} ({record.source})", fontsize="medium")
    return figure


_Model = tuple[str, Array, str, str]
"""Name, simulated outputs, colour and style."""


def _in_time(ax: Axes, record: Record, models: list[_Model], i: int, near: slice) -> None:
    """An output and its simulations in a part of the scored samples."""
    y, output = record.y[record.skip :, i], record.outputs[i]
    t = (record.skip + np.arange(len(y))[near]) / record.fs
    ax.plot(t, y[near], lw=1.6, color=OUTPUT, label="measured")
    for name, simulated, colour, style in models:
        own = simulated[record.skip :, i]
        ax.plot(
            t, own[near], style, lw=1.0, color=colour, label=f"{short(name)}, {fit_text(y, own)}"
        )
    span = float(np.ptp(y)) or 1.0
    low, high = ax.get_ylim()
    limits = max(low, y.min() - BEYOND * span), min(high, y.max() + BEYOND * span)
    unit_axis(ax.yaxis, limits, output.name, output.unit)
    ax.margins(x=0)
    ax.grid(True, alpha=0.2)
    legend_above(ax, ncols=2)


def _spectrum(ax: Axes, record: Record, models: list[_Model], i: int) -> None:
    """Power spectral densities of an output and of the errors; none of a model that diverges."""
    y, unit = record.y[record.skip :, i], factor_of(record.outputs[i].unit or "1")
    errors = [
        (name, y - own[record.skip :, i], colour, style) for name, own, colour, style in models
    ]
    for name, signal, colour, style in [("output", y, OUTPUT, "-"), *errors]:
        if not np.isfinite(signal).all():
            continue
        f, power = power_density(signal[:, None], record.fs)
        level = 10.0 * np.log10(np.maximum(power[1:, 0], np.finfo(float).tiny))
        ax.plot(f[1:], level, style, lw=1.0, color=colour, label=short(name))
    per = f"{unit}²/Hz" if record.fs != 1.0 else f"{unit}²"
    ax.set(ylabel=f"output and errors (dB, re 1 {per})", xlim=(0, record.fs / 2))
    ax.grid(True, alpha=0.2)
