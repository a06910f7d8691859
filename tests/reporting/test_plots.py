"""Figures show the signals they are given."""

import numpy as np
import pytest
from matplotlib.axes import Axes

from lfrtorch.fitting.trainer import Progress
from lfrtorch.records import Channel, Record
from lfrtorch.reporting import plots

pytestmark = pytest.mark.numeric
T = np.arange(400) / 100.0
Y = np.column_stack([np.sin(2 * np.pi * 10 * T), 3 * np.cos(2 * np.pi * 20 * T)])
RECORD = Record(T, Y, 100.0, skip=0, name="lab", outputs=(Channel("a", "m"), Channel("b")))


def drawn(ax: Axes, label: str) -> np.ndarray:
    """(x, y) of the line with a label."""
    (line,) = [line for line in ax.get_lines() if line.get_label() == label]
    return np.column_stack([line.get_xdata(), line.get_ydata()])


def test_spectrum_shows_amplitudes_in_decibel():
    figure = plots.spectrum(RECORD, 0.9 * Y, Y - 1e-3 * Y)
    first, second = figure.axes
    for ax, frequency, amplitude in ((first, 10.0, 1.0), (second, 20.0, 3.0)):
        for label, scale in (("output", 1.0), ("linear error", 0.1), ("NL-LFR error", 1e-3)):
            line = drawn(ax, label)
            peak = line[np.argmax(line[:, 1])]
            assert peak == pytest.approx([frequency, 20 * np.log10(scale * amplitude)], abs=1e-6)
    assert "dB, re 1 m" in first.get_ylabel()
    assert first.get_title() == "lab (file)"


def test_figures_of_a_linear_model_have_its_error_alone():
    periodic = Record(T, Y, 100.0, start="periodic")
    skipped = Record(T, Y, 100.0, start="periodic", skip=1)
    for record, unit in ((periodic, "Hz"), (skipped, "s"), (RECORD, "s")):
        figure = plots.errors(record, 0.9 * Y)
        assert [line.get_label() for line in figure.axes[0].get_lines()] == [
            "output",
            "linear error",
        ]
        assert f"({unit})" in figure.axes[-1].get_xlabel()


def test_response_shows_the_scored_samples():
    record = Record(T, Y, 100.0, skip=100, name="lab")
    ax = plots.response(record, 0.5 * Y, Y).axes[0]
    assert drawn(ax, "output")[0] == pytest.approx([1.0, Y[100, 0]])
    assert len(drawn(ax, "output")) == 300
    assert np.allclose(drawn(ax, "linear error")[:, 1], 0.5 * Y[100:, 0])
    assert not drawn(ax, "NL-LFR error")[:, 1].any()


def test_density_integrates_to_the_power():
    rng = np.random.default_rng(0)
    y = rng.standard_normal((20_000, 1))
    record = Record(y, y, 100.0, name="lab", outputs=(Channel("a", "m"),))
    ax = plots.density(record, 0.9 * y, 0.5 * y).axes[0]
    for label, scale in (("output", 1.0), ("linear error", 0.1), ("NL-LFR error", 0.5)):
        line = drawn(ax, label)
        # White: one sided, 2 / fs; a standard deviation of 1.4 % over the band, 4 σ.
        level = 10 * np.log10(np.mean(10 ** (line[:, 1] / 10)))
        assert level == pytest.approx(10 * np.log10(scale**2 * 2 / 100), abs=0.25)
    assert "dB, re 1 m²/Hz" in ax.get_ylabel()
    short = Record(y[:10], y[:10], skip=5)
    assert len(drawn(plots.density(short, 0 * y[:10], y[:10]).axes[0], "output")) == 2


def test_close_up_is_about_the_largest_error():
    y_hat = Y.copy()
    y_hat[300, 1] += 2.0
    long = Record(np.tile(T, 10), np.tile(Y, (10, 1)), 100.0, skip=50, name="lab")
    figure = plots.close_up(long, 0 * long.y, np.vstack([*[Y] * 5, y_hat, *[Y] * 4]))
    assert len(figure.axes) == 4  # two outputs, and the error alone below each
    for ax, labels in zip(figure.axes, (3, 1, 3, 1), strict=True):
        line = drawn(ax, "NL-LFR error")
        assert len(ax.get_lines()) == labels
        assert line[[0, -1], 0] == pytest.approx([20.5, 25.49])  # 23.00 s is in the middle
    assert drawn(figure.axes[3], "NL-LFR error")[250] == pytest.approx([23.0, -2.0])
    lost = np.where(np.arange(400)[:, None] < 100, Y, np.nan)
    line = drawn(plots.close_up(RECORD, 0 * Y, lost).axes[0], "output")
    assert len(line) == 400


def test_long_signals_keep_their_extremes():
    y = np.sin(np.arange(100_000))
    y[77_777] = 5.0
    ax = plots.response(Record(y, y), 0 * y[:, None], y[:, None]).axes[0]
    line = drawn(ax, "output")
    assert len(line) <= plots.MOST_POINTS + 2
    assert line[:, 1].max() == 5.0
    assert abs(line[np.argmax(line[:, 1]), 0] - 77_777) <= 10


@pytest.mark.parametrize(("nz", "panels"), [(1, 1), (2, 1), (3, 3)])
def test_static_map_has_a_panel_for_each_output(nz: int, panels: int):
    rng = np.random.default_rng(0)
    z, w = rng.normal(size=(500, nz)), rng.normal(size=(500, 2))
    figure = plots.static_map(z, w)
    labels = [ax.get_ylabel() for ax in figure.axes]
    assert sum(label in ("w1", "w2") for label in labels) == 2 * panels


def test_convergence_marks_the_kept_iterate():
    history = [Progress(i, 3, 1.0 / (i + 1), 2.0 / (i + 1), 0.0, True, {}, 0.0) for i in range(4)]
    ax = plots.convergence(history, 2, "m").axes[0]
    assert np.allclose(drawn(ax, "training")[:, 1], [1, 1 / 2, 1 / 3, 1 / 4])
    assert drawn(ax, "kept: iteration 2")[0, 0] == 2
    assert "(m)" in ax.get_ylabel()
    assert len(plots.convergence(history[:1], 0).axes[0].get_lines()) == 3
