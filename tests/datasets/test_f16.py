"""F-16: the split, the mean over periods, the files, and a run on a system that is known."""

import json
import shutil
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from scipy.io import savemat
from scipy.signal import lfilter

from lfrtorch import multisine
from lfrtorch.cli import fit
from lfrtorch.cli.composition import composed
from lfrtorch.data import metrics
from lfrtorch.datasets import f16

FOLDER = "F16/F16GVT_Files/BenchmarkData"
PERIOD, SAMPLES = 8192, 9 * 8192
LEVELS = range(1, 8)


SWEPT = 1000
"""Samples of a swept sine here, fewer than the official ones."""

KINDS = "FullMSine", "SineSw"


def name(level, kind="FullMSine"):
    return f"F16Data_{kind}_Level{level}{'' if level % 2 else '_Validation'}.mat"


def write(root, level, force, acceleration, kind="FullMSine"):
    (root / FOLDER).mkdir(parents=True, exist_ok=True)
    others = {"Voltage": np.zeros((1, 1)), "Fs": 400.0}
    path = root / FOLDER / name(level, kind)
    savemat(path, {"Force": force, "Acceleration": acceleration, **others})
    return path


@pytest.fixture(scope="module")
def numbered():
    """Root of files of the official layout whose samples say their level, output and number."""
    with TemporaryDirectory() as folder:  # 8 MB, which pytest would keep
        for level in LEVELS:
            for kind, samples in zip(KINDS, (SAMPLES, SWEPT + level), strict=True):
                force = 1_000_000 * level + np.arange(samples, dtype=np.int32)[None, :]
                rows = [force + 100_000_000 * (i + 1) for i in range(3)]
                write(Path(folder), level, force, np.concatenate(rows), kind)
        yield Path(folder)


def test_split(numbered):
    fitted, chosen_by = ["multisine_1", "multisine_7", "sweep_3"], ["multisine_5", "sweep_5"]
    data = f16.load(root=numbered, train=fitted, validation=chosen_by)
    assert [r.name for r in data.train] == [
        "train_multisine_1", "train_multisine_7", "train_sweep_3",
    ]  # fmt: skip
    assert [r.name for r in data.validation] == ["validation_multisine_5", "validation_sweep_5"]
    assert [r.name for r in data.tests] == [
        f"{kind}_{level}" for kind in ("multisine", "sweep") for level in (2, 4, 6)
    ]
    for record, level in zip(data.train[:2], (1, 7), strict=True):
        # Of the numbers of periods 1 to 8, counted from 0: 1 to 8 have the mean 4.5.
        expected = 1_000_000 * level + 4.5 * PERIOD + np.arange(PERIOD)
        assert np.array_equal(record.u[:, 0], expected)
        assert np.array_equal(record.y, expected[:, None] + 1e8 * np.array([1, 2, 3]))
        assert (record.start, record.skip, record.period) == ("periodic", 0, PERIOD)
    from_rest = (data.train[2], *data.validation, *data.tests)
    for record, level in zip(from_rest, (3, 5, 5, 2, 4, 6, 2, 4, 6), strict=True):
        swept = "sweep" in record.name
        expected = 1_000_000 * level + np.arange(SWEPT + level if swept else SAMPLES)
        assert np.array_equal(record.u[:, 0], expected)
        assert np.array_equal(record.y, expected[:, None] + 1e8 * np.array([1, 2, 3]))
        assert (record.start, record.skip) == ("zero", 50)
        assert record.period == (None if swept else PERIOD)
    for record in (*data.train, *data.validation, *data.tests):
        assert (record.fs, record.source) == (400.0, "official")
        names = ["force (N)", "acc1 (m/s²)", "acc2 (m/s²)", "acc3 (m/s²)"]
        assert [str(c) for c in (*record.inputs, *record.outputs)] == names
    assert (data.name, data.noise_rms) == ("f16", None)


def test_multisines_in_any_order(numbered):
    data = f16.load(
        root=str(numbered), train=["multisine_7", "multisine_5"], validation=["multisine_1"]
    )
    assert [r.name for r in data.train] == ["train_multisine_7", "train_multisine_5"]
    assert [int(r.u[0, 0]) // 1_000_000 for r in data.train] == [7, 5]
    assert [r.name for r in data.validation] == ["validation_multisine_1"]
    assert f16.load(root=numbered, validation=[]).validation == []


def test_zeros_that_fill_a_sweep_are_no_measurement(tmp_path, numbered):
    for each in (numbered / FOLDER).iterdir():
        (tmp_path / FOLDER).mkdir(parents=True, exist_ok=True)
        if each.name not in (name(level, "SineSw") for level in (2, 5)):
            (tmp_path / FOLDER / each.name).symlink_to(each)
    signals = np.ones((4, 500))
    signals[0, 420:] = 0
    signals[2:, 400:] = 0  # the others go on a little
    signals[:, 300] = 0
    for level in (2, 5):
        write(tmp_path, level, signals[:1], signals[1:], "SineSw")
    data = f16.load(root=tmp_path, train=["multisine_1"], validation=["sweep_5"])
    assert data.validation[0].samples == 400
    assert next(r for r in data.tests if r.name == "sweep_2").samples == 500


def test_published(numbered):
    """The three numbers of the paper, pooled as scores are; others are of one output."""
    data = f16.load(root=numbered)
    *others, lru = data.published
    (score,) = lru.scores.values()
    test = data.tests[2]
    assert list(lru.scores) == [test.name]
    errors = np.array([0.180, 0.167, 0.368])
    assert metrics.rmse(test, test.y + errors) == pytest.approx(score, rel=1e-6)
    first = data.tests[0].outputs[0].name
    assert all(list(p.scores) == [f"{r.name} {first}" for r in data.tests] for p in others)
    assert all(np.array_equal(r.weight, [1, 0, 0]) for r in data.leaderboard)


@pytest.mark.parametrize("there", [(), (name(4),)])
def test_missing_test_files_are_a_note(numbered, tmp_path, there):
    for each in (numbered / FOLDER).iterdir():
        (tmp_path / FOLDER).mkdir(parents=True, exist_ok=True)
        if "Validation" not in each.name or each.name in there:
            (tmp_path / FOLDER / each.name).symlink_to(each)
    data = f16.load(root=tmp_path)
    assert [r.name for r in data.tests] == ["multisine_4"] * len(there)
    names = " multisine_2, multisine_6, sweep_2, sweep_4, sweep_6" if there else ""
    assert data.notes[0].startswith(f"no test records{names}: {name(2)} and ")
    assert len(data.notes[0]) <= 160
    with pytest.raises((FileNotFoundError, OSError)):
        f16.load(root=tmp_path, download=True)


def test_a_damaged_test_file_is_an_error(numbered, tmp_path):
    shutil.copytree(numbered / FOLDER, tmp_path / FOLDER, symlinks=True)
    (tmp_path / FOLDER / name(4, "SineSw")).write_bytes(b"text " * 99)
    with pytest.raises(ValueError, match="no readable 'Force'"):
        f16.load(root=tmp_path)
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
    assert str(told.value).endswith("beside it, and download them again.")


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
            write(Path(folder), level, signals[:1, :9000], signals[1:, :9000], "SineSw")
        yield Path(folder)


@pytest.mark.numeric
def test_the_mean_of_the_periods_has_less_noise(shaken):
    """Noise of the rms NOISE / √8 in the input and, as the transient is left out, in the outputs.

    The transient fades by exp(-0.03 · 2 π 5 / 400 · 8192) = 4e-9 in the period that is left out.
    """
    for record in f16.load(root=shaken, train=[f"multisine_{n}" for n in (1, 3, 7)]).train:
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
    """The bench from its files to the table: errors of all outputs and of each."""
    sizes = "nx=4 nn=5 starts=1 data.train=[multisine_7]"
    shorter = "trainer.max_iter=2 figures=false"
    overrides = ["+bench=f16", f"data.root='{shaken}'", *sizes.split(), *shorter.split()]
    cfg = composed("config", overrides)
    fit.run(cfg, tmp_path)
    result = json.loads((tmp_path / "metrics.json").read_text())
    names = [f"{kind}_{level}" for kind in ("multisine", "sweep") for level in (2, 4, 6)]
    assert list(result["scores"]) == names
    for record, score in result["scores"].items():
        assert 0 < score["rmse"] < 1.2 * score["lti_rmse"]
        samples = 9000 if "sweep" in record else SAMPLES
        assert (score["samples"], score["skip"], score["unit"]) == (samples, 50, "m/s²")
        assert score["source"] == "official"
        assert score["outputs"] == ["acc1", "acc2", "acc3"]
        pooled = np.sqrt(np.mean(np.square(score["rmse_by_output"])))
        assert pooled == pytest.approx(score["rmse"])
    printed = capsys.readouterr().out
    assert "note: RMSE is that of the three accelerations together" in printed
    assert "deep LRU" in printed
    assert "0.255" in printed
    row = next(line for line in printed.splitlines() if line.startswith("sweep_6 acc1"))
    assert "0.315" in row


@pytest.mark.data
def test_official_files(official):
    """Sweeps begin at rest, and end where the first channel is filled up with zeros."""
    names = [f"sweep_{level}" for level in (1, 3, 5)]
    data = official(f16.load, train=names, validation=["sweep_7"])
    for record in data.train:
        assert np.sqrt(np.mean(record.u[:50] ** 2)) < 0.05 * np.sqrt(np.mean(record.u**2))
        assert record.samples < data.validation[0].samples
        assert np.all(record.y[-1] != 0)
