"""Residual analysis: tests that reject as often as they say, and find what is planted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from reference import measure, random_cell, random_model
from scipy import signal

import lfrtorch
from lfrtorch._support.tables import number
from lfrtorch._support.types import Array
from lfrtorch.analysis.correlation import autocorrelation, cross_correlation, lags_for, whitened
from lfrtorch.analysis.densities import noise_density, noise_of_periods, power_density
from lfrtorch.analysis.output_residuals import OutputResiduals
from lfrtorch.analysis.residual_analysis import Residuals, of_simulation
from lfrtorch.data.records import Channel, Record

pytestmark = pytest.mark.numeric

REPEATS = 600


def rates(p: list[float]) -> tuple[float, float]:
    """How often a test rejects at 1 % and at 5 %."""
    return float(np.mean(np.array(p) < 0.01)), float(np.mean(np.array(p) < 0.05))


NOISES: dict[str, Callable[[np.random.Generator, int], Array]] = {
    "normal": lambda rng, T: rng.standard_normal(T),
    "heavy tails": lambda rng, T: rng.standard_t(4, T),
    "bursts": lambda rng, T: (
        rng.standard_normal(T) * np.exp(signal.lfilter([0.3], [1.0, -0.95], rng.standard_normal(T)))
    ),
}


@pytest.mark.parametrize("kind", NOISES)
def test_white_noise_is_called_not_white_as_often_as_it_is_said(kind: str):
    """Standard errors of the rates are 0.4 % and 0.9 %; bounds are four of them away."""
    rng = np.random.default_rng(0)
    one, five = rates([autocorrelation(NOISES[kind](rng, 1000)).p for _ in range(REPEATS)])
    assert one <= 0.026
    assert 0.014 <= five <= 0.086


def dependence(e: Array, x: Array) -> float:
    """Probability of the cross-correlations of two signals, made white."""
    return cross_correlation(whitened(e), whitened(x), lags_for(len(e))).p


@pytest.mark.slow
def test_levels_of_both_tests_over_many_repeats():
    """Four standard errors of the rates, and 0.2 % of 1 % and 5 % for the length."""
    rng = np.random.default_rng(0)
    white = [autocorrelation(rng.standard_normal(2000)).p for _ in range(6000)]
    crossed = [dependence(*rng.standard_normal((2, 2000))) for _ in range(2000)]
    for p in (white, crossed):
        one, five = rates(p)
        error = 4 / np.sqrt(len(p))
        assert one == pytest.approx(0.01, abs=0.002 + 0.1 * error)
        assert five == pytest.approx(0.05, abs=0.002 + 0.22 * error)


SLOW = [1.0], [1.0, -0.98]
INPUTS: dict[str, Callable[[np.random.Generator, int], Array]] = {
    "slow": lambda rng, T: signal.lfilter(*SLOW, rng.standard_normal(T)),
    "steps": lambda rng, T: np.repeat(rng.standard_normal(T // 50), 50),
    "multisine": lambda rng, T: np.tile(narrow(T // 2, int(rng.integers(1 << 30))), 2),
}


def narrow(T: int, seed: int) -> Array:
    return lfrtorch.multisine(T, fs=1.0, band=(0.01, 0.15), seed=seed).u[0, :, 0]


@pytest.mark.parametrize("kind", INPUTS)
def test_slow_errors_are_called_dependent_on_inputs_no_more_often_than_it_is_said(kind: str):
    """Plain correlations of two such signals would exceed 1/√T almost always."""
    rng = np.random.default_rng(1)
    found = [
        dependence(signal.lfilter(*SLOW, rng.standard_normal(500)), INPUTS[kind](rng, 500))
        for _ in range(REPEATS // 3)
    ]
    one, five = rates(found)
    assert one <= 0.04  # four standard errors above 1 % and 5 %
    assert five <= 0.112


def test_an_autoregressive_signal_is_made_white():
    noise = np.random.default_rng(0).standard_normal(4000)
    found = whitened(signal.lfilter([2.0], [1.0, -1.6, 0.8], noise))
    assert np.std(found) == pytest.approx(2.0, rel=0.1)
    assert autocorrelation(found).p > 0.001
    assert np.corrcoef(found, noise[-len(found) :])[0, 1] > 0.99


@pytest.mark.parametrize("x", [np.zeros(100), np.ones(100), np.sin(0.3 * np.arange(100.0))])
def test_signals_without_surprises_are_no_division_by_zero(x: Array):
    noise = np.random.default_rng(0).standard_normal(100)
    assert np.isfinite(whitened(x)).all()
    assert dependence(noise, x) > 0.001
    assert dependence(x, np.zeros(100)) == 1.0


def residuals_of(y: Array, y_hat: Array, u: Array, **options) -> OutputResiduals:
    (part,) = of_simulation(Record(u, y, fs=10.0, **options), y_hat.reshape(-1, 1))
    return part


def planted(left: Callable[[Array], Array]) -> OutputResiduals:
    """Residuals of white noise and something of the input that the model has left out."""
    rng = np.random.default_rng(2)
    u = rng.uniform(-1.7, 1.7, 3000)
    y_hat = signal.lfilter([0.0, 1.0], [1.0, -0.6], u)
    y = y_hat + rng.standard_normal(3000)
    y[3:] += left(u)[:-3]
    return residuals_of(y, y_hat, u)


def test_what_a_model_left_out_is_found_and_said():
    nothing = planted(lambda u: 0.0 * u)
    assert min(nothing.p.values()) > 0.01
    assert nothing.verdict == "white, and independent of the inputs"
    linear = planted(lambda u: 0.3 * u)
    assert linear.p["inputs"] < 1e-6
    assert linear.p["even"] > 0.01
    assert linear.linear[0].largest == 3
    assert linear.linear[0].outside.tolist() == [3]
    assert linear.verdict.startswith("white; depends on u still: 0.2")
    even = planted(lambda u: 0.3 * u**2)
    assert even.p["even"] < 1e-6
    assert "an even nonlinearity of u is left" in even.verdict
    odd = planted(lambda u: u**3)
    assert odd.p["odd"] < 1e-6
    assert "an odd nonlinearity" in odd.verdict
    u = np.random.default_rng(3).normal(size=3000)
    slow = residuals_of(odd.error.cumsum(), 0 * odd.error, u)
    assert slow.verdict.startswith("not white: ")
    assert slow.verdict.endswith("independent of the inputs")


def test_noise_that_grows_with_the_input_is_no_nonlinearity():
    rng = np.random.default_rng(4)
    u = rng.standard_normal(4000)
    found = residuals_of((1 + np.abs(u)) * rng.standard_normal(4000), 0.1 * u, u)
    assert found.p["even"] > 0.01


def test_fit_is_that_of_compare_and_skipped_samples_do_not_count():
    rng = np.random.default_rng(0)
    y, u = rng.standard_normal((2, 200))
    y_hat = y + 0.1 * rng.standard_normal(200)
    y_hat[:50] = 1e3
    part = residuals_of(y, y_hat, u, skip=50)
    e, deviation = y[50:] - y_hat[50:], y[50:] - y[50:].mean()
    assert part.fit == pytest.approx(100 * (1 - np.linalg.norm(e) / np.linalg.norm(deviation)))
    assert part.error.tolist() == e.tolist()
    assert part.bias == pytest.approx(e.mean())


def test_each_record_and_output_of_either_model_has_its_row():
    model = random_model(random_cell(nu=2, ny=2))
    quiet = replace(measure(model, 150), name="quiet")
    loud = replace(measure(model, 150, seed=1), name="loud")
    loud = replace(loud, y=loud.y + np.random.default_rng(0).standard_normal(loud.y.shape))
    found = lfrtorch.analysis.residuals(model, [quiet, loud])
    assert [(part.record, part.output.name) for part in found.parts] == [
        ("quiet", "y1"), ("quiet", "y2"), ("loud", "y1"), ("loud", "y2"),
    ]  # fmt: skip
    assert found.worst == "loud"
    assert found.parts[0].verdict == "no error beyond rounding"
    assert [len(part.linear) for part in found.parts] == [2] * 4
    shown = str(found)
    assert all(part.verdict.split(":")[0] in shown for part in found.parts)
    assert set(found.entries()["loud"]) == {"y1", "y2"}
    figure = found.plot()
    assert figure.get_suptitle() == "loud: residuals"
    assert len(figure.axes) == 8
    linear = lfrtorch.estimate_bla(loud, nx=2)
    assert lfrtorch.analysis.residuals(linear, loud).of("loud")[0].fit < 100
    with pytest.raises(lfrtorch.InputError, match="give loud"):
        lfrtorch.analysis.residuals(linear, loud).of("quiet")


def test_of_many_rows_the_worst_are_printed():
    rng = np.random.default_rng(0)
    u, y = rng.standard_normal((2, 100))
    parts = (residuals_of(y, (1 - k / 100) * y, u, name=f"r{k}") for k in range(1, 31))
    lines = str(Residuals(tuple(parts))).splitlines()
    assert [line.split()[0] for line in lines[2:26]] == [f"r{k}" for k in range(7, 31)]
    assert "6 more of a better fit." in lines


def test_the_noise_of_periods_has_its_density_beside_that_of_the_error():
    rng = np.random.default_rng(0)
    u = np.tile(rng.standard_normal(1000), 8)
    noise = signal.lfilter([0.2], [1.0, -0.8], rng.standard_normal(8000))
    y = signal.lfilter([1.0], [1.0, -0.5], np.tile(u, 2))[8000:]
    record = Record(u, y + noise, fs=50.0, start="periodic", period=1000)
    (part,) = of_simulation(record, y[:, None])
    assert part.noise is not None
    assert part.noise == pytest.approx(np.std(noise), rel=0.05)
    assert part.verdict.split()[0] == number(part.rms / part.noise)
    densities = part.densities
    assert densities.noise is not None
    assert densities.noise_frequencies is not None
    band = densities.noise_frequencies[1] - densities.noise_frequencies[0]
    assert densities.noise.sum() * band == pytest.approx(np.var(noise), rel=0.15)
    at = np.interp(densities.noise_frequencies, densities.frequencies, densities.error)
    assert np.median(densities.noise / at) == pytest.approx(1.0, abs=0.15)
    assert noise_of_periods([record[:1500]]) is None
    assert noise_density(record[:1500]) is None


def test_density_integrates_to_the_variance():
    x = np.random.default_rng(0).standard_normal((5000, 2)) * [1.0, 3.0]
    f, density = power_density(x, 20.0)
    assert density.sum(axis=0) * f[1] == pytest.approx([1.0, 9.0], rel=0.1)


def test_what_cannot_be_analysed_is_refused_and_a_model_that_runs_away_is_said():
    model = random_model(random_cell())
    record = measure(model, 100)
    for given, words in (
        (record[:19], "has 19 scored samples; residuals need 20"),
        (Record(record.u, record.y, fs=3.0), "sampled at 3.0 Hz"),
    ):
        with pytest.raises(lfrtorch.InputError, match=words):
            lfrtorch.analysis.residuals(model, given)
    with pytest.raises(lfrtorch.InputError, match=r"model is LFR.*; give a Model"):
        lfrtorch.analysis.residuals(model.lfr, record)  # pyright: ignore[reportArgumentType]
    with pytest.raises(lfrtorch.InputError, match="lags is 0"):
        lfrtorch.analysis.residuals(model, record, lags=0)
    y_hat = record.y.copy()
    y_hat[50:] = np.inf
    found = Residuals(of_simulation(record, y_hat))
    assert found.parts[0].verdict == "the simulation diverges"
    assert "diverges" in str(found)
    assert len(found.plot().axes) == 4


def test_lags_are_those_asked_for_and_units_have_prefixes():
    model = random_model(random_cell())
    record = measure(model, 100)
    noisy = replace(record, y=record.y + 1e-4 * np.sin(9.0 * np.arange(100.0)[:, None] ** 2))
    found = lfrtorch.analysis.residuals(
        replace(model, outputs=(Channel("x", "m"),)), replace(noisy, outputs=(Channel("x", "m"),)),
        lags=30,
    )  # fmt: skip
    assert found.parts[0].whiteness.lags.tolist() == list(range(1, 31))
    assert found.parts[0].linear[0].lags.tolist() == list(range(-30, 31))
    assert "µm" in str(found)


def test_units_do_not_change_what_is_found():
    rng = np.random.default_rng(0)
    u, y = rng.standard_normal((2, 300, 1))
    y_hat = 0.5 * y + 0.1 * np.roll(u, 1, axis=0)
    ((one,), (other,)) = (
        of_simulation(Record(a * u, b * y, fs=1.0), b * y_hat)
        for a, b in ((1.0, 1.0), (2.0**320, 2.0**-320))
    )
    for name in ("linear", "even", "odd"):
        (a,), (b,) = getattr(one, name), getattr(other, name)
        assert np.array_equal(a.values, b.values)
        assert np.array_equal(a.bounds, b.bounds)
        assert a.p == b.p
    assert np.array_equal(one.whiteness.values, other.whiteness.values)
