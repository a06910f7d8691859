"""Figures of a linear model show the numbers they are given."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import lfrtorch
from lfrtorch.data.records import Channel
from lfrtorch.linear.frf import Distortion, Level
from lfrtorch.reporting import linear_plots

pytestmark = pytest.mark.numeric
FS = 100.0
F = np.arange(1.0, 41.0)
MODEL = lfrtorch.LinearModel(
    A=np.array([[0.5, 0.4], [-0.4, 0.5]]),
    B=np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.2]]),
    C=np.array([[1.0, 0.0], [0.3, 1.0]]),
    D=np.array([[0.1, 0.0, 0.0], [0.0, 0.2, 0.0]]),
    fs=FS,
    u_offset=np.zeros(3),
    y_offset=np.zeros(2),
    inputs=(Channel("a", "N"), Channel("b", "N"), Channel("c")),
    outputs=(Channel("x", "m"), Channel("phi")),
    covariance=1e-6 * np.eye(20),
)
SISO = replace(
    MODEL,
    B=MODEL.B[:, :1],
    C=MODEL.C[:1],
    D=MODEL.D[:1, :1],
    inputs=MODEL.inputs[:1],
    outputs=MODEL.outputs[:1],
    u_offset=np.zeros(1),
    y_offset=np.zeros(1),
    covariance=None,
)


def measured(
    model: lfrtorch.LinearModel, *, noise: float | None = 1e-4, f: np.ndarray = F
) -> lfrtorch.FRF:
    """1.01 times the model's response, of a total variance of 1e-2 at all lines."""
    G = 1.01 * model.frf(f)
    n = G[0].size
    one = np.tile(np.eye(n), (len(f), 1, 1)).astype(complex)
    return lfrtorch.FRF(
        f, G, FS, model.u_offset, model.y_offset, model.inputs, model.outputs,
        cov_noise=None if noise is None else one * complex(noise),
        cov_total=one * complex(1e-2), experiments=6, periods=2, method="robust",
    )  # fmt: skip


def labels(ax: Axes) -> list[str]:
    return ax.get_legend_handles_labels()[1]


def drawn(ax: Axes, label: str) -> np.ndarray:
    """(x, y) of the line with a label."""
    (line,) = [line for line in ax.get_lines() if line.get_label() == label]
    return np.column_stack([line.get_xdata(), line.get_ydata()])


def decibel(G: np.ndarray) -> np.ndarray:
    return 20 * np.log10(np.abs(G))


def rendered(figure: Figure) -> None:
    """Warnings, of a layout that does not fit for instance, are errors in tests."""
    figure.draw_without_rendering()


def test_frequency_response_shows_what_is_known_of_each_channel():
    figure = linear_plots.frequency_response(MODEL, measured(MODEL))
    rendered(figure)
    assert len(figure.axes) == 2 * 2 * 3
    grid = np.reshape(np.array(figure.axes), (4, 3))
    for i in range(2):
        for j in range(3):
            magnitude, phase = grid[2 * i, j], grid[2 * i + 1, j]
            G = MODEL.frf(F)[:, i, j]
            assert np.allclose(drawn(magnitude, "nonparametric")[:, 1], decibel(1.01 * G))
            assert np.allclose(drawn(magnitude, "difference")[:, 1], decibel(0.01 * G))
            assert np.allclose(drawn(magnitude, "total std")[:, 1], -20)  # 10 log10(1e-2)
            assert np.allclose(drawn(magnitude, "noise std")[:, 1], -40)
            f, level = drawn(magnitude, "model").T
            assert np.allclose(level, decibel(MODEL.frf(f)[:, i, j]))
            assert "model ± 2 std" in labels(magnitude)
            model = drawn(phase, "model")
            assert np.allclose(
                drawn(phase, "nonparametric")[:, 1], np.interp(F, *model.T), atol=1e-9
            )
            turn = np.exp(1j * np.radians(model[:, 1]))
            assert np.allclose(turn * 10 ** (level / 20), MODEL.frf(f)[:, i, j])
    assert grid[0, 0].get_title() == "x / a"
    assert grid[0, 0].get_ylabel() == "magnitude (dB, re 1 m/N)"
    assert grid[2, 2].get_ylabel() == "magnitude (dB)"
    assert grid[2, 0].get_ylabel() == "magnitude (dB, re 1 1/N)"
    assert grid[3, 0].get_xlabel() == "frequency (Hz)"


def test_band_of_the_model_is_two_standard_deviations():
    figure = linear_plots.frequency_response(MODEL, measured(MODEL))
    (band,) = figure.axes[0].collections
    vertices = band.get_paths()[0].vertices
    assert isinstance(vertices, np.ndarray)
    f = linear_plots.frequencies(MODEL, measured(MODEL))
    high = decibel(np.abs(MODEL.frf(f)) + 2 * MODEL.frf_std(f))[:, 0, 0]
    for x, y in zip(f, high, strict=True):
        assert np.abs(vertices - [x, y]).max(axis=1).min() < 1e-9


def test_unknown_parts_are_left_out():
    figure = linear_plots.frequency_response(SISO, measured(SISO, noise=None))
    assert labels(figure.axes[0]) == ["nonparametric", "difference", "total std", "model"]
    alone = linear_plots.frequency_response(SISO)
    rendered(alone)
    assert labels(alone.axes[0]) == ["model"]
    f = drawn(alone.axes[0], "model")[:, 0]
    assert (f[0], f[-1]) == pytest.approx((FS / 2000, FS / 2))


def test_wide_bands_have_a_logarithmic_axis():
    narrow = linear_plots.frequency_response(SISO, measured(SISO, f=F[(F >= 10) & (F <= 40)]))
    assert narrow.axes[0].get_xscale() == "linear"
    assert linear_plots.frequency_response(SISO, measured(SISO)).axes[0].get_xscale() == "log"
    one = linear_plots.frequency_response(SISO, measured(SISO, f=np.array([10.0])))
    rendered(one)
    assert len(drawn(one.axes[0], "nonparametric")) == 1


def test_a_resonance_is_drawn_at_its_top():
    pole = 0.9999 * np.exp(2j * np.pi * 0.1234567)
    A = np.array([[pole.real, pole.imag], [-pole.imag, pole.real]])
    sharp = replace(SISO, A=A, covariance=np.eye(9))
    f = drawn(linear_plots.frequency_response(sharp).axes[0], "model")[:, 0]
    assert np.abs(f - 12.34567).min() < 1e-9


def test_a_response_of_zero_is_a_gap_and_axes_end():
    frf = measured(SISO)
    G = frf.G.copy()
    G[3] = 0
    figure = linear_plots.frequency_response(SISO, replace(frf, G=G))
    rendered(figure)
    level = drawn(figure.axes[0], "nonparametric")[:, 1]
    assert np.flatnonzero(np.isnan(level)).tolist() == [3]
    exact = linear_plots.frequency_response(SISO, replace(frf, G=(1 + 1e-15) * SISO.frf(F)))
    low, high = exact.axes[0].get_ylim()
    assert high - low == pytest.approx(linear_plots.RANGE)


def test_variances_of_many_lines_are_averaged_over_stretches():
    f = np.linspace(10, 20, 1000)
    variance = np.arange(1000.0)
    figure_f, level = linear_plots._mean(f, variance)
    assert len(level) == linear_plots.STRETCHES
    assert np.allclose(10 ** (level / 10), variance.reshape(-1, 5).mean(axis=1))
    assert np.allclose(figure_f, f.reshape(-1, 5).mean(axis=1))


def test_poles_and_zeros_are_where_the_model_has_them():
    figure = linear_plots.poles_and_zeros(SISO)
    rendered(figure)
    poles, zeros = (drawn(figure.axes[0], label) for label in ("poles", "zeros"))
    assert np.allclose(sorted(poles[:, 1]), [-0.4, 0.4])
    expected = SISO.zeros()
    assert np.allclose(zeros, np.column_stack([expected.real, expected.imag]))
    channels = [line.get_label() for line in linear_plots.poles_and_zeros(MODEL).axes[0].lines]
    assert {"zeros x/a", "zeros phi/c", "poles"} <= set(channels)


def test_zeros_of_many_pairs_have_one_name():
    many = replace(
        MODEL, C=np.tile(MODEL.C, (2, 1)), D=np.tile(MODEL.D, (2, 1)),
        outputs=tuple(map(Channel, "stvw")),
        y_offset=np.zeros(4), covariance=None,
    )  # fmt: skip
    ax = linear_plots.poles_and_zeros(many).axes[0]
    assert labels(ax) == ["zeros of every pair", "poles"]
    assert len(drawn(ax, "zeros of every pair")) > len(drawn(ax, "poles"))


def test_zeros_far_out_are_counted():
    far = replace(SISO, D=np.array([[1e-3]]))
    ax = linear_plots.poles_and_zeros(far).axes[0]
    assert ax.get_title() == "1 zero(s) beyond the frame"
    left, right = ax.get_xlim()
    assert 1.0 < -left == right < np.abs(far.zeros()).max()


def test_distortion_shows_levels():
    def level(power: float) -> Level:
        return Level(F, np.full((len(F), 2), power), np.full((len(F), 2), 1e-8))

    frf = replace(measured(MODEL), distortion=Distortion(level(1.0), level(1e-4), level(1e-6)))
    figure = linear_plots.distortion(frf)
    rendered(figure)
    assert len(figure.axes) == 2
    for label, expected in {
        "output": 0,
        "odd distortion and noise": -40,
        "even distortion and noise": -60,
        "noise": -80,
    }.items():
        assert np.allclose(drawn(figure.axes[1], label)[:, 1], expected)
    assert figure.axes[0].get_ylabel() == "x (dB, re 1 m rms)"
    with pytest.raises(ValueError, match="by the method 'robust'"):
        linear_plots.distortion(measured(MODEL))


def test_order_scan_marks_the_order_chosen():
    def fitted(nx: int) -> lfrtorch.LinearModel:
        fit = lfrtorch.LinearFit("simulation", 0.5**nx, 3, "converged", 0.1, (1.0, 0.1, 0.01))
        return replace(SISO, A=np.zeros((nx, nx)), fit=fit)

    scan = lfrtorch.OrderScan((fitted(1), fitted(2)), (0.6, 0.3), True, 2)
    errors, carried = linear_plots.order_scan(scan).axes
    assert np.allclose(drawn(errors, "validation"), [[1, 0.6], [2, 0.3]])
    assert np.allclose(drawn(errors, "fitted")[:, 1], [0.5, 0.25])
    for ax in (errors, carried):
        assert ax.get_yscale() == "log"
        assert drawn(ax, "chosen: 2")[0, 0] == 2
    assert np.allclose(carried.get_lines()[0].get_ydata(), [1.0, 0.1, 0.01])
    by_length = linear_plots.order_scan(replace(scan, validated=False))
    assert "score (MDL)" in labels(by_length.axes[0])
