"""Scores of known numbers."""

import numpy as np
import pytest

from lfrtorch.metrics import nrmse, rms, rmse
from lfrtorch.records import Record

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
    assert nrmse(record, y_hat) == pytest.approx(np.sqrt(25 / (1 + 4)))


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
