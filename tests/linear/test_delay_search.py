"""The search for whole delays, and the dead time to fractions of a sample."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

from lfrtorch import InputError, Record, estimate_bla, multisine
from lfrtorch.analysis import dead_times
from lfrtorch.data.delayed_records import delayed_records, resting_level
from lfrtorch.linear.delay_search import find_delay
from lfrtorch.linear.model import LinearModel

T = 1500


def lags(u: np.ndarray, time_constants: tuple[float, ...], delay: float) -> np.ndarray:
    """Samples of lags in series behind a dead time, exactly, of an input that is held (T,)."""
    n, whole = len(time_constants), int(delay)
    fraction = delay - whole
    A = np.diag([-1 / t for t in time_constants])
    A[range(1, n), range(n - 1)] = [1 / t for t in time_constants[1:]]
    M = np.zeros((n + 1, n + 1))
    M[:n, :n], M[0, n] = A, 1 / time_constants[0]
    first, last = expm(M * fraction), expm(M * (1 - fraction))
    late = np.concatenate([np.zeros(whole + 1), u])
    x, y = np.zeros(n), np.zeros(len(u))
    for k in range(len(u)):
        y[k] = x[-1]
        for of, v in ((first, late[k]), (last, late[k + 1])):
            x = of[:n, :n] @ x + of[:n, n] * v
    return y


def held(seed: int, samples: int = T, hold: int = 3) -> np.ndarray:
    levels = np.random.default_rng(seed).uniform(-1.0, 1.0, samples // hold + 1)
    return np.repeat(levels, hold)[:samples]


def noisy(y: np.ndarray, seed: int = 1, part: float = 0.1) -> np.ndarray:
    return y + part * y.std() * np.random.default_rng(seed).standard_normal(len(y))


def bla(record: Record, nx: int) -> LinearModel:
    delay = find_delay([record], nx)
    shifted = delayed_records([record], delay, resting_level([record], delay))
    return replace(estimate_bla(shifted, nx), delay=delay)


@pytest.mark.parametrize(
    "delay", [0.3, 12.8, *(pytest.param(d, marks=pytest.mark.slow) for d in (1.0, 2.5, 40.1))]
)
def test_a_lag_tells_its_dead_time_to_hundredths_of_a_sample(delay: float):
    u = held(0)
    (found,) = dead_times(bla(Record(u, noisy(lags(u, (8.0,), delay)), fs=4.0), 1))
    assert found.std < 0.05
    assert abs(found.samples - delay) < 3.5 * found.std
    assert found.seconds == pytest.approx(found.samples / 4.0)
    assert str(found).startswith("u: ")


def test_several_lags_leave_a_doubt():
    u = held(0)
    (found,) = dead_times(bla(Record(u, noisy(lags(u, (8.0, 4.0), 6.4))), 2))
    assert 0.05 < found.std < 1.5
    assert abs(found.samples - 6.4) < 3 * found.std


def test_models_of_two_orders_have_the_interval_of_both():
    u = held(0)
    record = Record(u, noisy(lags(u, (8.0, 4.0), 6.4)))
    delay = (7,)
    shifted = delayed_records([record], delay, np.zeros(1))
    both = [replace(estimate_bla(shifted, nx), delay=delay) for nx in (1, 2)]
    (one,), (two,), (found,) = map(dead_times, (both[0], both[1], both))
    low = min(each.samples - 2 * each.std for each in (one, two))
    high = max(each.samples + 2 * each.std for each in (one, two))
    assert found.samples == pytest.approx((low + high) / 2)
    assert found.std == pytest.approx((high - low) / 4)


@pytest.mark.slow
def test_the_order_is_not_raised():
    u = held(0)
    record = Record(u, noisy(lags(u, (8.0,), 9.0)))
    shifted = delayed_records([record], find_delay([record], None), np.zeros(1))
    with_delay, without = (estimate_bla(of, 1).fit for of in (shifted, [record]))
    assert with_delay is not None
    assert without is not None
    assert with_delay.rmse < 0.4 * without.rmse


def test_each_input_has_its_own():
    u = np.stack([held(0), held(5, hold=2), held(7)], axis=1)
    y = lags(u[:, 0], (8.0,), 3.5) + lags(u[:, 1], (8.0,), 0.0) - lags(u[:, 2], (8.0,), 17.2)
    found = dead_times(bla(Record(u, noisy(y, part=0.05)), 1))
    for one, delay in zip(found, (3.5, 0.0, 17.2), strict=True):
        assert abs(one.samples - delay) < 0.2


def test_the_first_output_that_reacts_tells():
    u = held(0)
    y = np.stack([noisy(lags(u, (8.0,), d), seed) for seed, d in enumerate((9.3, 4.6))], axis=1)
    (found,) = dead_times(bla(Record(u, y), 2))
    assert abs(found.samples - 4.6) < 1.0


@pytest.mark.slow
def test_a_steady_state_repeats():
    u = multisine(256, band=(0.004, 0.3), fs=1.0, rms=1.0, seed=1).u[0, :, 0]
    y = lags(np.tile(u, 3), (6.0,), 21.0)[512:]
    record = Record(u, noisy(y), start="periodic")
    assert find_delay([record], 1)[0] in (21, 22)
    (shifted,) = delayed_records([record], (21,), np.zeros(1))
    assert shifted.samples == 256
    assert np.array_equal(shifted.u[:, 0], np.roll(u, 21))


def test_no_delay_is_found_where_there_is_none():
    u = held(0)
    assert find_delay([Record(u, noisy(lags(u, (20.0,), 0.0)))], 1)[0] <= 1


def test_a_record_in_motion_begins_after_its_delay():
    u = held(0)
    record = Record(u, lags(u, (8.0,), 5.0), start="estimated", skip=30)
    (cut,) = delayed_records([record], (5,), np.zeros(1))
    assert (cut.samples, cut.skip, cut.start) == (T - 5, 25, "estimated")
    assert np.array_equal(cut.u[:, 0], u[:-5])
    assert np.array_equal(cut.y, record.y[5:])
    with pytest.raises(InputError, match="delay"):
        delayed_records([replace(record[:6], start="estimated")], (5,), np.zeros(1))


def test_the_level_at_rest_is_the_mean_of_what_acts():
    records = [Record(np.arange(100.0), np.zeros(100)), Record(np.ones(50), np.zeros(50))]
    level = resting_level(records, (10,))
    shifted = delayed_records(records, (10,), level)
    assert np.concatenate([r.u for r in shifted]).mean() == pytest.approx(level[0])


def test_a_model_without_a_response_to_continue_tells_half_a_sample():
    u = held(0)
    model = replace(estimate_bla(Record(u, noisy(lags(u, (8.0,), 0.5))), 1), delay=(4,))
    assert model.covariance is not None
    blind = replace(model, covariance=None)
    fast = replace(model, A=np.zeros((1, 1)))
    no_feedthrough = replace(model, covariance=model.covariance * np.diag([1.0, 1, 1, 0]))
    for one in (blind, fast, no_feedthrough):
        (found,) = dead_times(one)
        assert (found.samples, found.std) == (4.0, 0.25)


def test_a_pole_on_the_negative_axis_does_no_harm():
    u = held(0)
    model = bla(Record(u, noisy(lags(u, (8.0,), 2.5))), 1)
    assert model.covariance is not None
    A, B, C = (np.zeros(shape) for shape in ((2, 2), (2, 1), (1, 2)))
    A[0, 0], A[1, 1], B[0], C[0, 0], C[0, 1] = model.A[0, 0], -0.5, model.B[0], model.C[0, 0], 1.0
    wide = np.zeros((9, 9))
    places = [0, 4, 6, 8]  # of A, B, C and D of the first state
    wide[np.ix_(places, places)] = model.covariance
    (found,), (own,) = dead_times(replace(model, A=A, B=B, C=C, covariance=wide)), dead_times(model)
    assert found.samples == pytest.approx(own.samples, abs=0.02)
