"""F-16: the split, the mean over periods, the files, and a run on a system that is known."""

import json
import shutil
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace

import numpy as np
import pytest
from hydra import compose, initialize_config_dir
from scipy.io import savemat
from scipy.signal import lfilter

from lfrtorch import metrics, multisine
from lfrtorch.cli import fit
from lfrtorch.datasets import f16

FOLDER = "F16/F16GVT_Files/BenchmarkData"
PERIOD, SAMPLES = 8192, 9 * 8192
LEVELS = range(1, 8)
CONF = Path(__file__).resolve().parents[2] / "conf"


def name(level):
    return f"F16Data_FullMSine_Level{level}{'' if level % 2 else '_Validation'}.mat"


def write(root, level, force, acceleration):
    (root / FOLDER).mkdir(parents=True, exist_ok=True)
    others = {"Voltage": np.zeros((1, 1)), "Fs": 400.0}
    path = root / FOLDER / name(level)
    savemat(path, {"Force": force, "Acceleration": acceleration, **others})
    return path


@pytest.fixture(scope="module")
def numbered():
    """Root of files of the official layout whose samples say their level, output and number."""
    with TemporaryDirectory() as folder:  # 8 MB, which pytest would keep
        for level in LEVELS:
            force = 1_000_000 * level + np.arange(SAMPLES, dtype=np.int32)[None, :]
            rows = [force + 100_000_000 * (i + 1) for i in range(3)]
            write(Path(folder), level, force, np.concatenate(rows))
        yield Path(folder)


def test_split(numbered):
    data = f16.load(root=numbered)
    assert [r.name for r in data.train] == ["train_1", "train_3", "train_7"]
    assert [r.name for r in data.validation] == ["validation_5"]
    assert [r.name for r in data.tests] == ["level_2", "level_4", "level_6"]
    for record, level in zip(data.train, (1, 3, 7), strict=True):
        # Of the numbers of periods 1 to 8, counted from 0: 1 to 8 have the mean 4.5.
        expected = 1_000_000 * level + 4.5 * PERIOD + np.arange(PERIOD)
        assert np.array_equal(record.u[:, 0], expected)
        assert np.array_equal(record.y, expected[:, None] + 1e8 * np.array([1, 2, 3]))
        assert (record.start, record.skip, record.period) == ("periodic", 0, PERIOD)
    for record, level in zip((*data.validation, *data.tests), (5, 2, 4, 6), strict=True):
        expected = 1_000_000 * level + np.arange(SAMPLES)
        assert np.array_equal(record.u[:, 0], expected)
        assert np.array_equal(record.y, expected[:, None] + 1e8 * np.array([1, 2, 3]))
        assert (record.start, record.skip, record.period) == ("zero", 50, PERIOD)
    for record in (*data.train, *data.validation, *data.tests):
        assert (record.fs, record.source) == (400.0, "official")
        names = ["force (N)", "acc1 (m/s²)", "acc2 (m/s²)", "acc3 (m/s²)"]
        assert [str(c) for c in (*record.inputs, *record.outputs)] == names
    assert (data.name, data.noise_rms) == ("f16", None)


def test_other_levels(numbered):
    data = f16.load(root=str(numbered), levels=[7, 5], validation_level=1)
    assert [r.name for r in data.train] == ["train_7", "train_5"]
    assert [int(r.u[0, 0]) // 1_000_000 for r in data.train] == [7, 5]
    assert [r.name for r in data.validation] == ["validation_1"]
    assert int(data.validation[0].u[0, 0]) == 1_000_000


def test_published(numbered):
    """The three numbers of the paper, pooled as scores are."""
    data = f16.load(root=numbered)
    (lru,) = data.published
    (score,) = lru.scores.values()
    test = data.tests[2]
    assert list(lru.scores) == [test.name]
    errors = np.array([0.180, 0.167, 0.368])
    assert metrics.rmse(test, test.y + errors) == pytest.approx(score, rel=1e-6)


@pytest.mark.parametrize(
    "arguments",
    [
        {"levels": []},
        {"levels": [2]},
        {"levels": [1, 1]},
        {"levels": [1, 5]},
        {"levels": 3},
        {"levels": "13"},
        {"levels": None},
        {"validation_level": 4},
        {"validation_level": 3},
        {"validation_level": None},
        {"validation_level": [5]},
    ],
)
def test_refused_arguments(arguments):
    (option,) = arguments
    with pytest.raises(ValueError, match=r"give one or more of 1, 3, 5, 7 .* each once") as told:
        f16.load(**arguments)
    assert f"{option} is {arguments[option]}" in str(told.value)


@pytest.mark.parametrize("level", LEVELS)
def test_a_missing_file_is_one_message(numbered, tmp_path, level):
    for other in LEVELS:
        if other != level:
            (tmp_path / FOLDER).mkdir(parents=True, exist_ok=True)
            (tmp_path / FOLDER / name(other)).symlink_to(numbered / FOLDER / name(other))
    with pytest.raises(FileNotFoundError, match=r"holds 'F16' with root=DIR") as told:
        f16.load(root=tmp_path)
    assert f"no '{FOLDER}/{name(level)}'" in str(told.value)
    assert "nonlinear_benchmarks.F16()" in str(told.value)


def test_missing_files_are_downloaded_once(numbered, tmp_path, monkeypatch):
    asked = []

    def F16(**arguments):
        asked.append(arguments)
        shutil.copytree(numbered / FOLDER, tmp_path / FOLDER)

    monkeypatch.setitem(sys.modules, "nonlinear_benchmarks", SimpleNamespace(F16=F16))
    data = f16.load(root=tmp_path, download=True)
    assert asked == [{"data_file_locations": True, "dir_placement": tmp_path}]
    assert int(data.tests[0].u[0, 0]) == 2_000_000
    shutil.rmtree(tmp_path / FOLDER)


@pytest.mark.parametrize(
    ("force", "acceleration", "match"),
    [
        (np.zeros((1, 9)), np.zeros((3, 9)), r"'Force' has shape \(1, 9\).*\(1, 73728\)"),
        (np.zeros((1, SAMPLES)), np.zeros((1, SAMPLES)), r"'Acceleration' has shape \(1, 73728\)"),
        (np.zeros((1, SAMPLES)), np.zeros((3, 9, 2)), r"'Acceleration' has shape \(3, 9, 2\)"),
        (np.full((1, SAMPLES), np.nan), np.zeros((3, 9)), "without NaN"),
    ],
)
def test_another_layout(tmp_path, force, acceleration, match):
    path = write(tmp_path, 1, force, acceleration)
    with pytest.raises(ValueError, match=match) as told:
        f16.load(root=tmp_path)
    assert str(told.value).startswith(f"'{path}'")
    assert str(told.value).endswith("download the file again.")


def test_a_damaged_file(tmp_path):
    (tmp_path / FOLDER).mkdir(parents=True)
    (tmp_path / FOLDER / name(1)).write_bytes(b"text " * 99)
    with pytest.raises(ValueError, match="no readable 'Force'"):
        f16.load(root=tmp_path)


# --- a system of the kind -------------------------------------------------------------------

RMS = (12.4, 24.6, 36.8, 61.4, 73.6, 85.7, 97.8)  # N
NOISE = 0.01  # of the rms of each signal, on all of them


def resonance(frequency, damping):
    """Poles of a mode (Hz), as a filter with the gain of a mass at high frequencies."""
    pole = np.exp(2 * np.pi * frequency / 400.0 * (-damping + 1j * np.sqrt(1 - damping**2)))
    return [1e-3, -1e-3, 0.0], np.real(np.poly([pole, pole.conj()]))


def accelerations(force):
    """One mode drives another across a clearance; three outputs (3, T) mix the two."""
    first = lfilter(*resonance(5.0, 0.03), force)
    w = first - np.clip(first, -0.5, 0.5)  # free play
    second = 200 * lfilter(*resonance(8.0, 0.03), w)
    return np.stack([first + 0.001 * force, first + second, first - 2 * second])


@pytest.fixture(scope="module")
def shaken():
    """Root of files of the official layout, of a system with a clearance, and noise."""
    rng = np.random.default_rng(0)
    with TemporaryDirectory() as folder:
        for level, rms in zip(LEVELS, RMS, strict=True):
            design = multisine(PERIOD, fs=400.0, band=(2.0, 15.0), rms=rms, seed=level)
            force = np.tile(design.u[0, :, 0], 9)
            signals = np.concatenate([force[None, :], accelerations(force)])
            spread = np.sqrt(np.mean(signals**2, axis=1, keepdims=True))
            signals += NOISE * spread * rng.standard_normal(signals.shape)
            write(Path(folder), level, signals[:1], signals[1:])
        yield Path(folder)


@pytest.mark.numeric
def test_the_mean_of_the_periods_has_less_noise(shaken):
    """Noise of the rms NOISE / √8 in the input and, as the transient is left out, in the outputs.

    The transient fades by exp(-0.03 · 2 π 5 / 400 · 8192) = 4e-9 in the period that is left out.
    """
    for record in f16.load(root=shaken).train:
        level = int(record.name[-1])
        design = multisine(PERIOD, fs=400.0, band=(2.0, 15.0), rms=RMS[level - 1], seed=level)
        u = design.u[0, :, 0]
        y = accelerations(np.tile(u, 4))[:, -PERIOD:].T
        for measured, exact in ((record.u, u[:, None]), (record.y, y)):
            noise = np.std(measured - exact, axis=0) / np.sqrt(np.mean(exact**2, axis=0))
            expected = NOISE / np.sqrt(8)
            assert noise == pytest.approx(expected, rel=0.04)  # 5 / √(2 · 8192)


@pytest.mark.numeric
@pytest.mark.slow
def test_run(shaken, tmp_path, capsys):
    """The bench from its files to the table: inferred and in two iterations 10 % below linear."""
    sizes = "nx=4 nn=5 starts=1 data.levels=[7]"
    shorter = "init=inference trainer.max_iter=2 bla.max_iter=5 figures=false"
    overrides = ["+bench=f16", f"data.root='{shaken}'", *sizes.split(), *shorter.split()]
    with initialize_config_dir(version_base="1.3", config_dir=str(CONF)):
        cfg = compose("config", overrides)
    fit.run(cfg, tmp_path)
    result = json.loads((tmp_path / "metrics.json").read_text())
    assert list(result["scores"]) == ["level_2", "level_4", "level_6"]
    for score in result["scores"].values():
        assert score["rmse"] < 0.95 * score["lti_rmse"]  # measured: 0.85 to 0.88
        assert (score["samples"], score["skip"], score["unit"]) == (SAMPLES, 50, "m/s²")
        assert score["source"] == "official"
    printed = capsys.readouterr().out
    assert "note: RMSE is that of the three accelerations together" in printed
    assert "deep LRU" in printed
    assert "0.255" in printed
