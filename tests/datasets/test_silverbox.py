"""Silverbox benchmark: the split, and the file."""

import numpy as np
import pytest
from experiments import scored
from scipy.io import savemat
from scipy.signal import lfilter

from lfrtorch.datasets import silverbox

FILE = "Silverbox/SilverboxFiles/SNLS80mV.mat"
SAMPLES = 131_072


@pytest.fixture
def numbered(tmp_path):
    """Root of a file of the official layout whose samples are their numbers, counted from 1."""
    path = tmp_path / FILE
    path.parent.mkdir(parents=True)
    number = np.arange(1.0, SAMPLES + 1)[None, :]
    savemat(path, {"V1": number, "V2": -number, "Ovld1": 0.0, "Ovld2": 0.0})
    return tmp_path


def test_split(numbered):
    data = silverbox.load(root=numbered)
    (train,), (validation,) = data.train, data.validation
    multisine, arrow, inside = data.tests
    names = ["multisine", "arrow", "arrow_no_extrapolation"]
    assert [r.name for r in data.tests] == names
    assert scored(train) == (41_151, 92_700)
    assert scored(validation) == (92_701, 105_712)
    assert scored(multisine) == (105_713 + 50, 127_400)  # 21688 samples, 50 of them unscored
    assert scored(arrow) == (151, 40_575)
    assert scored(inside) == (151, 32_100)
    assert int(train.u[0, 0]) == 40_651
    assert [r.skip for r in (train, validation, *data.tests)] == [500, 500, 550, 50, 50]
    for record in (train, validation, *data.tests):
        assert np.array_equal(record.y, -record.u)
        assert (record.start, record.source) == ("zero", "official")
        assert record.fs == pytest.approx(610.35, abs=0.01)
        assert [str(c) for c in (*record.inputs, *record.outputs)] == ["V1 (V)", "V2 (V)"]
    assert (data.name, data.noise_rms) == ("silverbox", None)
    assert all(set(p.scores) <= set(names) for p in data.published)
    # As the package cuts them, with nothing before: its [105712:127400], [100:40575], [100:32100].
    cuts = [(105_763, 127_400), (151, 40_575), (151, 32_100)]
    assert [scored(record) for record in data.leaderboard] == cuts
    assert all((r.start, r.skip) == ("estimated", 50) for r in data.leaderboard)


def test_the_rules_of_the_cuts(numbered):
    data = silverbox.load(root=str(numbered), validation=0.5, warm_up=0)
    assert scored(data.train[0]) == (40_651, 73_181)
    assert scored(data.validation[0]) == (73_182, 105_712)
    assert scored(data.tests[0]) == (105_763, 127_400)
    assert [r.skip for r in (*data.train, *data.validation, *data.tests)] == [0, 0, 50, 50, 50]


@pytest.mark.data
def test_official_file(official):
    data = official(silverbox.load)
    (train,), (multisine, arrow, inside) = data.train, data.tests
    for record in (train, multisine, arrow):
        assert 1e3 * np.mean(record.u) == pytest.approx(6.2, abs=0.1)  # the offsets are left in
        assert 1e3 * np.mean(record.y) == pytest.approx(0.8, abs=0.2)
    assert 1e3 * np.std(multisine.y) == pytest.approx(54.1, abs=0.1)
    # The cuts: the arrow begins at rest and grows, and the part that is to stay inside does.
    assert np.std(arrow.y[:100]) < 0.03 * np.std(multisine.y)
    assert np.abs(inside.u).max() < np.abs(train.u).max() < np.abs(arrow.u).max()
    assert np.std(arrow.u[-2000:-200]) > np.std(train.u)


@pytest.mark.numeric
@pytest.mark.data
def test_warm_up_is_long_enough(official):
    """The BLA's poles, 0.9655 in magnitude at 70 Hz, from zero state and from the whole past."""
    pole = 0.9655 * np.exp(2j * np.pi * 70 / 610.35)
    denominator = np.real(np.poly([pole, np.conj(pole)]))
    data = official(silverbox.load)
    (train,), (multisine, *_) = data.train, data.tests
    y = lfilter(np.sum(denominator), denominator, multisine.u[:, 0])
    late = lfilter(np.sum(denominator), denominator, multisine.u[250:, 0])
    error = np.abs(y[250:] - late)
    assert error[0] > 1e-2
    assert error[500:].max() < 1e-8
    assert train.skip == 500
