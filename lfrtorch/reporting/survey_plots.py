"""Figure of a measurement before any fit: signals, amplitudes and spectra."""

from __future__ import annotations

import numpy as np
import scipy
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lfrtorch._support.drawing import CHANNELS, OUTPUT, panels, unit_axis
from lfrtorch._support.types import Array
from lfrtorch.reporting.plots import envelope
from lfrtorch.survey.measurement import Survey
from lfrtorch.survey.signal import LEAST, SignalSurvey, longest_run


def survey_figure(found: Survey, signals: Array, title: str = "") -> Figure:
    """Draw each signal (T, nu + ny) over time, its distribution, and its spectrum with the band."""
    rows = len(found.signals)
    widths = [3.2, 0.8, 2.6]
    figure, grid = panels((13, 1.2 + 2.0 * rows), rows, 3, sharex="col", width_ratios=widths)
    fs = 1.0 if found.fs is None else found.fs
    t = np.arange(len(signals)) / fs
    for one, signal, (time, values, lines) in zip(found.signals, signals.T, grid, strict=True):
        colour = CHANNELS[0] if one in found.inputs else OUTPUT
        time.plot(*envelope(t, signal), lw=0.6, color=colour)
        for end in one.clipped:
            time.axhline(end.value, lw=1.0, ls="--", color=CHANNELS[1])
        time.set_xlim(0, max(t[-1], 1 / fs))
        unit_axis(time.yaxis, time.get_ylim(), one.channel.name, one.channel.unit)
        known = signal[np.isfinite(signal)]
        share = np.full(len(known), 100 / max(len(known), 1))
        values.hist(known, 60, weights=share, orientation="horizontal", color=colour)
        values.set_ylim(time.get_ylim())
        values.tick_params(labelleft=False)
        _spectrum(lines, one, signal, fs, colour)
    clipped = any(one.clipped for one in found.signals)
    heads = (
        f"signal{' (dashed: clipped)' if clipped else ''}",
        "",
        "spectrum (grey: 99 % of the power)",
    )
    for ax, head in zip(grid[0], heads, strict=True):
        ax.set_title(head, fontsize="medium")
    time, values, lines = grid[-1]
    time.set_xlabel("sample" if found.fs is None else "time (s)")
    values.set_xlabel("% of samples")
    lowest = min((one.band[0] for one in found.signals if one.band is not None), default=fs / 100)
    lines.set(xscale="log", xlim=(lowest / 3.0, fs / 2))
    lines.set_xlabel(f"frequency ({'cycles/sample' if found.fs is None else 'Hz'})")
    if title:
        figure.suptitle(title)
    return figure


def _spectrum(ax: Axes, one: SignalSurvey, signal: Array, fs: float, colour: str) -> None:
    """Draw the spectrum in dB of the longest part without gaps, with the signal's band in grey."""
    unit = one.channel.unit
    ax.set_ylabel(f"dB, re 1 {unit}" if unit else "dB")
    ax.grid(True, which="major", alpha=0.2)
    first, length = longest_run(np.isfinite(signal))
    if length < LEAST or one.band is None:
        return
    part = signal[first : first + length]
    f, power = scipy.signal.periodogram(part, fs, window="hann", scaling="spectrum")
    # In each stretch of the axis, the largest line is drawn.
    edges = np.geomspace(f[1], f[-1], 3000)
    starts = np.unique(np.searchsorted(f, edges[edges <= f[-1]]))
    level = 10 * np.log10(np.maximum(2 * np.maximum.reduceat(power, starts), 1e-300))
    ax.plot(f[starts], level, lw=0.6, color=colour)
    ax.axvspan(*one.band, color="0.9", zorder=0, lw=0)
    top = float(level.max())
    ax.set_ylim(max(float(level.min()) - 5, top - 120.0), top + 5)
