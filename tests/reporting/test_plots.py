"""Figures show the signals they are given."""

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle, StepPatch

from lfrtorch.analysis.confidence_bands import Band
from lfrtorch.data.records import Channel, Record
from lfrtorch.fitting.trainer import Progress
from lfrtorch.reporting import plots

pytestmark = pytest.mark.numeric
T = np.arange(400) / 100.0
Y = np.column_stack([np.sin(2 * np.pi * 10 * T), 3 * np.cos(2 * np.pi * 20 * T)])
RECORD = Record(T, Y, 100.0, skip=0, name="lab", outputs=(Channel("a", "m"), Channel("b")))


def both(y_linear: np.ndarray, y_hat: np.ndarray | None = None) -> plots.Simulated:
    """Simulations by their models."""
    return {"linear": y_linear} | ({} if y_hat is None else {"NL-LFR": y_hat})


def drawn(ax: Axes, label: str) -> np.ndarray:
    """(x, y) of the line with a label."""
    (line,) = [line for line in ax.get_lines() if line.get_label() == label]
    return np.column_stack([line.get_xdata(), line.get_ydata()])


def labels(ax: Axes) -> list[str]:
    """Of all lines."""
    return [str(line.get_label()) for line in ax.get_lines()]


def legend(ax: Axes) -> list[str]:
    """Its lines of text."""
    found = ax.get_legend()
    assert found is not None
    return [text.get_text() for text in found.get_texts()]


def test_spectrum_shows_amplitudes_in_decibel():
    figure = plots.spectrum(RECORD, both(0.9 * Y, Y - 1e-3 * Y))
    first, second = figure.axes
    for ax, frequency, amplitude in ((first, 10.0, 1.0), (second, 20.0, 3.0)):
        for label, scale in (("output", 1.0), ("linear error", 0.1), ("NL-LFR error", 1e-3)):
            line = drawn(ax, label)
            peak = line[np.argmax(line[:, 1])]
            assert peak == pytest.approx([frequency, 20 * np.log10(scale * amplitude)], abs=1e-6)
    assert "dB, re 1 m" in first.get_ylabel()
    assert figure.get_suptitle() == "lab (file)"


def test_figures_of_a_linear_model_have_its_lines_alone():
    periodic = Record(T, Y, 100.0, start="periodic")
    skipped = Record(T, Y, 100.0, start="periodic", skip=1)
    for draw, record, unit, lines in (
        (plots.spectrum, periodic, "Hz", ["output", "linear error"]),
        (plots.response, skipped, "s", ["measured", "linear, fit 90.0 %"]),
        (plots.response, RECORD, "s", ["measured", "linear, fit 90.0 %"]),
    ):
        assert plots.is_whole(record) == (draw is plots.spectrum)
        figure = draw(record, both(0.9 * Y))
        assert labels(figure.axes[0]) == lines
        assert any(f"({unit})" in ax.get_xlabel() for ax in figure.axes)
    assert labels(plots.close_up(RECORD, both(0.9 * Y)).axes[0]) == ["measured", "linear"]


def test_the_close_up_has_the_band_of_the_errors():
    std, noise = np.full_like(RECORD.y, 3.0), np.array([4.0])
    band = Band(RECORD.outputs, 0.9 * RECORD.y, std, noise, np.zeros(RECORD.samples))
    above, below, *_ = plots.close_up(RECORD, both(0.9 * Y), band=band).axes
    assert not above.collections
    (filled,) = below.collections
    edges = np.asarray(filled.get_paths()[0].vertices)[:, 1]
    assert [edges.min(), edges.max()] == pytest.approx([-1.96 * 5.0, 1.96 * 5.0], rel=1e-3)


def test_response_overlays_the_scored_samples_with_the_errors_below():
    record = Record(T, Y, 100.0, skip=100, name="lab", outputs=(Channel("a", "m"), Channel("b")))
    above, below, *_ = plots.response(record, both(0.5 * Y, 0.999 * Y)).axes
    assert labels(above) == ["measured", "linear, fit 50.0 %", "NL-LFR, fit 99.90 %"]
    assert drawn(above, "measured")[0] == pytest.approx([1.0, Y[100, 0]])
    assert len(drawn(above, "measured")) == 300
    assert np.allclose(drawn(above, "NL-LFR, fit 99.90 %")[:, 1], 0.999 * Y[100:, 0])
    assert np.allclose(drawn(below, "linear")[:, 1], 0.5 * Y[100:, 0])
    assert np.allclose(drawn(below, "NL-LFR")[:, 1], 0.001 * Y[100:, 0])
    assert below.get_ylabel() == "error (m)"


def test_small_signals_have_axes_with_a_prefix():
    record = Record(T, 1e-6 * Y, 100.0, outputs=(Channel("a", "m"), Channel("b", "kg")))
    above, below, other, *_ = plots.response(record, both(0.9e-6 * Y)).axes
    said = [ax.get_ylabel() for ax in (above, below, other)]
    assert said == ["a (µm)", "error (nm)", "b (kg)"]
    assert below.yaxis.get_major_formatter()(50e-9) == "50"


def test_a_model_that_runs_away_hides_nothing():
    lost = np.where(np.arange(400)[:, None] < 300, Y, 1e6)
    lost[350:] = np.nan
    above, below, *_ = plots.response(RECORD, both(0.9 * Y, lost)).axes
    assert labels(above)[-1] == "NL-LFR, diverges"
    assert max(above.get_ylim()[1], below.get_ylim()[1]) < 4
    first, last = plots.close_up(RECORD, both(0.9 * Y, lost)).axes[-1].get_xlim()
    assert first < 3.0 < last
    for draw in (plots.spectrum, plots.density):
        assert draw(RECORD, {}).axes[1].get_ylabel() == "b (dB)"  # its unit is not known
        assert labels(draw(RECORD, both(0.9 * Y, lost)).axes[0])[-1] == "NL-LFR diverges"
    assert legend(plots.distribution(RECORD, both(0.9 * Y, lost)).axes[0])[-1] == "NL-LFR diverges"


def test_distribution_says_where_most_errors_are():
    error = np.random.default_rng(0).uniform(-1, 1, (100_000, 1))
    record = Record(error, error, outputs=(Channel("a", "m"),))
    ax = plots.distribution(record, both(0.5 * error, 0.998 * error)).axes[0]
    assert legend(ax) == [
        "linear error: 95 % within ±0.475 m",
        "NL-LFR error: 95 % within ±1.90 mm",
    ]
    steps = ax.patches[0]
    assert isinstance(steps, StepPatch)
    counts, edges, _ = steps.get_data()
    assert np.sum(counts * np.diff(edges)) == pytest.approx(1.0)


def test_some_of_many_outputs_are_drawn():
    figure = plots.response(RECORD, both(0.9 * Y), outputs=[1])
    assert [ax.get_ylabel() for ax in figure.axes] == ["b", "error", "input"]
    assert len(plots.spectrum(RECORD, both(0.9 * Y), outputs=[1]).axes) == 1


def test_density_integrates_to_the_power():
    rng = np.random.default_rng(0)
    y = rng.standard_normal((20_000, 1))
    record = Record(y, y, 100.0, name="lab", outputs=(Channel("a", "m"),))
    ax = plots.density(record, both(0.9 * y, 0.5 * y)).axes[0]
    for label, scale in (("output", 1.0), ("linear error", 0.1), ("NL-LFR error", 0.5)):
        line = drawn(ax, label)
        # White: one sided, 2 / fs; a standard deviation of 1.4 % over the band, 4 σ.
        level = 10 * np.log10(np.mean(10 ** (line[:, 1] / 10)))
        assert level == pytest.approx(10 * np.log10(scale**2 * 2 / 100), abs=0.25)
    assert "dB, re 1 m²/Hz" in ax.get_ylabel()
    assert ax.get_xscale() == "log"
    assert ax.get_xlim() == pytest.approx((line[0, 0], 50.0))
    short = Record(y[:10], y[:10], skip=5)
    assert len(drawn(plots.density(short, both(0 * y[:10], y[:10])).axes[0], "output")) == 2


def test_the_inputs_stand_above_the_outputs():
    *others, inputs = plots.response(RECORD, both(0.9 * Y)).axes
    assert inputs.get_ylabel() == "input"
    assert len(inputs.get_lines()) == RECORD.u.shape[1]
    assert len(others) == 2 * RECORD.y.shape[1]
    assert inputs.get_xlim() == others[0].get_xlim()


def test_close_up_is_about_the_largest_error():
    y_hat = Y.copy()
    y_hat[300, 1] += 2.0
    long = Record(np.tile(T, 10), np.tile(Y, (10, 1)), 100.0, skip=50, name="lab")
    simulated = np.vstack([*[Y] * 5, y_hat, *[Y] * 4])
    figure = plots.close_up(long, both(0 * long.y, simulated))
    assert len(figure.axes) == 4  # two outputs, and the errors below each
    for ax, name in zip(figure.axes, ("measured", "linear", "measured", "linear"), strict=True):
        line = drawn(ax, name)
        # 50 samples, eight periods of 20 Hz being 40, about 23.00 s
        assert line[[0, -1], 0] == pytest.approx([22.75, 23.24])
    assert drawn(figure.axes[3], "NL-LFR")[25] == pytest.approx([23.0, -2.0])
    (shaded,) = plots.response(long, both(0 * long.y, simulated)).axes[0].patches
    assert isinstance(shaded, Rectangle)
    assert (shaded.get_x(), shaded.get_width()) == pytest.approx((22.75, 0.49))


def test_long_signals_keep_their_extremes():
    y = np.sin(np.arange(100_000))
    y[77_777] = 5.0
    ax = plots.response(Record(y, y), both(0 * y[:, None], y[:, None])).axes[0]
    line = drawn(ax, "measured")
    assert len(line) <= plots._MOST_POINTS + 2
    assert line[:, 1].max() == 5.0
    assert abs(line[np.argmax(line[:, 1]), 0] - 77_777) <= 10


def test_convergence_marks_the_kept_iterate():
    history = [Progress(i, 3, 1.0 / (i + 1), 2.0 / (i + 1), 0.0, True, {}, 0.0) for i in range(4)]
    ax = plots.convergence(history, 2, "m").axes[0]
    assert np.allclose(drawn(ax, "training")[:, 1], [1, 1 / 2, 1 / 3, 1 / 4])
    assert drawn(ax, "kept: iteration 2")[0, 0] == 2
    assert "(m)" in ax.get_ylabel()
    assert len(plots.convergence(history[:1], 0).axes[0].get_lines()) == 3


def test_each_of_several_models_has_a_line_and_one_that_diverges_no_spectrum():
    simulated = {"linear": 0.5 * Y, "good": 0.9 * Y, "bad": np.full_like(Y, np.nan)}
    above, *_ = plots.response(RECORD, simulated).axes
    assert labels(above) == ["measured", "linear, fit 50.0 %", "good, fit 90.0 %", "bad, diverges"]
    ax = plots.density(RECORD, simulated).axes[0]
    assert labels(ax) == ["output", "linear error", "good error", "bad diverges"]
    assert len({line.get_color() for line in ax.get_lines()}) == 4
