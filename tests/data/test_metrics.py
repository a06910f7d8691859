"""Scores of known numbers."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from lfrtorch.data.metrics import BlockScores, nrmse, rms, rmse, rmse_by_output
from lfrtorch.data.records import Record, Scaler

pytestmark = pytest.mark.numeric

Y = np.array([9.0, 1.0, 3.0, 1.0, 3.0])


def test_rmse_leaves_out_the_skipped_samples():
    y_hat = np.array([[0.0], [4.0], [3.0], [1.0], [7.0]])
    assert rmse(Record(Y, Y), y_hat) == pytest.approx(np.sqrt((81 + 9 + 0 + 0 + 16) / 5))
    assert rmse(Record(Y, Y, skip=1), y_hat) == pytest.approx(2.5)


def test_nrmse_is_over_the_deviation_of_the_scored_samples():
    record = Record(Y, Y, skip=1)  # 1, 3, 1, 3: deviation 1
    assert nrmse(record, record.y + 0.25) == pytest.approx(0.25)
    assert nrmse(record, np.full((5, 1), 2.0)) == pytest.approx(1.0)


def test_outputs_count_alike():
    y = np.array([[0.0, 0.0], [2.0, 0.0], [0.0, 4.0], [2.0, 4.0]])  # deviations 1 and 2
    record = Record(y, y)
    y_hat = y + np.array([3.0, 4.0])
    assert rmse(record, y_hat) == pytest.approx(np.sqrt((9 + 16) / 2))
    assert nrmse(record, y_hat) == pytest.approx(np.sqrt((9 / 1 + 16 / 4) / 2))
    in_other_units = np.array([1e-9, 1e9])
    scaled = Record(y, y * in_other_units)
    assert nrmse(scaled, y_hat * in_other_units) == pytest.approx(nrmse(record, y_hat))
    still = Record(y, np.column_stack([y[:, 0], np.ones(4)]))
    assert nrmse(still, np.column_stack([y_hat[:, 0], np.ones(4)])) == pytest.approx(3.0)


def test_exact_simulation_scores_zero():
    record = Record(Y, Y)
    assert rmse(record, record.y) == nrmse(record, record.y) == 0.0


@pytest.mark.parametrize("score", [rmse, nrmse])
@pytest.mark.parametrize("y_hat", [Y, Y[1:, None]])
def test_simulation_of_another_shape_is_refused(score, y_hat):
    # (T, 1) - (T,) would broadcast to (T, T): a number, but not the score.
    with pytest.raises(ValueError, match="shape"):
        score(Record(Y, Y), y_hat)


def test_root_mean_square_of_all_values_or_along_an_axis():
    signal = np.array([[3.0, 0.0], [-3.0, 4.0]])
    assert rms(signal, axis=0) == pytest.approx([3.0, np.sqrt(8.0)])
    assert float(rms(signal)) == pytest.approx(np.sqrt(34.0 / 4.0))
    assert rms([[1e200], [1.0]], axis=0).tolist() == [np.inf]  # no warning


def test_constant_output_has_no_nrmse_and_unit_scale():
    """Whose mean has rounding errors."""
    y = np.column_stack([np.full(1000, 837769.8956), np.full(1000, 0.1)])
    record = Record(np.arange(1000.0), y)
    assert np.isnan(nrmse(record, y + 1.0))
    assert Scaler.of([record]).y_scale.tolist() == [1.0, 1.0]


@given(
    blocks=st.lists(st.integers(0, 9), min_size=1, max_size=5),
    skip=st.integers(0, 12),
    missing=st.sampled_from([0.0, 0.3, 1.0]),
    offset=st.sampled_from([0.0, 0.1, -837769.8956, 1e6]),
    spread=st.sampled_from([0.0, 1e-3, 1.0, 1e12]),
    seed=st.integers(0, 1000),
)
@example(blocks=[9, 9], skip=0, missing=0.0, offset=0.1, spread=0.0, seed=0)  # nrmse was 1e16
@settings(max_examples=60)
def test_scores_of_blocks_are_those_of_all_samples(
    blocks: list[int], skip: int, missing: float, offset: float, spread: float, seed: int
):
    rng, scores = np.random.default_rng(seed), BlockScores(2, skip)
    y = offset + spread * rng.normal(size=(sum(blocks), 2))
    y_hat = y + rng.normal(size=y.shape)
    y[rng.random(y.shape) < missing] = np.nan
    for end, n in zip(np.cumsum(blocks), blocks, strict=True):
        scores.add(y[end - n : end], y_hat[end - n : end])
    for channel in range(2):
        there = np.isfinite(y[skip:, channel])
        measured, error = y[skip:, channel][there], (y_hat - y)[skip:, channel][there]
        assert scores.samples[channel] == len(measured)
        if not len(measured):
            assert np.isnan([scores.rmse[channel], scores.nrmse[channel]]).all()
            continue
        expected = np.sqrt(np.mean(error**2))
        assert scores.rmse[channel] == pytest.approx(expected, rel=1e-12)
        if np.ptp(measured) == 0.0:
            assert np.isnan(scores.nrmse[channel])
        else:  # of 1e6 a deviation of 1e-3 has six digits
            expected /= np.std(measured - measured[0])
            assert scores.nrmse[channel] == pytest.approx(expected, rel=1e-5)


def test_samples_that_are_not_valid_are_not_scored():
    y, y_hat = np.random.default_rng(0).normal(size=(2, 50, 2))
    valid = np.random.default_rng(1).random((50, 2)) < 0.8
    record = Record(np.zeros(50), np.where(valid, y, np.nan), skip=5, valid=valid)
    counts = valid & (np.arange(50) >= 5)[:, None]
    assert rmse(record, y_hat) == pytest.approx(np.sqrt(np.mean((y - y_hat)[counts] ** 2)))
    each = [np.sqrt(np.mean((y - y_hat)[counts[:, i], i] ** 2)) for i in range(2)]
    assert rmse_by_output(record, y_hat) == pytest.approx(each)
    relative = [error / np.std(y[counts[:, i], i]) for i, error in enumerate(each)]
    assert nrmse(record, y_hat) == pytest.approx(np.sqrt(np.mean(np.square(relative))))
