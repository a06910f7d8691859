"""Figures of a linear model, and of the measured response that it was fitted to."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from lfrtorch._support.drawing import (
    CHANNELS,
    decibel,
    frequency_axis,
    is_wide,
    panels,
    plain_ticks,
    reference,
    unit_label,
)
from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array, Complex
from lfrtorch.linear.frf import FRF
from lfrtorch.linear.model import LinearModel
from lfrtorch.linear.order_scan import OrderScan

# Colours of the lines.
MEASURED, TOTAL, _, EVEN, DIFFERENCE, _ = CHANNELS
MODEL, NOISE, ODD = "black", "0.5", TOTAL

_GRID = 500  # frequencies at which a model is drawn, beside those of its poles
_LOWEST = 1e-3  # first frequency of a model drawn alone, relative to half the sampling frequency

RANGE = 120.0
"""Largest range of an axis in dB: a zero of a model on a grid point must not stretch the axis."""

ABOVE = 30.0
"""Largest dB above the model: measured responses at lines without excitation mean nothing."""

STRETCHES = 200
"""Number of parts of the frequency axis; a variance is drawn as its mean over each part. Drawn line
by line, it hid the dots of a record of 50000 samples."""

_COLOURS = 10
"""Zeros have a colour and a name for each output and input, up to so many pairs."""

_FAR = 2.0  # half width of the drawn z plane: zeros far out come from sampling and mean little


def frequency_response(model: LinearModel, frf: FRF | None = None) -> Figure:
    """Draw magnitude and phase of the model ± 2 std, over the measured response if given."""
    ny, nu = len(model.outputs), len(model.inputs)
    # A row of magnitudes and a row of phases for each output.
    size, heights = (2.5 + 5.5 * nu, 5.5 * ny), [3, 1.5] * ny
    figure, grid = panels(size, 2 * ny, nu, sharex=True, height_ratios=heights)
    smooth = frequencies(model, frf)
    f = smooth if frf is None else np.union1d(smooth, frf.frequencies)
    lines = None if frf is None else np.searchsorted(f, frf.frequencies)
    G_hat = model.frf(f)
    std = None if model.covariance is None else model.frf_std(smooth)
    centre = np.abs(G_hat[np.searchsorted(f, smooth)])
    for i, output in enumerate(model.outputs):
        for j, source in enumerate(model.inputs):
            magnitude, phase = grid[2 * i, j], grid[2 * i + 1, j]
            fit = G_hat[:, i, j]
            angle = np.unwrap(np.angle(fit))
            if frf is not None and lines is not None:
                G = frf.G[:, i, j]
                _dots(magnitude, frf.frequencies, decibel(G), "nonparametric", MEASURED)
                difference = decibel(G - fit[lines])
                _dots(magnitude, frf.frequencies, difference, "difference", DIFFERENCE)
                for variance, label, colour in (
                    (frf.var_total, "total std", TOTAL),
                    (frf.var_noise, "noise std", NOISE),
                ):
                    if variance is not None:
                        level = _mean(frf.frequencies, variance[:, i, j])
                        magnitude.plot(*level, lw=1.2, color=colour, label=label)
                # Measured phases are within 180° of the model's: noise makes no jumps of 360°.
                turned = angle[lines] + np.angle(G * fit[lines].conj())
                _dots(phase, frf.frequencies, np.degrees(turned), "nonparametric", MEASURED)
            magnitude.plot(f, decibel(fit), lw=1.0, color=MODEL, label="model")
            phase.plot(f, np.degrees(angle), lw=1.0, color=MODEL, label="model")
            limits = _limit(magnitude, decibel(fit))
            if std is not None:
                low, high = (centre[:, i, j] + sign * 2 * std[:, i, j] for sign in (-1, 1))
                low = np.maximum(low, 10 ** (-RANGE / 20) * high.max())
                band = decibel(low), decibel(high)
                magnitude.fill_between(
                    smooth, *band, color=MODEL, alpha=0.25, lw=0, label="model ± 2 std"
                )
                magnitude.set_ylim(limits)  # a band may reach down to zero
            title = f"{output.name} / {source.name}"
            magnitude.set(title=title, ylabel=unit_label("magnitude", output.unit, source.unit))
            phase.set(ylabel="phase (deg)")
            # Ticks of a phase: 45, 90, 180 degrees.
            phase.yaxis.set_major_locator(MaxNLocator(5, steps=(1, 1.8, 4.5, 9, 10)))
    frequency_axis(grid, f[0], f[-1])
    _legend(figure, grid[0, 0])
    return figure


def poles_and_zeros(model: LinearModel) -> Figure:
    """Draw poles and zeros in the z plane, as ``zeros`` names them, with the unit circle."""
    figure, ((ax,),) = panels((7.5, 5.5), layout="compressed")
    angle = np.linspace(0, 2 * np.pi, 361)
    ax.plot(np.cos(angle), np.sin(angle), lw=0.8, color="0.6")
    ax.axhline(0, lw=0.5, color="0.8", zorder=0)
    ax.axvline(0, lw=0.5, color="0.8", zorder=0)
    found = zeros(model)
    if len(found) > _COLOURS:
        found = {"of every pair": np.concatenate(list(found.values()))}
    for k, (channel, values) in enumerate(found.items()):
        label = f"zeros {channel}" if channel else "zeros"
        colour = MEASURED if len(found) == 1 else f"C{k % 10}"
        ax.plot(values.real, values.imag, "o", mfc="none", ms=7, color=colour, label=label)
    ax.plot(model.poles.real, model.poles.imag, "x", ms=7, color=MODEL, label="poles")
    every = np.concatenate(list(found.values()))
    reach = np.maximum(np.abs(every.real), np.abs(every.imag))
    width = min(_FAR, 1.1 * float(reach.max(initial=1.0)))
    ax.set(xlim=(-width, width), ylim=(-width, width), aspect="equal")
    if (reach > width).any():
        ax.set_title(f"{(reach > width).sum()} zero(s) beyond the frame")
    ax.set(xlabel="real part", ylabel="imaginary part")
    ax.legend(loc="upper left", bbox_to_anchor=(1.02, 1.0))
    return figure


def distortion(frf: FRF) -> Figure:
    """Draw levels at the output of the fast method: signal, odd and even distortion, noise."""
    # Distortions are drawn with the noise in them: levels above the noise are nonlinear.
    levels = frf.distortion
    if levels is None:
        raise InputError(
            f"the response was estimated by the method '{frf.method}', which does not tell odd and "
            "even distortion apart; use estimate_frf(records, method='fast')."
        )
    ny = len(frf.outputs)
    figure, grid = panels((8, 1.5 + 3.0 * ny), ny, sharex=True)
    for i, (output, ax) in enumerate(zip(frf.outputs, grid[:, 0], strict=True)):
        for level, label, colour, marker in (
            (levels.output, "output", MEASURED, "."),
            (levels.odd, "odd distortion and noise", ODD, "^"),
            (levels.even, "even distortion and noise", EVEN, "v"),
        ):
            power = decibel(np.sqrt(level.power[:, i]))
            _dots(ax, level.frequencies, power, label, colour, marker)
        noise = _mean(levels.output.frequencies, levels.output.noise[:, i])
        ax.plot(*noise, lw=1.2, color=NOISE, label="noise")
        _limit(ax)
        ax.set(ylabel=f"{output.name} (dB{reference(output.unit)} rms)")
    frequency_axis(grid, frf.frequencies[0], frf.frequencies[-1])
    _legend(figure, grid[0, 0])
    return figure


def order_scan(scan: OrderScan) -> Figure:
    """Draw scores and errors of the fit against order, and singular values."""
    figure, ((errors, carried),) = panels((10, 4), 1, 2)
    score = "validation" if scan.validated else "score (MDL)"
    fitted = [np.nan if m.fit is None else m.fit.rmse for m in scan.models]
    errors.semilogy(scan.orders, fitted, "s-", ms=4, lw=0.8, color="0.5", label="fitted")
    errors.semilogy(scan.orders, scan.scores, "o-", ms=5, color=MEASURED, label=score)
    errors.set(ylabel="error, normalised")
    s = np.asarray(scan.singular_values)[: 2 * max(scan.orders)]
    carried.semilogy(np.arange(1, len(s) + 1), s, "o-", ms=5, color=MEASURED, label="_")
    carried.set(ylabel="singular value of the subspace, relative")
    for ax in (errors, carried):
        ax.axvline(scan.chosen, color=TOTAL, ls=":", label=f"chosen: {scan.chosen}")
        ax.set(xlabel="order nx")
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
        plain_ticks(ax.yaxis)
        ax.grid(True, which="both", alpha=0.2)
        ax.legend()
    return figure


def zeros(model: LinearModel) -> dict[str, Complex]:
    """Transmission zeros of a square model by the name ``""``; of any other, zeros by channel."""
    if len(model.inputs) == len(model.outputs):
        return {"": model.zeros()}
    return {
        f"{output.name}/{source.name}": model.zeros(i, j)
        for i, output in enumerate(model.outputs)
        for j, source in enumerate(model.inputs)
    }


def frequencies(model: LinearModel, frf: FRF | None = None) -> Array:
    """Frequencies (Hz) at which a model is drawn: a grid in the band, and the resonances."""
    lines = np.array([_LOWEST, 1.0]) * model.fs / 2 if frf is None else frf.frequencies
    first, last = float(lines[0]), float(lines[-1])
    spaced = np.geomspace if is_wide(first, last) else np.linspace
    resonances = np.abs(np.angle(model.poles)) * model.fs / (2 * np.pi)
    f = np.union1d(spaced(first, last, _GRID), resonances)
    return f[(f >= first) & (f <= last)]


def _dots(ax: Axes, f: Array, level: Array, label: str, colour: str, marker: str = ".") -> None:
    ax.plot(f, level, marker, ms=2.5 if len(f) < 2000 else 1.0, color=colour, label=label)


def _mean(f: Array, variance: Array) -> tuple[Array, Array]:
    """Frequencies and dB of a variance, as means over the stretches of the axis with lines."""
    spaced = np.geomspace if is_wide(f[0], f[-1]) else np.linspace
    stretch = np.searchsorted(spaced(f[0], f[-1], STRETCHES + 1)[1:-1], f, side="right")
    _, first, count = np.unique(stretch, return_index=True, return_counts=True)
    at, mean = (np.add.reduceat(values, first) / count for values in (f, variance))
    return at, decibel(np.sqrt(mean))


def _legend(figure: Figure, ax: Axes) -> None:
    """Draw one legend beside the panels, which all have the same lines."""
    figure.legend(*ax.get_legend_handles_labels(), loc="outside right upper", markerscale=3)


def _limit(ax: Axes, model: Array | None = None) -> tuple[float, float]:
    """Set limits of the axis that are at most RANGE apart, and at most ABOVE above the model."""
    low, high = ax.get_ylim()
    drawn = np.zeros(0) if model is None else model[np.isfinite(model)]
    high = min(high, drawn.max() + ABOVE) if len(drawn) else high
    return ax.set_ylim(min(max(low, high - RANGE), high - ABOVE), high)
