"""Common parts of all figures: colours, axes in units, legends."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter
from numpy.typing import ArrayLike, NDArray

from lfrtorch._support.tables import engineering, factor_of
from lfrtorch._support.types import Array

# Okabe and Ito's palette: its colours differ in lightness, so that colour-blind readers see them.

OUTPUT = "0.15"
"""Colour of the measured output."""

LINEAR = "#e69f00"
"""Colour of the linear model."""

NL_LFR = "#0072b2"
"""Colour of the NL-LFR."""

CHANNELS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
"""Colours of several channels."""

_LOG_DECADES = 1.5  # smallest width of a band for a logarithmic frequency axis


def panels(
    size: tuple[float, float],
    rows: int = 1,
    columns: int = 1,
    *,
    layout: Literal["constrained", "compressed"] = "constrained",
    **of: Any,
) -> tuple[Figure, NDArray[np.object_]]:
    """A figure of a size in inches, and its axes by row and column; ``of`` is for the grid."""
    figure = Figure(figsize=size, layout=layout)
    return figure, figure.subplots(rows, columns, squeeze=False, **of)


def unit_axis(axis: Axis, limits: tuple[float, float], name: str, unit: str) -> None:
    """Set limits and label of an axis, and ticks in the unit with an SI prefix."""
    low, high = limits
    largest = max(abs(low), abs(high))
    factor, shown = engineering([largest], unit)
    digits = 4 + int(np.log10(largest / (high - low))) if high > low else 4
    axis.set_view_interval(low, high, ignore=True)
    axis.set_major_formatter(lambda tick, _: f"{factor * tick:.{digits}g}".replace("-", "−"))
    axis.set_label_text(f"{name} ({shown})" if shown else name)


def plain_ticks(axis: Axis) -> None:
    """Write numbers, not powers of ten; below a decade also at minor ticks."""
    low, high = axis.get_view_interval()
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter("{x:.3g}" if high < 10 * low else NullFormatter())


def legend_above(ax: Axes, *, ncols: int = 3, markerscale: float = 1.0) -> None:
    """Draw a legend above the panel, with lines thick enough to be seen."""
    legend = ax.legend(
        loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=ncols, markerscale=markerscale,
        frameon=False, borderaxespad=0.2, columnspacing=1.2, handlelength=1.8, fontsize="small",
    )  # fmt: skip
    for handle in legend.get_lines():
        handle.set_linewidth(2)


def is_wide(first: float, last: float) -> bool:
    """Return whether the frequency axis of a band is logarithmic."""
    return first > 0 and last > first * 10**_LOG_DECADES


def frequency_axis(grid: NDArray[np.object_], first: float, last: float) -> None:
    """Set the frequency axis of all panels, in Hz, with its label below the last row."""
    for ax in grid.ravel():
        if is_wide(first, last):
            ax.set_xscale("log")
            steps = (1.0,) if last > first * 1e3 else (1.0, 2.0, 5.0)
            ax.xaxis.set_major_locator(LogLocator(subs=steps))
            ax.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
            ax.xaxis.set_minor_formatter(NullFormatter())
        if last > first:
            ax.set_xlim(first, last)
        ax.grid(True, which="major", alpha=0.2)
    for ax in grid[-1]:
        ax.set_xlabel("frequency (Hz)")


def decibel(amplitude: ArrayLike) -> Array:
    """Return an amplitude in dB; an amplitude of 0 leaves a gap."""
    amplitude = np.abs(np.asarray(amplitude))
    return 20.0 * np.log10(np.where(amplitude > 0, amplitude, np.nan))


def unit_label(what: str, output: str, source: str) -> str:
    """Return the label of a gain in dB, of the units of output and input."""
    per = "/".join(factor_of(unit or "1") for unit in (output, source))
    return f"{what} (dB{reference(per if output or source else '')})"


def reference(unit: str) -> str:
    """Label of the reference, the value of 0 dB."""
    return f", re 1 {unit}" if unit else ""
