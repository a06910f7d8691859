"""Lone samples that stick out are found, and none where steps, pulses and tails are by design."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.signal import chirp, lfilter

from lfrtorch._support.types import Array
from lfrtorch.data.records import Record
from lfrtorch.survey.notes import notes_on
from lfrtorch.survey.outliers import input_outliers, output_outliers

pytestmark = pytest.mark.numeric

T = 2000
K = np.arange(T)


def multisine(rng) -> Array:
    lines = np.zeros(T // 2 + 1, complex)
    lines[1 : T // 10] = np.exp(2j * np.pi * rng.random(T // 10 - 1))
    signal = np.fft.irfft(lines, T)
    return signal / signal.std()


def held(rng, least: int, most: int) -> Array:
    """Random levels, each for some samples."""
    return np.repeat(rng.uniform(-1, 1, T), rng.integers(least, most + 1, T))[:T]


def impulses(rng, count: int) -> Array:
    u = 3e-3 * rng.standard_normal(T)
    u[rng.choice(np.arange(30, T - 30), count, replace=False)] += 1.0
    return u


SIGNALS: dict[str, Callable[..., Array]] = {
    "noise": lambda rng: rng.standard_normal(T),
    "uniform": lambda rng: rng.uniform(-1, 1, T),
    "exponential": lambda rng: rng.exponential(size=T),
    "multisine": multisine,
    "binary": lambda rng: np.sign(rng.standard_normal(T)) + 0.01 * rng.standard_normal(T),
    "slow binary": lambda rng: np.repeat(np.sign(rng.standard_normal(T // 40)), 40) + 0.0,
    "levels": lambda rng: held(rng, 1, 20),
    "slow levels": lambda rng: held(rng, 20, 100) + 1e-3 * rng.standard_normal(T),
    "three steps": lambda rng: (
        np.repeat(rng.uniform(-1, 1, 4), T // 4) + 1e-3 * rng.uniform(size=T)
    ),
    "sweep": lambda rng: chirp(K, 1e-3, T, 0.4),
    "growing sweep": lambda rng: chirp(K, 1e-3, T, 0.4) * K / T,
    "one impulse": lambda rng: impulses(rng, 1),
    "ten impulses": lambda rng: impulses(rng, 10),
    "bursts": lambda rng: rng.standard_normal(T) * (K % 500 > 400),
    "walk": lambda rng: np.cumsum(rng.standard_normal(T)),
}
SYSTEMS: dict[str, Callable[[Array], Array]] = {
    "static": lambda u: 2 * u,
    "lag": lambda u: lfilter([0, 0.1], [1, -0.9], u),
    "resonance": lambda u: lfilter([0, 1], np.poly(0.97 * np.exp([0.3j, -0.3j])).real, u),
    "high pass": lambda u: lfilter([1, -1], [1, -0.3], u),
    "cubic": lambda u: lfilter([0, 0.1], [1, -0.9], u + 0.3 * u**3),
    "saturation": lambda u: np.tanh(2 * lfilter([0, 0.5], [1, -0.5], u)),
}


def planted(signal: Array, count: int, rng) -> tuple[Array, list[int]]:
    """A signal with lone samples off by 6 to 17 times its deviation, and where."""
    where = np.sort(rng.choice(np.arange(5, T - 5, 7), count, replace=False))
    off = rng.uniform(6, 17, count) * rng.choice([-1, 1], count) * signal.std()
    bad = signal.copy()
    bad[where] += off
    return bad, where.tolist()


def test_few_signals_of_systems_have_outliers_and_planted_ones_are_found():
    """Of 20 seeds 2 of 1800 outputs and no input has any; 9523 of 10800 planted ones are found."""
    alarms = found = all_of_them = 0
    for seed, signal in enumerate(SIGNALS.values()):
        rng = np.random.default_rng(seed)
        u = signal(rng)
        alarms += len(input_outliers(u, lfilter([0, 0.1], [1, -0.9], u)[:, None]))
        for system in SYSTEMS.values():
            y = system(u)
            y += 0.01 * y.std() * rng.standard_normal(T)
            alarms += len(output_outliers(y, u[:, None]))
            bad, where = planted(y, 6, rng)
            found += len({*output_outliers(bad, u[:, None])} & {*where})
            all_of_them += 6
    assert alarms == 0
    assert found > 0.8 * all_of_them


@pytest.mark.parametrize("name", ["noise", "multisine", "slow levels", "sweep", "walk"])
def test_outliers_of_inputs(name):
    rng = np.random.default_rng(0)
    bad, where = planted(SIGNALS[name](rng), 6, rng)
    assert input_outliers(bad).tolist() == where
    response = lfilter([0, 0.1], [1, -0.9], SIGNALS[name](np.random.default_rng(0)))
    assert input_outliers(bad, response[:, None]).tolist() == where


@pytest.mark.parametrize("where", [0, 1, T - 2, T - 1])
def test_outliers_at_the_ends(where: int):
    rng = np.random.default_rng(0)
    for name in ("noise", "multisine", "slow levels", "walk"):
        y = SIGNALS[name](rng)
        y[where] += 30 * y.std()
        assert input_outliers(y).tolist() == [where]


def test_a_transient_at_the_start_is_no_outlier():
    y = SIGNALS["multisine"](np.random.default_rng(0))
    assert not input_outliers(y + 30 * 0.5**K).size
    assert not input_outliers(np.append(-3.0, y[1:])).size


def test_two_bad_samples_side_by_side_and_a_good_one_between():
    y = multisine(np.random.default_rng(0))
    y[[400, 401, 800, 802]] = -9.0, -8.0, 9.0, 9.0
    assert input_outliers(y).tolist() == [400, 401, 800, 802]


def test_coarse_signals_have_no_outliers():
    rng = np.random.default_rng(0)
    slow = np.sin(0.003 * K) + 0.015 * rng.standard_normal(T)
    for step in (0.01, 0.05, 0.5):
        assert not input_outliers(step * np.rint(slow / step)).size
    assert not input_outliers(np.ones(T)).size
    assert not input_outliers(np.full(T, np.nan)).size


def test_a_missing_sample_is_no_outlier_and_hides_none():
    y, where = planted(multisine(np.random.default_rng(0)), 3, np.random.default_rng(1))
    y[[50, 900, 901]] = np.nan
    assert input_outliers(y).tolist() == where
    assert output_outliers(y, np.where(K == 60, np.nan, np.sin(K))[:, None]).tolist() == where


def test_the_note_says_where_they_are():
    rng = np.random.default_rng(0)
    u = rng.standard_normal(T)
    y = lfilter([0, 0.1], [1, -0.9], u)
    y += 0.01 * y.std() * rng.standard_normal(T)
    assert notes_on(Record(u, y)) == []
    bad, where = planted(y, 8, rng)
    (note,) = notes_on(Record(u, bad))
    shown = ", ".join(map(str, where[:6]))
    assert note == (
        f"output 'y' has 8 outlier(s), at sample {shown} and 2 more: if misread, leave them out, "
        "by Record(valid=...) or an empty cell of the output."
    )
    (note,) = notes_on(Record(u, bad, skip=where[6] + 3))
    assert f"'y' has 1 outlier(s), at sample {where[7]}: if misread" in note
    u[700] = 9.0
    (note,) = notes_on(Record(u, y))
    assert "input 'u' has 1 outlier(s), at sample 700: if misread, interpolate, or leave" in note
