"""Numbers of signals before any fit."""

import numpy as np
import pytest
from scipy.signal import lfilter

from lfrtorch import multisine
from lfrtorch.data.records import Channel
from lfrtorch.survey.measurement import survey_measurement
from lfrtorch.survey.signal import longest_run

pytestmark = pytest.mark.numeric
T, FS = 4096, 100.0


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def test_level_range_and_gaps(rng):
    u = 2.0 + 0.5 * rng.standard_normal(T)
    y = u.copy()
    y[[7, 100, 101, 102]] = np.nan
    found = survey_measurement(u, y, FS, inputs=[Channel("force", "N")])
    (force,), (response,) = found.inputs, found.outputs
    assert (force.channel, response.channel) == (Channel("force", "N"), Channel("y1"))
    assert (force.samples, force.missing, force.gap) == (T, 0, 0)
    # Sums in another order: eps times a few.
    assert (force.mean, force.rms) == pytest.approx((u.mean(), u.std()), rel=1e-12)
    assert (force.minimum.value, force.maximum.value) == (u.min(), u.max())
    assert (force.minimum.samples, force.minimum.run, force.values) == (1, 1, T)
    assert (response.missing, response.gap, response.values) == (4, 3, T - 4)
    assert response.mean == pytest.approx(np.nanmean(y), rel=1e-12)
    assert found.whole == slice(103, T)
    assert not force.clipped
    assert not response.clipped


@pytest.mark.parametrize("fs", [None, FS])
def test_band_of_a_multisine(fs):
    rate = fs or 1.0
    u = multisine(T, fs=rate, band=(0.05 * rate, 0.2 * rate), seed=0).u[0, :, 0]
    low, high = survey_measurement(u, u, fs).inputs[0].band or (0, 0)
    # Of the band, half a percent of the power lies beyond either end.
    assert low == pytest.approx((0.05 + 0.005 * 0.15) * rate, abs=0.002 * rate)
    assert high == pytest.approx((0.2 - 0.005 * 0.15) * rate, abs=0.002 * rate)


def test_noise_by_periods_leaves_the_transient_out(rng):
    u = np.tile(rng.standard_normal(512), 8)
    y = lfilter([0, 1], [1, -0.9], u) + 0.05 * rng.standard_normal(T)
    found = survey_measurement(u, y)
    (source,), (output,) = found.inputs, found.outputs
    assert (source.period, output.period) == (512, 512)
    assert (source.method, output.method) == ("periods", "periods")
    assert source.noise == pytest.approx(0, abs=1e-12)
    # 512 times 6 degrees of freedom: a relative standard deviation of 1.3 %.
    assert output.noise == pytest.approx(0.05, rel=0.05)
    transient = survey_measurement(u, lfilter([0, 1], [1, -0.9], u)).outputs[0]
    assert transient.noise == pytest.approx(0, abs=1e-5 * transient.rms)


def test_noise_by_the_quiet_part_of_the_spectrum(rng):
    u = multisine(T, band=(0.01, 0.1), seed=0).u[0, :, 0]
    output = survey_measurement(u, u + 0.01 * rng.standard_normal(T)).outputs[0]
    assert output.method == "spectrum"
    assert output.noise == pytest.approx(0.01, rel=0.2)
    white = survey_measurement(u, rng.standard_normal(T)).outputs[0]
    assert (white.noise, white.method) == (None, "")


@pytest.mark.parametrize("noise", [0.01, 0.1])
def test_noise_of_an_output_whose_spectrum_is_nowhere_quiet(noise: float, rng):
    u = rng.standard_normal((T, 2))
    y = lfilter([0, 1], [1, -0.9], u @ [1.0, 0.5])
    output = survey_measurement(u, y + noise * rng.standard_normal(T)).outputs[0]
    assert output.noise == pytest.approx(noise, rel=0.5)


def test_signals_without_roles_have_periods_of_their_own(rng):
    both = np.column_stack([np.tile(rng.standard_normal(64), 64), rng.standard_normal(T)])
    found = survey_measurement(np.empty((T, 0)), both)
    assert found.inputs == ()
    assert [one.period for one in found.signals] == [64, None]


@pytest.mark.parametrize("y", [np.full(50, np.nan), np.ones(50), np.arange(3.0), np.arange(1.0)])
def test_signals_that_say_nothing(y):
    one = survey_measurement(np.zeros(len(y)), y).outputs[0]
    assert one.noise is None
    assert one.band is None
    assert one.values == len(np.unique(y[np.isfinite(y)]))
    assert not one.clipped


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"y": np.zeros(9)}, "the inputs have 10 samples and the outputs 9"),
        ({"inputs": [Channel("a"), Channel("b")]}, "2 names are given for 1 channels"),
    ],
)
def test_refused(more, message):
    arguments = {"u": np.zeros(10), "y": np.zeros(10)} | more
    with pytest.raises(ValueError, match=message):
        survey_measurement(**arguments)


@pytest.mark.parametrize(
    ("holds", "run"), [("", (0, 0)), ("00", (0, 0)), ("1", (0, 1)), ("0110111", (4, 3))]
)
def test_longest_run(holds, run):
    assert longest_run(np.array([h == "1" for h in holds], dtype=bool)) == run
