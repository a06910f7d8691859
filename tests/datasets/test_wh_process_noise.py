"""Wiener-Hammerstein with process noise: the split, the files, and what the noise does."""

import json

import numpy as np
import pytest
from scipy.io import savemat
from scipy.signal import butter, lfilter

from lfrtorch.cli import fit
from lfrtorch.cli.composition import composed
from lfrtorch.datasets import wh_process_noise

FOLDER = "WienHammer/WienerHammersteinFiles"
ESTIMATION, TEST = "WH_EstimationExample.mat", "WH_TestDataset.mat"


def write(root, file, **fields):
    """A file of the official layout; r is unlike u, and fs a field, too."""
    (root / FOLDER).mkdir(parents=True, exist_ok=True)
    savemat(root / FOLDER / file, {"dataMeas": {"r": np.zeros((3, 2)), "fs": 78125.0, **fields}})
    return root / FOLDER / file


def numbers(samples, records, first=0.0):
    """Column i, counted from 1, has the samples first + 1000 i + 0, 1, 2, .."""
    return first + 1000 * np.arange(1, records + 1) + np.arange(samples)[:, None]


@pytest.fixture
def numbered(tmp_path):
    """Root of files whose samples say their column and number; y is -u."""
    for file, u in ((ESTIMATION, numbers(300, 10)), (TEST, numbers(250, 2, 50_000.0))):
        write(tmp_path, file, u=u, y=-u)
    return tmp_path


@pytest.mark.parametrize("validation", [1, 2, 9])
def test_split(numbered, validation):
    data = wh_process_noise.load(root=str(numbered), validation=validation)
    trained = 10 - validation
    assert [r.name for r in data.train] == [f"train_{i + 1}" for i in range(trained)]
    assert [r.name for r in data.validation] == [f"validation_{i + 1}" for i in range(validation)]
    for i, record in enumerate((*data.train, *data.validation), start=1):
        assert np.array_equal(record.u[:, 0], 1000 * i + np.arange(300.0))
    assert [r.name for r in data.tests] == ["multisine", "sweep"]
    for i, record in enumerate(data.tests, start=1):
        assert np.array_equal(record.u[:, 0], 50_000 + 1000 * i + np.arange(250.0))
    for record in (*data.train, *data.validation, *data.tests):
        assert np.array_equal(record.y, -record.u)
        assert (record.fs, record.start, record.skip) == (78125.0, "zero", 100)
        assert record.source == "official"
        assert [str(c) for c in (*record.inputs, *record.outputs)] == ["u (V)", "y (V)"]
    assert (data.name, data.noise_rms) == ("wh_process_noise", None)


@pytest.mark.parametrize("validation", [10, 11])
def test_one_record_trains_at_least(numbered, validation):
    with pytest.raises(ValueError, match=r"has 10 record\(s\), .* give 1 to 9") as told:
        wh_process_noise.load(root=numbered, validation=validation)
    assert f"validation is {validation}" in str(told.value)


def test_a_missing_test_file_is_a_note(numbered):
    (numbered / FOLDER / "WH_TestDataset.mat").unlink()
    data = wh_process_noise.load(root=numbered)
    assert data.tests == []
    assert data.train
    assert data.notes[0].startswith("no test records: WH_TestDataset.mat")


@pytest.mark.parametrize(
    ("fields", "match"),
    [
        ({"u": np.zeros((300, 10))}, r"no readable struct 'dataMeas' with u and y"),
        ({"u": np.zeros((300, 10)), "y": np.zeros((300, 9))}, r"y' has shape \(300, 9\).*, 10\)"),
        ({"u": np.zeros((10, 300)), "y": np.zeros((10, 300))}, r"\(10, 300\).*more than 100"),
        ({"u": np.zeros((300, 1)), "y": np.zeros((300, 1))}, r"has 1 record\(s\)"),
        ({"u": np.full((300, 10), np.nan), "y": np.zeros((300, 10))}, "u' .*without NaN"),
    ],
)
def test_another_layout_of_the_estimation_file(numbered, fields, match):
    path = write(numbered, ESTIMATION, **fields)
    with pytest.raises(ValueError, match=match) as told:
        wh_process_noise.load(root=numbered)
    assert f"'{path}'" in str(told.value)


@pytest.mark.parametrize("columns", [1, 3])
def test_another_layout_of_the_test_file(numbered, columns):
    path = write(numbered, TEST, u=numbers(300, columns), y=numbers(300, columns))
    with pytest.raises(ValueError, match=r"expected \(samples, 2\), multisine and sweep") as told:
        wh_process_noise.load(root=numbered)
    assert str(told.value).startswith(f"'{path}'")


# --- a system of the kind -------------------------------------------------------------------


def outputs(u, e):
    """A low-pass filter, noise e, a saturation, a low-pass filter: (T, records)."""
    b, a = butter(1, 0.3)
    return lfilter(b, a, np.tanh(1.5 * (lfilter(b, a, u, axis=0) + e)), axis=0)


def rms(x):
    return np.sqrt(np.mean(np.square(x)))


@pytest.mark.numeric
def test_run(tmp_path):
    """From files to scores: process noise is a floor of the validation error and not of the tests'.

    The floor is the error of the mean output given the input, here of 400 draws of the noise; it is
    below that of the noise-free circuit, which is what the tests are of.
    """
    rng = np.random.default_rng(0)
    u, e = rng.standard_normal((2, 1000, 4))
    y = outputs(u, 0.5 * e)
    write(tmp_path, ESTIMATION, u=u, y=y)
    tests = rng.standard_normal((1000, 2))
    write(tmp_path, TEST, u=tests, y=outputs(tests, 0.0))
    sizes = "nx=2 nn=5 starts=1 data.validation=1 trainer.max_iter=2 bla.max_iter=5 figures=false"
    overrides = ["+bench=wh_process_noise", f"data.root='{tmp_path}'", *sizes.split()]
    cfg = composed("config", overrides)
    fit.run(cfg, tmp_path / "run")
    result = json.loads((tmp_path / "run" / "metrics.json").read_text())

    u, y = u[:, -1:], y[:, -1:]
    mean = np.mean(outputs(u, 0.5 * rng.standard_normal((1000, 400))), axis=1, keepdims=True)
    floor = rms((y - mean)[100:])
    assert floor < 0.99 * rms((y - outputs(u, 0.0))[100:])  # measured: 0.96
    assert result["validation"]["rmse"] > floor
    assert list(result["scores"]) == ["multisine", "sweep"]
    for score in result["scores"].values():
        assert score["rmse"] < 0.8 * floor
        assert (score["source"], score["unit"], score["skip"]) == ("official", "V", 100)
    assert "floor of their errors" in result["data"]["notes"][0]
