"""Figures of a result: they read signals and histories and compute no model.

``simulated`` has outputs (T, ny) in physical units by the names of models; ``outputs`` are the
numbers of those that are drawn, by default of all.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from lfrtorch._support.atomic import whole_file
from lfrtorch._support.drawing import (
    CHANNELS,
    LINEAR,
    NL_LFR,
    OUTPUT,
    legend_above,
    panels,
    plain_ticks,
    reference,
    unit_axis,
)
from lfrtorch._support.tables import engineering, factor_of, quantity
from lfrtorch._support.types import Array
from lfrtorch.analysis.confidence_bands import Band
from lfrtorch.analysis.densities import power_density
from lfrtorch.data.metrics import rms
from lfrtorch.data.records import Record
from lfrtorch.fitting.trainer import Progress

_DPI = 150  # resolution of figures in files
_MOST_POINTS = 20_000  # a longer signal is drawn with so many points
_FAR = 10.0  # errors beyond so many standard deviations of the output are left out
_TAIL = 0.95  # part of the samples with errors up to the number in the legend
_BEYOND = 1.0  # if a model runs away, axes end at so many ranges of the output beyond it

Simulated = Mapping[str, Array]
"""Outputs by the name of their model; names of linear models begin with ``linear``."""

COLOURS = tuple(colour for colour in CHANNELS if colour != LINEAR)
"""Colours of the nonlinear models; a figure has at most so many of them."""

_HEIGHT = 4.2  # height of the panels of an output, in inches
_INPUTS, _MOST_INPUTS = 1.6, 5  # height of the inputs' panel, and how many are drawn at most
_WIDE, _NARROW = 6.4, 4.4  # widths of figures that stand side by side on a wide page


def is_whole(record: Record) -> bool:
    """Tell if the scored samples are whole periods in steady state, without leakage."""
    return record.start == "periodic" and not record.skip


def spectrum(record: Record, simulated: Simulated, outputs: Sequence[int] | None = None) -> Figure:
    """Draw magnitudes of the measured output and of the errors, a panel for each output."""
    figure, axes = _panels(record, outputs)
    y = record.y[record.skip :]
    f = np.fft.rfftfreq(len(y), 1.0 / record.fs)
    for i, ax in axes.items():
        for signal, label, colour, _ in _signals(record, simulated, i):
            ax.plot(f[1:-1], _decibel(signal)[1:-1], ".", ms=2, color=colour, label=label)
        output = record.outputs[i]
        ax.set(ylabel=f"{output.name} (dB{reference(output.unit)})", xlim=(0, f[-1]))
        legend_above(ax, markerscale=5)
    _frequency_axis(record, figure.axes[-1])
    return figure


def density(record: Record, simulated: Simulated, outputs: Sequence[int] | None = None) -> Figure:
    """Draw spectral densities of output and errors by Welch's method, if periods are not whole."""
    figure, axes = _panels(record, outputs)
    for i, ax in axes.items():
        for signal, label, colour, style in _signals(record, simulated, i):
            f, power = power_density(signal[:, None], record.fs)
            level = 10.0 * np.log10(np.maximum(power[:, 0], np.finfo(float).tiny))
            ax.plot(f[1:], level[1:], style, color=colour, label=label)
        output = record.outputs[i]
        per = f"{factor_of(output.unit)}²{'/Hz' * (record.fs != 1.0)}" if output.unit else ""
        ax.set(ylabel=f"{output.name} (dB{reference(per)})", xscale="log")
        ax.margins(x=0)
        legend_above(ax)
    _frequency_axis(record, figure.axes[-1])
    return figure


def response(record: Record, simulated: Simulated, outputs: Sequence[int] | None = None) -> Figure:
    """Draw outputs and errors over time; the stretch of the close-up is grey."""
    whole = slice(0, record.samples - record.skip)
    figure = _overlay(record, simulated, outputs, whole, _WIDE, fits=True)
    near = _worst_stretch(record, simulated, outputs)
    if near != whole:
        ends = ((record.skip + end) / record.fs for end in (near.start, near.stop - 1))
        first, last = ends
        for ax in figure.axes:
            ax.axvspan(first, last, color="0.9", lw=0, zorder=0)
    return figure


def close_up(
    record: Record,
    simulated: Simulated,
    outputs: Sequence[int] | None = None,
    *,
    band: Band | None = None,
) -> Figure:
    """Draw the response near the largest error of the first nonlinear model."""
    near = _worst_stretch(record, simulated, outputs)
    figure = _overlay(record, simulated, outputs, near, _NARROW, band=band)
    figure.suptitle(f"{record.name}: about the largest error", fontsize="medium")
    return figure


def _worst_stretch(
    record: Record, simulated: Simulated, outputs: Sequence[int] | None = None
) -> slice:
    """Some periods of the output near the largest error, counted from the first scored sample."""
    # Errors are those of the first nonlinear model, over the standard deviation of each output. If
    # this model runs away, the stretch is where that begins.
    columns = list(range(record.y.shape[1]) if outputs is None else outputs)
    y = record.y[record.skip :, columns]
    first = next((name for name in simulated if not _is_linear(name)), next(iter(simulated)))
    found = simulated[first][record.skip :, columns]
    deviation = np.std(y, axis=0)
    error = np.abs(y - found) / np.where(deviation > 0, deviation, 1.0)
    error = np.minimum(np.where(np.isfinite(error), error, np.inf), _FAR)
    row, column = np.unravel_index(int(np.argmax(error)), error.shape)
    above = y[:, column] > np.mean(y[:, column])
    swings = max(1, np.count_nonzero(above[1:] != above[:-1])) / 2
    least, most = (50, 2000)
    # The stretch has eight periods, but at most a quarter of a longer record.
    length = min(8 * len(y) / swings, most, 0.25 * len(y))
    length = min(len(y), max(least, int(length)))
    begin = max(0, min(int(row) - length // 2, len(y) - length))
    return slice(begin, begin + length)


def distribution(
    record: Record, simulated: Simulated, outputs: Sequence[int] | None = None
) -> Figure:
    """Draw densities of the errors; the legend gives the range of 95 % of the samples."""
    figure, axes = _panels(record, outputs, _NARROW, sharex=False)
    figure.suptitle(f"{record.name}: errors", fontsize="medium")
    for i, ax in axes.items():
        output = record.outputs[i]
        y = record.y[record.skip :, i]
        for error, name, colour, style in _signals(record, simulated, i)[1:]:
            label = name
            counted = error[np.abs(error) <= (_FAR * np.std(y) or np.inf)]
            if np.isfinite(error).all():
                within = float(np.quantile(np.abs(error), _TAIL))
                label = f"{name}: {100 * _TAIL:g} % within ±{quantity(within, output.unit)}"
            if not len(counted):
                ax.plot([], [], color=colour, label=label)
                continue
            counts, edges = np.histogram(counted, bins=min(80, max(10, len(counted) // 20)))
            share = counts / (len(error) * np.diff(edges))
            ax.stairs(share, edges, color=colour, ls=style, lw=1.2, label=label)
            ax.stairs(share, edges, color=colour, fill=True, alpha=0.15)
        ax.set(yscale="log", ylabel="density, logarithmic", yticks=[])
        ax.yaxis.set_minor_locator(NullLocator())
        unit_axis(ax.xaxis, ax.get_xlim(), f"error of {output.name}", output.unit)
        legend_above(ax, ncols=1)
    return figure


def convergence(history: Sequence[Progress], chosen: int, unit: str = "") -> Figure:
    """Draw training and validation errors over the iterations, with a mark at the kept iterate."""
    figure, ((ax,),) = panels((7, 4))
    iterations = [p.iteration for p in history]
    train, validation = np.array([(p.train, p.validation) for p in history]).T
    factor, unit = engineering(train, unit)
    ax.semilogy(iterations, factor * train, "--", color=OUTPUT, label="training")
    if np.isfinite(validation).any():
        ax.semilogy(iterations, factor * validation, color=NL_LFR, label="validation")
    plain_ticks(ax.yaxis)
    ax.axvline(chosen, color="0.6", ls=":", label=f"kept: iteration {chosen}")
    ax.set(xlabel="iteration", ylabel=f"simulation RMSE{f' ({unit})' if unit else ''}")
    ax.grid(True, which="both", alpha=0.2)
    ax.legend()
    return figure


def png(figure: Figure) -> bytes:
    """The figure as a PNG file."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=_DPI)
    return stream.getvalue()


def save(figures: Mapping[str, Figure], folder: Path) -> dict[str, bytes]:
    """Write figures by name as PNG files into a folder, and return the files' contents."""
    images = {name: png(figure) for name, figure in figures.items()}
    for name, image in images.items():
        with whole_file(folder / f"{name}.png") as fresh:
            fresh.write_bytes(image)
    return images


def _panels(
    record: Record, outputs: Sequence[int] | None, width: float = _WIDE, *, sharex: bool = True
) -> tuple[Figure, dict[int, Axes]]:
    """A panel for each output, by its number."""
    numbers = list(range(record.y.shape[1]) if outputs is None else outputs)
    figure, axes = panels((width, _HEIGHT * len(numbers)), len(numbers), sharex=sharex)
    figure.suptitle(f"{record.name} ({record.source})", fontsize="medium")
    return figure, dict(zip(numbers, axes[:, 0], strict=True))


def _overlay(
    record: Record,
    simulated: Simulated,
    outputs: Sequence[int] | None,
    part: slice,
    width: float,
    *,
    fits: bool = False,
    band: Band | None = None,
) -> Figure:
    """Measured and simulated outputs of a part of the scored samples, and the errors below."""
    # With ``fits``, the inputs are drawn above, as the outputs respond to them.
    numbers = list(range(record.y.shape[1]) if outputs is None else outputs)
    height = _HEIGHT * len(numbers) + _INPUTS * fits
    ratios = [1] * fits + [2, 1] * len(numbers)
    figure = Figure(figsize=(width, height), layout="constrained")
    grid = figure.add_gridspec(len(ratios), 1, height_ratios=ratios)
    axes: list[Axes] = []
    for row in range(fits, len(ratios)):
        axes.append(figure.add_subplot(grid[row], sharex=axes[0] if axes else None))
    scored = slice(record.skip, None)
    t = (record.skip + np.arange(record.samples - record.skip)[part]) / record.fs
    for k, i in enumerate(numbers):
        above, below = axes[2 * k : 2 * k + 2]
        y, output = record.y[scored, i], record.outputs[i]
        above.plot(*envelope(t, y[part]), lw=1.6, color=OUTPUT, label="measured")
        reach = 0.0
        for name, colour, style in _drawn(simulated):
            own = simulated[name][scored, i]
            label = f"{name}, {_fit_text(y, own)}" if fits else name
            above.plot(*envelope(t, own[part]), style, lw=1.0, color=colour, label=label)
            error = (y - own)[part]
            below.plot(*envelope(t, error), style, lw=1.0, color=colour, label=name)
            reach = max(reach, np.max(np.abs(error), initial=0.0, where=np.isfinite(error)))
        if band is not None:
            low, high = ((edge - band.y)[scored, i][part] for edge in band.interval(noise=True))
            below.fill_between(t, low, high, color=NL_LFR, alpha=0.2, lw=0, label="95 % band")
        span = float(np.ptp(y)) or 1.0
        low, high = above.get_ylim()
        low, high = max(low, y.min() - _BEYOND * span), min(high, y.max() + _BEYOND * span)
        unit_axis(above.yaxis, (low, high), output.name, output.unit)
        reach = 1.1 * min(reach, _BEYOND * span) or span
        unit_axis(below.yaxis, (-reach, reach), "error", output.unit)
        for ax in (above, below):
            ax.margins(x=0)
            ax.grid(True, alpha=0.2)
        legend_above(above)
    if fits:
        above = figure.add_subplot(grid[0], sharex=axes[0])
        for i, channel in enumerate(record.inputs[:_MOST_INPUTS]):
            above.plot(*envelope(t, record.u[scored, i][part]), lw=0.8, label=str(channel))
        above.set_ylabel("input")
        above.grid(True, alpha=0.2)
        legend_above(above)
        axes.insert(0, above)
    for ax in axes[:-1]:
        ax.tick_params(labelbottom=False)
    figure.align_ylabels(axes)
    figure.suptitle(f"{record.name} ({record.source})", fontsize="medium")
    axes[-1].set_xlabel("time in the record (s)" if record.fs != 1.0 else "sample of the record")
    return figure


def _fit_text(y: Array, y_hat: Array) -> str:
    """Fit of a simulation to one output: 100 % - NRMSE, to two digits of the NRMSE."""
    missing = 100 * float(rms(y - y_hat)) / (float(np.std(y)) or np.nan)
    if not np.isfinite(missing):
        return "diverges" if not np.isfinite(y_hat).all() else "no fit: constant"
    if missing >= 1e3:
        return "fit below -900 %"
    digits = 1 - int(f"{missing:.1e}".split("e")[1])  # of the rounded value
    return f"fit {100 - missing:.{min(max(digits, 1), 6)}f} %"


def _signals(record: Record, simulated: Simulated, i: int) -> list[tuple[Array, str, str, str]]:
    """Output, errors, label, colour and style of each model; only a label if it diverges."""
    y = record.y[record.skip :, i]
    signals = [(y, "output", OUTPUT, "-")]
    for name, colour, style in _drawn(simulated):
        error, label = y - simulated[name][record.skip :, i], f"{name} error"
        if not np.isfinite(error).all():
            error, label = np.full_like(y, np.nan), f"{name} diverges"
        signals.append((error, label, colour, style))
    return signals


def _is_linear(name: str) -> bool:
    return name.startswith("linear")


def _drawn(simulated: Simulated) -> list[tuple[str, str, str]]:
    """Name, colour and style of each model."""
    others = iter(COLOURS)
    return [
        (name, LINEAR, "--") if _is_linear(name) else (name, next(others), "-")
        for name in simulated
    ]


def envelope(t: Array, signal: Array) -> tuple[Array, Array]:
    """The smallest and largest samples of many short stretches of a long signal."""
    stretch = len(signal) // (_MOST_POINTS // 2)
    if stretch < 2:
        return t, signal
    pieces = signal[: len(signal) // stretch * stretch].reshape(-1, stretch)
    ends = np.column_stack([pieces.min(axis=1), pieces.max(axis=1)])
    return np.repeat(t[::stretch][: len(pieces)], 2), ends.ravel()


def _frequency_axis(record: Record, ax: Axes) -> None:
    ax.set_xlabel("frequency (Hz)" if record.fs != 1.0 else "frequency (1/sample)")


def _decibel(signal: Array) -> Array:
    """Amplitude of each line of a real signal in dB; finite for a line of exactly 0."""
    amplitude = np.abs(np.fft.rfft(signal)) * 2.0 / len(signal)
    return 20.0 * np.log10(np.maximum(amplitude, np.finfo(float).tiny))
