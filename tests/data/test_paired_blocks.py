"""Errors of several models in blocks of time: what tells two of them apart, and what does not."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter

from lfrtorch.data.paired_blocks import (
    BLOCKS,
    Judge,
    blocked_mean,
    in_blocks,
    squares_in_blocks,
)

pytestmark = pytest.mark.numeric


def sums(signals: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    blocks = [in_blocks([signal]) for signal in signals]
    return (
        np.array([[block.sum() for block in each] for each in blocks]),
        np.array([len(block) for block in blocks[0]]),
    )


def test_standard_error_is_right_for_errors_that_are_correlated():
    rng = np.random.default_rng(0)
    means, errors, alone = [], [], []
    for _ in range(1000):
        e = lfilter([math.sqrt(1 - 0.81)], [1, -0.9], rng.standard_normal(2200))
        squares = np.asarray(e)[200:] ** 2
        mean, error = blocked_mean(*sums([squares]))
        means.append(mean[0])
        errors.append(error[0])
        alone.append(squares.std() / math.sqrt(len(squares)))
    # 1000 draws: 2 %; blocks of 20 correlation times of the squares: 5 %.
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(np.std(means), rel=0.1)
    assert np.mean(alone) < 0.4 * np.std(means)  # samples taken as independent


def test_of_two_equal_models_the_smaller_is_taken_in_83_of_100_cases():
    rng = np.random.default_rng(1)
    above = [
        Judge(rng.chisquare(50, (2, BLOCKS)), np.full(BLOCKS, 50)).above()[0] for _ in range(2000)
    ]
    # (1 + P(|t| < 1)) / 2 of Student's t with 9 degrees of freedom; 4 standard deviations.
    assert np.mean(np.array(above) <= 1.0) == pytest.approx(0.828, abs=0.034)


def test_noise_that_models_share_does_not_hide_which_is_better():
    rng = np.random.default_rng(2)
    T, excess = 2600, 0.118
    noise, own = rng.standard_normal((2, T))
    squares, counts = sums([noise**2, (noise + excess * own) ** 2])
    above = Judge(squares, counts).above()
    assert above[0] == 0.0
    assert above[1] > 2.0
    mean, error = blocked_mean(squares, counts)
    assert mean[1] < mean[0] + error[0]  # the usual form cannot tell


def test_blocks_cover_every_record():
    signals = [np.arange(70.0), np.arange(35.0), np.arange(3.0)]
    blocks = in_blocks(signals)
    assert [len(block) for block in blocks] == [10] * 7 + [9, 9, 9, 8] + [3]
    assert np.array_equal(np.concatenate(blocks), np.concatenate(signals))
    assert [len(block) for block in in_blocks([np.ones(5)] * 20)] == [5] * 20
    with pytest.raises(ValueError, match="have 9 scored samples"):
        in_blocks([np.ones(9)])


def test_a_model_that_diverges_is_infinitely_far_above_the_best():
    above = Judge(np.array([[np.inf] * 10, [2.0] * 10, [2.0] * 10]), np.ones(10, int)).above()
    assert above.tolist() == [np.inf, 0.0, 0.0]


def test_errors_that_are_not_finite_are_infinite_and_no_model_is_as_good():
    errors = [np.ones((20, 2)), np.full((10, 2), 2.0)]
    sums = squares_in_blocks(errors)
    assert sums.sum() == 20 + 4 * 10  # the mean of the outputs
    errors[1][3, 1] = np.nan
    lost = squares_in_blocks(errors)
    assert np.isinf(lost).all()
    counts = np.array([len(block) for block in in_blocks([e[:, 0] for e in errors])])
    assert Judge(np.array([lost, sums]), counts).as_good().tolist() == [False, True]


@pytest.mark.parametrize("scale", [2.0**-660, 2.0**660])
def test_units_do_not_change_which_model_is_as_good(scale: float):
    squares, counts = np.random.default_rng(0).uniform(1.0, 1.1, (5, 12)), np.full(12, 50)
    expected = Judge(squares, counts).above()
    assert np.array_equal(Judge(squares * scale, counts).above(), expected)


@given(
    lengths=st.lists(st.integers(1, 40), min_size=1, max_size=4),
    powers=st.lists(st.sampled_from([-300, -150, 0, 0, 150, 160]), min_size=1, max_size=4),
    equal=st.booleans(),
    bad=st.sampled_from([None, math.nan, math.inf]),
    seed=st.integers(0, 1000),
)
@settings(max_examples=40)
def test_the_best_of_any_models_is_as_good_and_nothing_is_nan(
    lengths: list[int], powers: list[int], equal: bool, bad: float | None, seed: int
):
    if sum(lengths) < BLOCKS:
        return
    rng, errors = np.random.default_rng(seed), []
    for power in powers:
        errors.append([10.0**power * rng.normal(size=(T, 2)) for T in lengths])
    if equal:
        errors.append(errors[0])
    if bad is not None:
        errors.append([np.full((T, 2), bad) for T in lengths])
    counts = np.array([len(block) for block in in_blocks([e[:, 0] for e in errors[0]])])
    assert counts.sum() == sum(lengths)
    assert counts.min() >= 1
    squares = np.array([squares_in_blocks(each) for each in errors])
    above, good = Judge(squares, counts).above(), Judge(squares, counts).as_good()
    assert (above >= 0.0).all()  # False for NaN
    if np.isfinite(squares).all(axis=1).any():
        best = np.argmin(squares.sum(axis=1))
        assert above[best] == 0.0
        assert good[best]
        assert not good[~np.isfinite(squares).all(axis=1)].any()


def test_the_ratio_of_two_models_does_not_depend_on_the_unit_of_their_errors():
    rng = np.random.default_rng(5)
    squares, counts = rng.chisquare(20, (2, BLOCKS)), np.full(BLOCKS, 20)
    squares[1] *= 0.25
    ratio, std = Judge(squares, counts).ratio()
    assert ratio == pytest.approx(0.5, rel=0.3)
    assert Judge(1e6 * squares, counts).ratio() == pytest.approx((ratio, std), rel=1e-9)
    draws = [
        Judge(rng.chisquare(20, (2, BLOCKS)) * [[1.0], [0.25]], counts).ratio()[0]
        for _ in range(2000)
    ]
    assert std == pytest.approx(np.std(draws), rel=0.6)  # of ten blocks
