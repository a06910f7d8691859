"""Bouc-Wen benchmark: the simulator against the equations and the official tests, the procedure."""

from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.io import savemat
from scipy.signal import firwin, freqz, resample

from lfrtorch.data import metrics
from lfrtorch.datasets import boucwen, official

pytestmark = pytest.mark.numeric

PERIOD, RATIO, SWEEP = 8192, 20, 153_000
FOLDER = "BoucWen/BoucWenFiles/Test signals/Validation signals"


def difference(a, b):
    """Rms difference relative to the rms of b."""
    return np.sqrt(np.mean((np.ravel(a) - np.ravel(b)) ** 2) / np.mean(np.ravel(b) ** 2))


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """An empty cache folder, so that no test depends on the user's downloads."""
    folder = tmp_path / "cache"
    monkeypatch.setattr(official, "cache", lambda: folder)
    return folder


@pytest.fixture(scope="module")
def simulated():
    """The default data set without official files."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(official, "cache", lambda: Path("nowhere"))
        return boucwen.load()


@pytest.fixture(scope="module")
def displacement():
    """Of the sweep test at 15 kHz: three million steps, a third of a second."""
    return boucwen._newmark(boucwen.sweep())


@pytest.fixture
def short_sweep(shorter):
    """The simulated sweep test is of 3000 samples."""
    shorter(sweep=3000)


@pytest.fixture
def brief(shorter, short_sweep):
    """Nothing else that is simulated takes long: transients of 150 samples are left out."""
    shorter(period=150)


def official_files(root, **replaced):
    """Files of the official layout below ``root``: names, shapes, but samples of our own."""
    folder = root / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    for i, (stem, samples) in enumerate(
        [(f"{c}val_{n}", T) for n, T in (("multisine", PERIOD), ("sinesweep", SWEEP)) for c in "uy"]
    ):
        signal = np.random.default_rng(i).normal(size=(1, samples))
        savemat(folder / f"{stem}.mat", {stem: replaced.get(stem, signal)})
    return folder


# --- the simulator --------------------------------------------------------------------------


def test_equations_of_motion():
    """Newmark against an adaptive Runge-Kutta method on the equations as published."""

    def force(t):
        return 90 * np.cos(2 * np.pi * 31 * t) + 60 * np.sin(2 * np.pi * 47 * t)

    def rates(t, state):
        y, v, z = state
        hysteresis = 5e4 * v - 1e3 * (0.8 * abs(v) * z - 1.1 * v * abs(z))
        return v, (force(t) - 10 * v - 5e4 * y - z) / 2, hysteresis

    t = np.arange(3000) / 15e3
    exact = solve_ivp(rates, (0, t[-1]), np.zeros(3), t_eval=t, rtol=1e-6, atol=1e-10).y[0]
    # Newmark lengthens a period by (w h)^2 / 12: 2e-5 at 36 Hz, 1e-3 of phase over 7 periods.
    assert difference(boucwen._newmark(force(t)), exact) < 1e-3


def test_decimation_keeps_a_straight_line():
    """Odd mirror images continue a straight line, so that it passes up to its very ends."""
    line = 3 - 0.25 * np.arange(400.0)
    for factor in (2, 5, 20):  # 31 products of 100 at most: rounding is below 31 · 100 eps = 7e-13
        assert np.abs(boucwen._decimate(line, factor) - line[::factor]).max() < 1e-11


@pytest.mark.parametrize("factor", [2, 5, 20])
def test_decimation_filter(factor):
    """A tone comes through with the published filter's gain and without delay."""
    w = 0.6 * np.pi / factor
    tone = np.sin(w * np.arange(1000))
    gain = abs(freqz(firwin(31, 1 / factor, window="hamming"), worN=[w])[1][0])
    inner = slice(15, -15)  # where the taps reach no end
    expected = gain * tone[::factor]
    # Each sample's phase w k is rounded to half a spacing; 31 products are added.
    rounding = 2 * np.spacing(w * tone.size) + 31 * np.finfo(float).eps
    assert np.abs(boucwen._decimate(tone, factor) - expected)[inner].max() < rounding


@pytest.mark.data
def test_official_multisine(official):
    test = official(boucwen.load, samples=150, selection_rms=[]).tests[0]
    if test.source != "official":
        pytest.skip("no uval_multisine.mat below root")
    assert (test.name, test.source, test.samples) == ("multisine", "official", PERIOD)
    u = np.tile(resample(test.u[:, 0], PERIOD * RATIO), 3)
    y = boucwen.simulate(u)[PERIOD : 2 * PERIOD]
    assert difference(y, test.y) < 1e-9  # measured: 3e-13


@pytest.mark.data
def test_official_sweep(official, displacement):
    test = official(boucwen.load, samples=150, selection_rms=[]).tests[1]
    if test.source != "official":
        pytest.skip("no uval_sinesweep.mat below root")
    assert (test.name, test.source, test.samples) == ("sweep", "official", SWEEP)
    assert difference(boucwen.sweep()[::RATIO], test.u) < 1e-9  # measured: 3e-12
    assert difference(boucwen._decimate(displacement, RATIO), test.y) < 1e-9  # measured: 1e-12


def test_floor_of_the_sweep(displacement):
    """A perfect model of the estimation data's filters scores 2.35e-6 m on the sweep test."""
    one_step, three_steps = boucwen._decimate(displacement, RATIO), displacement
    for factor in (2, 2, 5):
        three_steps = boucwen._decimate(three_steps, factor)
    assert difference(three_steps, one_step) == pytest.approx(3.54e-3, rel=0.01)
    assert np.sqrt(np.mean((three_steps - one_step) ** 2)) == pytest.approx(2.35e-6, rel=0.01)


def test_simulated_sweep(simulated, displacement):
    test = simulated.tests[1]
    assert np.array_equal(test.u[:, 0], boucwen.sweep()[::RATIO])
    assert np.array_equal(test.y[:, 0], boucwen._decimate(displacement, RATIO))


def test_estimation_filters_are_the_default():
    u = boucwen.sweep()[: 200 * RATIO]
    y = boucwen._newmark(u)
    for factor in (2, 2, 5):
        y = boucwen._decimate(y, factor)
    assert np.array_equal(boucwen.simulate(u), y)


def test_sweep_input():
    u = boucwen.sweep()
    assert u.shape == (SWEEP * RATIO,)
    assert np.abs(u).max() == pytest.approx(40, rel=1e-6)
    # Upward zero crossings count the periods: 18 t + t^2 / 12 of them until t.
    for begin, end in ((0, 6), (100, 106), (198, 204)):
        part = u[begin * 15_000 : end * 15_000]
        crossings = np.count_nonzero((part[:-1] < 0) & (part[1:] >= 0))
        assert abs(crossings - (18 * (end - begin) + (end**2 - begin**2) / 12)) <= 1


# --- the estimation procedure ---------------------------------------------------------------


@pytest.mark.parametrize(
    ("samples", "first", "last"), [(8192, 54, 1639), (150, 1, 30), (1000, 6, 200), (901, 6, 181)]
)
def test_excited_lines(samples, first, last):
    u = boucwen.multisine(samples=samples, rms=20.0, seed=4)
    assert u.shape == (samples * RATIO,)
    assert np.std(u, ddof=1) == pytest.approx(20, rel=1e-12)
    magnitude = np.abs(np.fft.rfft(u))
    lines = np.arange(magnitude.size)
    excited = (lines >= first) & (lines <= last)
    level = np.median(magnitude[excited])
    assert np.abs(magnitude[excited] / level - 1).max() < 1e-9
    assert np.abs(magnitude[~excited] / level).max() < 1e-9


def test_phases_are_uniform():
    spectrum = np.fft.rfft(boucwen.multisine(seed=5))[54:1640]
    direction = spectrum / np.abs(spectrum)
    for harmonic in (1, 2, 3):  # a mean of n unit vectors is below 4 / sqrt(n)
        assert abs(np.mean(direction**harmonic)) < 4 / np.sqrt(direction.size)
    assert np.ptp(np.angle(spectrum)) > 0.98 * 2 * np.pi


def test_default_records(simulated):
    (train,), (validation,), levels = simulated.train, simulated.validation, simulated.selection
    assert [record.name for record in levels] == ["selection_25", "selection_10"]
    assert [np.std(r.u) for r in levels] == pytest.approx([25, 10], rel=1e-4)
    assert np.array_equal(levels[1].u[:, 0], boucwen.multisine(rms=10.0, seed=1002)[::RATIO])
    for record, seed in ((train, 0), (validation, 1000)):
        assert record.u.shape == record.y.shape == (PERIOD, 1)
        assert (record.fs, record.start, record.skip) == (750.0, "periodic", 0)
        assert record.source == "simulated"
        assert [str(c) for c in (*record.inputs, *record.outputs)] == ["u (N)", "y (m)"]
        assert np.array_equal(record.u[:, 0], boucwen.multisine(seed=seed)[::RATIO])
        assert np.std(record.u) == pytest.approx(50, rel=1e-4)
        assert np.std(record.y) == pytest.approx(6.6e-4, rel=0.1)
    assert (train.name, validation.name) == ("train", "validation")
    assert (simulated.name, simulated.noise_rms) == ("boucwen", 8e-6)


def test_several_training_realisations(simulated, short_sweep):
    few = boucwen.load(rms=[50, 25, 50], selection_rms=[])
    first, second, third = few.train
    assert [r.name for r in (first, second, third)] == ["train", "train_1", "train_2"]
    assert np.array_equal(first.y, simulated.train[0].y)
    assert [np.std(r.u) for r in (second, third)] == pytest.approx([25, 50], rel=1e-4)
    inputs = [r.u[:, 0] for r in (first, second, third, *simulated.validation)]
    assert np.abs(np.corrcoef(inputs) - np.eye(4)).max() < 0.3


def test_tests_are_labelled(simulated):
    multisine, sweep = simulated.tests
    said = [(record.name, record.source, record.start) for record in simulated.tests]
    assert said == [("multisine", "simulated", "periodic"), ("sweep", "simulated", "zero")]
    assert (multisine.skip, sweep.skip) == (0, 2000)
    assert (multisine.samples, sweep.samples) == (PERIOD, SWEEP)
    u = boucwen.multisine(seed=2000)
    assert np.array_equal(multisine.u[:, 0], u[::RATIO])
    assert np.array_equal(multisine.y[:, 0], boucwen.simulate(np.tile(u, 3))[PERIOD : 2 * PERIOD])


def test_same_seed_same_bits(simulated, short_sweep):
    again = boucwen.load()
    pairs = [(simulated.tests[0], again.tests[0])]
    for part in ("train", "validation", "selection"):
        pairs += zip(getattr(simulated, part), getattr(again, part), strict=True)
    for a, b in pairs:
        assert np.array_equal(a.u, b.u)
        assert np.array_equal(a.y, b.y)
    other = boucwen.load(seed=1, validation_seed_offset=50, noise_rms=0.0, selection_rms=[])
    assert np.array_equal(other.tests[1].y, again.tests[1].y)
    drawn = [simulated.train, simulated.validation, simulated.tests]
    drawn += [other.train, other.validation, other.tests]
    inputs = [records[0].u[:, 0] / 50 for records in drawn]
    assert np.abs(np.corrcoef(inputs) - np.eye(6)).max() < 0.3  # sd of one is about 1 / sqrt(800)
    assert np.array_equal(other.validation[0].u[:, 0], boucwen.multisine(seed=51)[::RATIO])


def test_noise(simulated, short_sweep):
    """The stated rms, Gaussian and white but for the filters; same input; none on the tests."""
    clean = boucwen.load(noise_rms=0.0, selection_rms=[])
    twice = boucwen.load(noise_rms=16e-6, selection_rms=[])
    noise = []
    for part in ("train", "validation"):
        with_noise, without = getattr(simulated, part)[0], getattr(clean, part)[0]
        assert np.array_equal(with_noise.u, without.u)
        noise.append((with_noise.y - without.y)[:, 0])
        assert difference(getattr(twice, part)[0].y - without.y, 2 * noise[-1]) < 1e-9
    samples = np.concatenate(noise)
    # The sd of an rms over n samples is 1 / sqrt(2 n) = 0.55 %: 4 sd leave 8e-6 m far outside.
    assert np.sqrt(np.mean(samples**2)) == pytest.approx(7.35e-6, rel=4 / np.sqrt(2 * samples.size))
    kurtosis = np.mean(samples**4) / np.mean(samples**2) ** 2
    assert kurtosis == pytest.approx(3, abs=4 * np.sqrt(24 / samples.size))
    correlation = np.corrcoef(noise)[0, 1]
    assert abs(correlation) < 4 / np.sqrt(PERIOD)
    assert metrics.rmse(clean.train[0], simulated.train[0].y) == pytest.approx(7.35e-6, rel=0.04)
    assert np.array_equal(simulated.tests[0].y, clean.tests[0].y)


def test_noise_band():
    """The noise at 15 kHz fills 0 to 375 Hz: behind the filters it has their gain."""
    n = 8 * PERIOD
    noise = boucwen.simulate(np.zeros(n * RATIO), noise_rms=8e-6, seed=1)
    power = np.abs(np.fft.rfft(noise)) ** 2 / n
    f = np.fft.rfftfreq(n, 1 / 750)
    gain, rate = np.ones(f.size), 15e3
    for factor in (2, 2, 5):
        gain *= np.abs(freqz(firwin(31, 1 / factor, window="hamming"), worN=f, fs=rate)[1])
        rate /= factor
    for low, high in ((1, 50), (50, 200), (200, 300), (300, 340), (345, 370)):
        band = (f > low) & (f < high)
        expected = 8e-6**2 * np.mean(gain[band] ** 2)
        # A line's power has relative sd 1, a band's 1 / sqrt(lines): 2 % or less.
        assert np.mean(power[band]) == pytest.approx(expected, rel=4 / np.sqrt(band.sum()))


@pytest.mark.parametrize("samples", [8192, 300])
def test_steady_state(samples, short_sweep):
    """One more period changes nothing, at any length of period."""
    quick = boucwen.load(samples=samples, noise_rms=0.0, selection_rms=[])
    (record,) = quick.train
    u = boucwen.multisine(samples=samples)
    periods = boucwen.simulate(np.tile(u, 8192 // samples + 4)).reshape(-1, samples)
    assert difference(record.y, periods[-3]) < 1e-9
    assert difference(periods[-2], periods[-3]) < 1e-9
    assert difference(periods[0], periods[-2]) > 1e-3  # the transient is there to be dropped


def test_published(simulated):
    numbers = {(p.label, p.sizes): p.scores for p in simulated.published}
    assert numbers["NL-LFR (paper)", (2, 1)] == {"multisine": 0.72e-5, "sweep": 0.32e-5}
    assert numbers["linear (paper)", None]["sweep"] == 17.7e-5
    assert numbers["decoupled PNLSS", None]["multisine"] == 1.34e-5
    assert len(numbers) == 5


# --- the official files ---------------------------------------------------------------------


def test_files_are_used(brief, tmp_path):
    official_files(tmp_path)
    multisine, sweep = boucwen.load(root=str(tmp_path), samples=150, selection_rms=[]).tests
    signals = (multisine.u, multisine.y, sweep.u, sweep.y)
    for i, signal in enumerate(signals):
        assert np.array_equal(signal[:, 0], np.random.default_rng(i).normal(size=len(signal)))
    assert [len(signal) for signal in signals] == [PERIOD, PERIOD, SWEEP, SWEEP]
    assert (multisine.source, multisine.start, multisine.skip) == ("official", "periodic", 0)
    assert (sweep.source, sweep.start, sweep.skip) == ("official", "zero", 2000)


def test_cache_is_used(brief, cache):
    official_files(cache)
    assert [r.source for r in boucwen.load(samples=150).tests] == ["official", "official"]


def test_one_test_without_its_files_is_simulated(brief, tmp_path):
    folder = official_files(tmp_path)
    for letter in "uy":
        (folder / f"{letter}val_multisine.mat").unlink()
    multisine, sweep = boucwen.load(root=tmp_path, samples=150, selection_rms=[]).tests
    assert (multisine.source, sweep.source) == ("simulated", "official")


def test_refused_root(tmp_path):
    (tmp_path / "BoucWen").mkdir()
    for root in (tmp_path, tmp_path / "absent"):
        with pytest.raises(FileNotFoundError, match=r"uval_multisine\.mat") as refusal:
            boucwen.load(root=root)
        assert f"'{root}'" in str(refusal.value)
        assert FOLDER in str(refusal.value)


def test_refused_half_a_pair(brief, tmp_path):
    missing = official_files(tmp_path) / "yval_sinesweep.mat"
    missing.unlink()
    with pytest.raises(FileNotFoundError, match=r"yval_sinesweep\.mat' is missing"):
        boucwen.load(root=tmp_path, samples=150, selection_rms=[])


@pytest.mark.parametrize(
    ("stem", "signal", "match"),
    [
        ("uval_multisine", np.zeros((1, 8191)), r"shape \(1, 8191\).*expected \(1, 8192\)"),
        ("yval_sinesweep", np.zeros((1, 8192)), r"expected \(1, 153000\)"),
    ],
)
def test_refused_signals(brief, tmp_path, stem, signal, match):
    official_files(tmp_path, **{stem: signal})
    with pytest.raises(ValueError, match=match) as refusal:
        boucwen.load(root=tmp_path, samples=150, selection_rms=[])
    assert f"{stem}.mat'" in str(refusal.value)
    assert str(refusal.value).endswith("and download them again.")


@pytest.mark.parametrize(
    ("u", "options", "match"),
    [
        (np.zeros((100, 1)), {}, r"shape \(100, 1\)"),
        (np.zeros(90), {}, "multiple of 20"),
        (np.zeros(60), {}, "at least 80"),
        (np.full(100, np.nan), {}, "NaN"),
        (np.zeros(100), {"factors": (2, 5)}, r"factors \(2, 5\).*multiply to 20"),
        (np.zeros(100), {"factors": (1, 20)}, "factors of 2 or more"),
    ],
)
def test_refused_forces(u, options, match):
    with pytest.raises(ValueError, match=match):
        boucwen.simulate(u, **options)
