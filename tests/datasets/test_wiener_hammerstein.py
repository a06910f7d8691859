"""Wiener-Hammerstein benchmark of 2009: the official split, and the file."""

import numpy as np
import pytest
from experiments import scored
from scipy.io import savemat

from lfrtorch.datasets import wiener_hammerstein

FILE = "WienerHammerBenchMark/WienerHammerBenchMark.mat"
SAMPLES = 188_000


@pytest.fixture
def numbered(tmp_path):
    """Root of a file of the official layout whose samples are their numbers, counted from 1."""
    path = tmp_path / FILE
    path.parent.mkdir()
    number = np.arange(1.0, SAMPLES + 1)[:, None]
    savemat(path, {"uBenchMark": number, "yBenchMark": -number, "fs": 51200.0})
    return tmp_path


def test_official_split(numbered):
    data = wiener_hammerstein.load(root=numbered)
    (train,), (validation,), (test, site) = data.train, data.validation, data.tests
    assert [r.name for r in (train, validation, test)] == ["train", "validation", "test"]
    assert scored(train) == (5001, 80_000)
    assert scored(validation) == (80_001, 100_000)
    assert scored(test) == (101_001, 188_000)
    assert [r.samples for r in (train, validation, test)] == [80_000, 21_000, 88_000]
    for record in (train, validation, test):
        assert np.array_equal(record.y, -record.u)
        assert (record.fs, record.start, record.source) == (51200.0, "zero", "official")
        assert [str(c) for c in (*record.inputs, *record.outputs)] == ["u (V)", "y (V)"]
    assert (data.name, data.noise_rms) == ("wiener_hammerstein", None)
    (subnet,) = (p for p in data.published if p.label == "SUBNET")
    assert subnet.scores == pytest.approx({"test": 0.241e-3, "site": 0.241e-3})
    # The package's [5200:184000][100000:], 78800 samples.
    assert (scored(site), site.samples) == ((105_251, 184_000), 78_800)
    assert (site.name, site.start, site.skip) == ("site", "estimated", 50)
    assert data.leaderboard == [site]


def test_split_of_the_site(numbered):
    data = wiener_hammerstein.load(root=numbered, split="site")
    (train,), (validation,), (site,) = data.train, data.validation, data.tests
    assert (int(train.u[0, 0]), scored(train)) == (5201, (6201, 85_200))
    assert scored(validation) == (85_201, 105_200)
    assert (site.name, scored(site)) == ("site", (105_251, 184_000))
    data = wiener_hammerstein.load(root=numbered, split="site", skip=0)
    assert scored(data.train[0]) == (5201, 85_200)


def test_the_rule_of_the_validation_part(numbered):
    data = wiener_hammerstein.load(root=str(numbered), validation=0.5, skip=0)
    assert scored(data.train[0]) == (1, 50_000)
    assert scored(data.validation[0]) == (50_001, 100_000)
    assert scored(data.tests[0]) == (101_001, 188_000)


def test_a_file_of_another_length_is_refused(numbered):
    savemat(numbered / FILE, {"uBenchMark": np.zeros((9, 1)), "yBenchMark": np.zeros((9, 1))})
    with pytest.raises(ValueError, match=r"'uBenchMark' has shape \(9, 1\)"):
        wiener_hammerstein.load(root=numbered)


@pytest.mark.data
def test_official_file(official):
    data = official(wiener_hammerstein.load)
    (train,), (test, _) = data.train, data.tests
    assert 1e3 * np.std(test.y) == pytest.approx(239.1, abs=0.1)
    # What is skipped of the training part is rest but for an old response, and the input follows.
    assert np.std(train.u[100:4990]) < 5e-4
    assert np.std(train.y[100:5000]) < 5e-4
    assert np.std(train.u[5000:5200]) > 0.5
