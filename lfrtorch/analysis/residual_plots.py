"""Figure of residuals: correlations with their bounds, and spectra."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lfrtorch._support.drawing import CHANNELS, NL_LFR, OUTPUT
from lfrtorch._support.tables import factor_of
from lfrtorch.analysis.correlation import Correlation
from lfrtorch.analysis.output_residuals import OutputResiduals


def residual_figure(parts: Sequence[OutputResiduals]) -> Figure:
    """Correlations and spectra of the first four outputs of one record, a row each.

    The grey bands hold 99 % of the correlations of errors that depend on nothing.
    """
    parts = parts[:4]
    figure = Figure(figsize=(11.0, 2.8 * len(parts) + 0.6), layout="constrained")
    grid = figure.subplots(len(parts), 4, squeeze=False)
    for part, (past, linear, squares, spectra) in zip(parts, grid, strict=True):
        names = [channel.name for channel in part.inputs]
        _correlations(past, [part.whiteness], [""])
        _correlations(linear, part.linear, names if len(names) > 1 else [""])
        squared = [f"e, {name}²" for name in names] + [f"e y, {name}²" for name in names]
        _correlations(squares, [*part.even, *part.odd], squared)
        past.set(ylabel=f"{part.output.name}: correlation")
        _spectra(spectra, part)
    titles = (
        "errors with themselves",
        "errors with the inputs",
        "with squares of the inputs",
        "power density",
    )
    for ax, title in zip(grid[0], titles, strict=True):
        ax.set_title(title, fontsize="medium")
    for ax in grid[-1, :3]:
        ax.set_xlabel("lag (samples)")
    figure.suptitle(f"{parts[0].record}: residuals", fontsize="medium")
    return figure


def _correlations(ax: Axes, found: Sequence[Correlation], labels: Sequence[str]) -> None:
    """Draw correlations against lag, each in its colour, and the widest bound at each lag."""
    lags, bounds = found[0].lags, np.max([c.bounds for c in found], axis=0)
    ax.fill_between(lags, -bounds, bounds, color="0.88", lw=0, zorder=0)
    ax.axhline(0.0, color="0.6", lw=0.6, zorder=1)
    apart = 0.6 / len(found)
    reach = max(float(bounds.max(initial=0.0)), *(np.abs(c.values).max() for c in found))
    for k, (c, label) in enumerate(zip(found, labels, strict=True)):
        at = c.lags + apart * (k - (len(found) - 1) / 2)
        colour = CHANNELS[k % len(CHANNELS)]
        ax.vlines(at, 0.0, c.values, color=colour, lw=0.9)
        ax.plot(at, c.values, ".", ms=3.5, color=colour, label=label or None)
    reach = 1.15 * reach or 1.0
    ax.set(xlim=(lags[0] - 1, lags[-1] + 1), ylim=(-reach, reach))
    if any(labels):
        _legend(ax, markerscale=2.0)


def _spectra(ax: Axes, part: OutputResiduals) -> None:
    """Densities of output, error and noise in dB."""
    densities = part.densities
    f = densities.frequencies
    lines = [(f, densities.output, "output", OUTPUT), (f, densities.error, "error", NL_LFR)]
    if densities.noise is not None and densities.noise_frequencies is not None:
        lines.append((densities.noise_frequencies, densities.noise, "noise", "#cc79a7"))
    for at, density, label, colour in lines:
        shown = np.where(np.isfinite(density) & (density > 0), density, np.nan)
        level = 10.0 * np.log10(shown)
        ax.plot(at[at > 0], level[at > 0], color=colour, lw=1.0, label=label)
    hertz = f[-1] != 0.5  # a record without a rate is sampled at 1
    unit = f" {factor_of(part.output.unit)}²" if part.output.unit else ""
    ax.set(
        xlabel="frequency (Hz)" if hertz else "frequency (1/sample)",
        ylabel=f"dB, re 1{unit}{'/Hz' if hertz else ''}",
        xlim=(0.0, f[-1]),
    )
    _legend(ax)


def _legend(ax: Axes, markerscale: float = 1.0) -> None:
    legend = ax.legend(
        loc="upper right", fontsize="x-small", framealpha=0.7, edgecolor="none",
        borderaxespad=0.2, labelspacing=0.2, handlelength=1.2, markerscale=markerscale,
    )  # fmt: skip
    legend.set_zorder(0.5)
