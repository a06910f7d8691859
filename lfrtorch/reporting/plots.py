"""Figures of a result: they read signals and histories and compute no model."""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np
import scipy
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lfrtorch._support.types import Array
from lfrtorch.fitting.trainer import Progress
from lfrtorch.records import Record

OUTPUT, LINEAR, NL_LFR = "tab:blue", "tab:red", "tab:green"
"""Colours of the measured output, the linear model's error and the NL-LFR's, as in the paper."""

DPI = 150
"""Dots per inch of a figure that is written."""

MOST_POINTS = 20_000
"""Samples drawn of a long signal as a cloud."""

CLOSE_UP = 500
"""Samples of a close-up: some periods of what the model follows."""

SEGMENT, SHORTEST = 4096, 16
"""Most and fewest samples of a segment that a power spectral density is averaged over."""


def errors(record: Record, y_linear: Array, y_hat: Array | None = None) -> Figure:
    """The spectrum of whole periods in steady state, and else the response against time.

    Example:
        >>> from lfrtorch.reporting import plots
        >>> figure = plots.errors(record, bla.simulate(record), model.simulate(record))
        >>> figure.axes[0].get_xlabel()  # the record is a whole period: its spectrum
        'frequency (Hz)'
    """
    return (spectrum if is_whole(record) else response)(record, y_linear, y_hat)


def is_whole(record: Record) -> bool:
    """Whether the scored samples are whole periods in steady state, whose spectrum has no leakage.

    Periods with a skip window are no whole periods.

    Example:
        >>> from lfrtorch.reporting import plots
        >>> plots.is_whole(record), plots.is_whole(record[:100])
        (True, False)
    """
    return record.start == "periodic" and not record.skip


def spectrum(record: Record, y_linear: Array, y_hat: Array | None = None) -> Figure:
    """Magnitude of the measured output and of the errors against frequency, one panel an output.

    Shape:
        y_linear, y_hat: (T, ny), simulated outputs in physical units; without an NL-LFR
            there is no y_hat.

    Example:
        >>> from lfrtorch.reporting import plots
        >>> figure = plots.spectrum(record, bla.simulate(record), model.simulate(record))
        >>> [line.get_label() for line in figure.axes[0].lines]
        ['output', 'linear error', 'NL-LFR error']
    """
    figure, axes = _panels(record)
    y = record.y[record.skip :]
    f = np.fft.rfftfreq(len(y), 1.0 / record.fs)
    for i, ax in enumerate(axes):
        for signal, label, colour in _signals(record, y_linear, y_hat, i):
            ax.plot(f[1:-1], _decibel(signal)[1:-1], ".", ms=2, color=colour, label=label)
        unit = record.outputs[i].unit or "1"
        ax.set(ylabel=f"{record.outputs[i].name} (dB, re 1 {unit})", xlim=(0, f[-1]))
        ax.legend(loc="upper right", markerscale=5)
    axes[0].set_title(_title(record))
    axes[-1].set_xlabel("frequency (Hz)")
    return figure


def density(record: Record, y_linear: Array, y_hat: Array | None = None) -> Figure:
    """Power spectral density of the measured output and of the errors, one panel an output.

    By Welch's method: for records that are no whole periods.

    Shape:
        y_linear, y_hat: (T, ny), simulated outputs in physical units; without an NL-LFR
            there is no y_hat.

    Example:
        >>> from lfrtorch.reporting import plots
        >>> figure = plots.density(record[:300], bla.simulate(record[:300]))
        >>> figure.savefig("density.png")
    """
    figure, axes = _panels(record)
    scored = record.samples - record.skip
    segment = min(SEGMENT, scored, max(SHORTEST, scored // 8))
    for i, ax in enumerate(axes):
        for signal, label, colour in _signals(record, y_linear, y_hat, i):
            f, power = scipy.signal.welch(signal, record.fs, nperseg=segment)
            level = 10.0 * np.log10(np.maximum(power, np.finfo(float).tiny))
            ax.plot(f[1:], level[1:], lw=0.8, color=colour, label=label)
        unit = record.outputs[i].unit or "1"
        per = f"{unit}²/Hz" if record.fs != 1.0 else f"{unit}²"
        ax.set(ylabel=f"{record.outputs[i].name} (dB, re 1 {per})", xlim=(0, record.fs / 2))
        _legend(ax)
    axes[0].set_title(_title(record))
    axes[-1].set_xlabel("frequency (Hz)" if record.fs != 1.0 else "frequency (1/sample)")
    return figure


def response(record: Record, y_linear: Array, y_hat: Array | None = None) -> Figure:
    """Measured output and errors against time in the record, one panel an output.

    Shape:
        y_linear, y_hat: (T, ny), simulated outputs in physical units; without an NL-LFR
            there is no y_hat.

    Example:
        >>> from lfrtorch.reporting import plots
        >>> figure = plots.response(record, bla.simulate(record))
        >>> figure.axes[0].get_xlabel()
        'time in the record (s)'
    """
    figure, axes = _panels(record)
    t = np.arange(record.skip, record.samples) / record.fs
    for i, ax in enumerate(axes):
        for signal, label, colour in _signals(record, y_linear, y_hat, i):
            ax.plot(*envelope(t, signal), lw=0.5, color=colour, label=label)
        ax.set(ylabel=str(record.outputs[i]), xlim=(t[0], t[-1]))
        _legend(ax)
    axes[0].set_title(_title(record))
    _time_axis(record, axes[-1])
    return figure


def close_up(record: Record, y_linear: Array, y_hat: Array) -> Figure:
    """The response about the largest error of the NL-LFR, and below it this error alone.

    Errors of several outputs are compared relative to the deviation of each. If the
    model diverges, the largest error is where it first does so.

    Shape:
        y_linear, y_hat: (T, ny), simulated outputs in physical units.

    Example:
        >>> from lfrtorch.reporting import plots
        >>> figure = plots.close_up(record, bla.simulate(record), model.simulate(record))
        >>> len(figure.axes)  # the output with both errors, and the error of the NL-LFR
        2
    """
    y = record.y[record.skip :]
    deviation = np.std(y, axis=0)
    error = np.abs(y - y_hat[record.skip :]) / np.where(deviation > 0, deviation, 1.0)
    worst = int(np.argmax(np.where(np.isfinite(error), error, np.inf).max(axis=1)))
    first = max(0, min(worst - CLOSE_UP // 2, len(y) - CLOSE_UP))
    window = slice(first, first + CLOSE_UP)
    t = (record.skip + np.arange(len(y))[window]) / record.fs
    ny = len(record.outputs)
    figure = Figure(figsize=(8, 1.5 + 4.5 * ny), layout="constrained")
    axes = list(figure.subplots(2 * ny, 1, sharex=True, height_ratios=[2, 1] * ny))
    for i, output in enumerate(record.outputs):
        signals = _signals(record, y_linear, y_hat, i)
        for ax, drawn in ((axes[2 * i], signals), (axes[2 * i + 1], signals[-1:])):
            for signal, label, colour in drawn:
                ax.plot(t, signal[window], lw=1.0, color=colour, label=label)
            ax.set(ylabel=str(output))
            ax.margins(x=0)
            _legend(ax)
    axes[0].set_title(_title(record))
    _time_axis(record, axes[-1])
    return figure


def static_map(z: Array, w: Array) -> Figure:
    """The static nonlinearity over the region that the data visited.

    One input: w against z with the data's density below. Two: w in colour over the (z1, z2) plane.
    More: w against each z in turn.

    Shape:
        z: (samples, nz), w: (samples, nw), normalised units, along a simulation.

    Example:
        >>> from lfrtorch.reporting import plots
        >>> trajectory = model.signals(record)
        >>> figure = plots.static_map(trajectory.z[0].numpy(), trajectory.w[0].numpy())
        >>> figure.axes[0].get_ylabel()
        'w1'
    """
    step = max(1, len(z) // MOST_POINTS)
    z, w = z[::step], w[::step]
    nz, nw = z.shape[1], w.shape[1]
    columns = nz if nz > 2 else 1
    figure = Figure(figsize=(5.5 * columns, 4.0 * nw), layout="constrained")
    grid = figure.subplots(nw, columns, squeeze=False)
    for j in range(nw):
        for i, ax in enumerate(grid[j]):
            if nz == 2:
                points = ax.scatter(z[:, 0], z[:, 1], c=w[:, j], s=3, cmap="coolwarm", lw=0)
                figure.colorbar(points, ax=ax, label=f"w{j + 1}")
                ax.set(xlabel="z1", ylabel="z2")
                continue
            order = np.argsort(z[:, i])
            style = "-" if nz == 1 else "."
            ax.plot(z[order, i], w[order, j], style, ms=1, color=NL_LFR)
            density = ax.twinx()
            density.hist(z[:, i], bins=80, color="0.8", density=True)
            density.set(yticks=[], ylim=(0, 4 * density.get_ylim()[1]))
            ax.set_zorder(density.get_zorder() + 1)
            ax.patch.set_visible(False)
            ax.set(xlabel=f"z{i + 1} (grey: density of the data)", ylabel=f"w{j + 1}")
    figure.suptitle("static nonlinearity over the visited region (normalised)")
    return figure


def convergence(history: Sequence[Progress], chosen: int, unit: str = "") -> Figure:
    """Errors on training and validation records against iteration, the kept iterate marked.

    Example:
        >>> from lfrtorch.reporting import plots
        >>> result = lfrtorch.fit(model, record, trainer=lfrtorch.LevenbergMarquardt(max_iter=3))
        >>> figure = plots.convergence(result.history, result.chosen_iteration, unit="V")
        >>> figure.axes[0].get_ylabel()
        'simulation RMSE (V)'
    """
    figure = Figure(figsize=(7, 4), layout="constrained")
    ax = figure.subplots()
    iterations = [p.iteration for p in history]
    ax.semilogy(iterations, [p.train for p in history], color="0.3", label="training")
    validation = np.array([p.validation for p in history])
    if np.isfinite(validation).any():
        ax.semilogy(iterations, validation, color=NL_LFR, label="validation")
    ax.axvline(chosen, color="0.6", ls=":", label=f"kept: iteration {chosen}")
    ax.set(xlabel="iteration", ylabel=f"simulation RMSE{f' ({unit})' if unit else ''}")
    ax.grid(True, which="both", alpha=0.2)
    ax.legend()
    return figure


def png(figure: Figure) -> bytes:
    """The figure as a PNG file.

    Example:
        >>> from lfrtorch.reporting import plots
        >>> plots.png(plots.response(record, bla.simulate(record)))[1:4]
        b'PNG'
    """
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=DPI)
    return stream.getvalue()


def _panels(record: Record) -> tuple[Figure, list[Axes]]:
    ny = record.y.shape[1]
    figure = Figure(figsize=(8, 1.5 + 3.0 * ny), layout="constrained")
    return figure, list(figure.subplots(ny, 1, squeeze=False, sharex=True)[:, 0])


def _signals(
    record: Record, y_linear: Array, y_hat: Array | None, i: int
) -> list[tuple[Array, str, str]]:
    y = record.y[record.skip :, i]
    signals = [(y, "output", OUTPUT), (y - y_linear[record.skip :, i], "linear error", LINEAR)]
    if y_hat is not None:
        signals.append((y - y_hat[record.skip :, i], "NL-LFR error", NL_LFR))
    return signals


def envelope(t: Array, signal: Array) -> tuple[Array, Array]:
    """A long signal as the smallest and largest sample of each of many short stretches.

    Example:
        >>> from lfrtorch.reporting import plots
        >>> t = np.arange(100_000) / 1000
        >>> short_t, short = plots.envelope(t, np.sin(t))
        >>> len(short), bool(short.max() == np.sin(t).max())
        (20000, True)
    """
    stretch = len(signal) // (MOST_POINTS // 2)
    if stretch < 2:
        return t, signal
    pieces = signal[: len(signal) // stretch * stretch].reshape(-1, stretch)
    ends = np.column_stack([pieces.min(axis=1), pieces.max(axis=1)])
    return np.repeat(t[::stretch][: len(pieces)], 2), ends.ravel()


def _time_axis(record: Record, ax: Axes) -> None:
    ax.set_xlabel("time in the record (s)" if record.fs != 1.0 else "sample of the record")


def _legend(ax: Axes) -> None:
    """A legend whose lines are thick enough to be seen."""
    for handle in ax.legend(loc="upper right").get_lines():
        handle.set_linewidth(2)


def _title(record: Record) -> str:
    return f"{record.name} ({record.source})"


def _decibel(signal: Array) -> Array:
    """Amplitude of each line of a real signal in dB; a silent line shows as the rounding error."""
    amplitude = np.abs(np.fft.rfft(signal)) * 2.0 / len(signal)
    return 20.0 * np.log10(np.maximum(amplitude, np.finfo(float).tiny))
