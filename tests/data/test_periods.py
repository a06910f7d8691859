"""Periods and transients: found where they are, and not where there are none."""

import numpy as np
import pytest
import scipy.signal
from hypothesis import given, settings
from hypothesis import strategies as st

from lfrtorch.data.excitation import multisine
from lfrtorch.data.periods import find_period, find_transient

pytestmark = pytest.mark.numeric

N = 256


def multi(seed=0, samples=N) -> np.ndarray:
    return multisine(samples, fs=1.0, band=(0.01, 0.3), seed=seed).u[0][:, 0]


def noise(samples, *, seed, size=1.0) -> np.ndarray:
    return size * np.random.default_rng(seed).normal(size=samples)


# --- periods --------------------------------------------------------------------------------


@pytest.mark.parametrize("T", [2 * N, 2 * N + 1, 3 * N - 1, 5 * N, 40 * N + 17])
@pytest.mark.parametrize("offset", [0.0, 1e4])
def test_exact_period(T, offset):
    assert find_period(offset + np.resize(multi(), T)) == N


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("T", [2 * N, 5 * N + 30])
def test_period_in_noise(T, seed):
    u = np.resize(multi(seed), T)
    assert find_period(u + noise(T, seed=seed, size=0.1 * float(np.std(u)))) == N


@pytest.mark.parametrize("scale", [2.0**1000, 2.0**-1040, 1.0])
def test_period_of_signals_whose_squares_are_no_numbers(scale: float):
    u = np.tile(np.random.default_rng(0).normal(size=50), 4)
    assert find_period(scale * u) == 50


def test_period_of_a_slow_signal_in_noise():
    k = np.arange(100_000)
    u = np.sin(2 * np.pi * k / 12_345) + noise(len(k), seed=0, size=0.05)
    found = find_period(u)
    assert found is not None
    assert abs(found - 12_345) < 12  # 0.1 %: D is flat about the period of a slow sine


def test_fewer_than_two_periods_are_none():
    assert find_period(np.resize(multi(), 2 * N - 1)) is None


def test_other_periodic_signals():
    k = np.arange(3000)
    assert find_period(np.sin(2 * np.pi * k / 50.0)) == 50
    assert find_period(np.sin(2 * np.pi * k / 50.5)) == 101
    assert find_period(np.where(k % 64 < 32, 1.0, -1.0)) == 64
    assert find_period(np.resize(scipy.signal.max_len_seq(7)[0] * 1.0, 900)) == 127
    assert find_period(np.repeat(np.resize(scipy.signal.max_len_seq(6)[0], 300), 5) * 1.0) == 315
    assert find_period(np.resize(scipy.signal.chirp(np.arange(500), 0.01, 499, 0.2), 1600)) == 500
    printed = np.asarray(np.round(np.resize(multi(), 4 * N), 3), np.float64)
    assert find_period(printed) == N


def test_channels_repeat_together():
    k = np.arange(600)
    fast, slow = np.sin(2 * np.pi * k / 20), np.sin(2 * np.pi * k / 75)
    assert find_period(np.stack([fast, slow], axis=1)) == 300
    assert find_period(np.stack([fast, np.ones(600)], axis=1)) == 20
    assert find_period(np.stack([fast, noise(600, seed=1)], axis=1)) is None


@pytest.mark.parametrize("seed", range(20))
def test_noise_has_no_period(seed):
    white = noise(2000, seed=seed)
    narrow = scipy.signal.lfilter([1], [1, -2 * 0.995 * np.cos(0.2), 0.995**2], white)  # Q = 20
    for u in (white, white[:60], np.cumsum(white), narrow, np.repeat(white[:50], 40)):
        assert find_period(u) is None


@pytest.mark.parametrize(
    "u",
    [
        np.ones(500),
        np.zeros(500),
        np.full(500, 0.1) + 1e-16,
        np.arange(500.0),
        np.arange(500.0) >= 250,
        np.arange(500) == 20,
        np.exp(-np.arange(500) / 50),
        scipy.signal.chirp(np.arange(5000), 0.001, 4999, 0.4),
        scipy.signal.chirp(np.arange(5000), 0.05, 4999, 0.052),
        np.concatenate([np.resize(multi(0), 3 * N), np.resize(multi(1), 3 * N)]),
        np.concatenate([np.resize(multi(), 3 * N), 2 * np.resize(multi(), 3 * N)]),
        np.sin(2 * np.pi * np.arange(350) / 100.3),
        np.array([1.0, 2.0]),
    ],
    ids=range(13),
)
def test_what_does_not_repeat(u):
    assert find_period(u.astype(float)) is None


@pytest.mark.parametrize("periods", [2, 3, 4, 8, 9, 12])
@pytest.mark.parametrize("size", [0.0, 0.01, 0.1])
def test_period_of_an_input_that_begins_with_a_transient(periods, size):
    """A structure acts back on its shaker: the first period of a measured force is another."""
    k = np.arange(periods * N)
    u = np.resize(multi(), len(k)) / np.std(multi())
    for amplitude in (0.1, 0.3):
        transient = amplitude * np.exp(-k / 60) * np.sin(0.3 * k)
        assert find_period(u + transient + noise(len(k), seed=1, size=size)) == N


def test_period_of_an_output_that_begins_with_a_transient():
    for size in (0.0, 0.01, 0.05):
        assert find_period(settling(9, 1e-4, size)) == N


@pytest.mark.parametrize("seed", range(5))
def test_period_of_an_amplifier_whose_gain_wanders(seed):
    gain = 1 + np.cumsum(noise(12 * N, seed=seed, size=2e-4))
    assert find_period(np.resize(multi(), 12 * N) * gain + noise(12 * N, seed=9, size=2e-3)) == N


def test_a_shorter_period_that_explains_less_is_none():
    k = np.arange(4 * N)
    u = np.resize(multi(), len(k)) / np.std(multi()) + 0.1 * np.sin(np.pi * k / N)
    assert find_period(u) == 2 * N


# --- transients -----------------------------------------------------------------------------


def settling(periods: int, decay: float, size=0.0, seed=0) -> np.ndarray:
    """Output from rest of a resonance whose state falls to ``decay`` in a period."""
    radius = decay ** (1 / N)
    a = np.poly(radius * np.exp([0.1j, -0.1j])).real
    y = scipy.signal.lfilter([1.0], a, np.resize(multi(), periods * N))
    return y + noise(len(y), seed=seed, size=size * float(np.std(y)))


@pytest.mark.parametrize("seed", range(5))
def test_transient_in_noise(seed):
    assert find_transient(settling(5, 1e-4, 0.01, seed), N) == N
    assert find_transient(settling(5, 0.05, 0.01, seed), N) == 2 * N
    assert find_transient(settling(2, 1e-4, 0.01, seed), N) == N
    assert find_transient(settling(6, 1e-4, 0.01, seed)[N:], N) == 0
    assert find_transient(settling(3, 1e-4, 0.01, seed)[N:], N) == 0


def test_transient_without_noise():
    assert find_transient(settling(4, 1e-7), N) == N
    assert find_transient(settling(4, 1e-2), N) == 2 * N
    assert find_transient(settling(9, 1e-4)[5 * N :], N) == 0


def test_the_worst_output_counts():
    both = np.stack([settling(5, 1e-4, 0.01), settling(5, 0.05, 0.01)], axis=1)
    assert find_transient(both, N) == 2 * N


def test_a_drift_is_no_transient():
    gain = 1 + np.linspace(0, 0.05, 9 * N)
    assert find_transient(settling(9, 1e-4, 1e-3) * gain, N) == N


def test_one_period_shows_no_transient():
    assert find_transient(settling(1, 0.1), N) == 0
    assert find_transient(np.resize(multi(), 2 * N - 1), N) == 0
    assert find_transient(np.zeros(4 * N), N) == 0


@given(
    N=st.integers(4, 40),
    periods=st.integers(2, 5),
    channels=st.integers(1, 2),
    unit=st.floats(-12.0, 12.0),
    offset=st.sampled_from([0.0, 1.0, 1e6]),
    seed=st.integers(0, 1000),
)
@settings(max_examples=40)
def test_whole_periods_are_found_in_any_unit(
    N: int, periods: int, channels: int, unit: float, offset: float, seed: int
):
    u = np.random.default_rng(seed).normal(size=(N, channels))
    assert find_period(10.0**unit * (offset + np.tile(u, (periods, 1)))) == N
    assert find_transient(10.0**unit * (offset + np.tile(u, (periods, 1))), N) == 0
