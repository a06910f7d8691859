"""Electro-mechanical positioning system: the split, the files, and a run on a simulated axis."""

import json
import math
from dataclasses import replace
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pytest
from experiments import scored
from scipy.io import savemat

import lfrtorch
from lfrtorch.cli import fit
from lfrtorch.cli.composition import composed
from lfrtorch.datasets import emps

ESTIMATION, TEST = FILES = ("EMPS/DATA_EMPS.mat", "EMPS/DATA_EMPS_PULSES.mat")
SAMPLES = 24_841


def write(root: Path, estimation: dict[str, np.ndarray], test: dict[str, np.ndarray]) -> Path:
    """Files of the official layout; their root."""
    (root / "EMPS").mkdir(parents=True, exist_ok=True)
    for file, signals in zip(FILES, (estimation, test), strict=True):
        savemat(root / file, {"gtau": GAIN, **{k: v[:, None] for k, v in signals.items()}})
    return root


def numbers(sign: int = 1) -> dict[str, np.ndarray]:
    """Samples are their numbers, counted from 1."""
    number = np.arange(1.0, SAMPLES + 1)
    return {"t": number / 1000, "qg": 0 * number, "qm": -sign * number, "vir": sign * number}


@pytest.fixture
def numbered(tmp_path):
    return write(tmp_path, numbers(), numbers(-1))


def test_split(numbered):
    data = emps.load(root=numbered, validation=0.2)
    (training,), (validation,), (test,) = data.train, data.validation, data.tests
    assert [r.name for r in (training, validation, test)] == ["train", "validation", "test"]
    assert scored(training) == (1, 19_873)
    assert scored(validation) == (19_873 + 1, SAMPLES)
    assert scored(test) == (-21, -SAMPLES)  # of the other file
    assert [r.samples for r in (training, validation, test)] == [19_873, SAMPLES, SAMPLES]
    for record in (training, validation, test):
        assert np.array_equal(record.y, -record.u)
        assert (record.fs, record.source) == (1000.0, "official")
        assert [str(c) for c in (*record.inputs, *record.outputs)] == ["vir (V)", "qm (m)"]
    assert [r.start for r in (training, validation, test)] == ["zero", "zero", "estimated"]
    assert data.leaderboard == data.tests
    assert (data.name, data.noise_rms) == ("emps", None)
    published = {p.label: p.scores["test"] for p in data.published}
    assert published["dynoNet"] == pytest.approx(2.64e-3)
    assert published["CT-SUBNET"] == pytest.approx(4.61e-3)


def test_a_test_from_the_same_place_begins_there_at_rest(tmp_path):
    data = emps.load(root=write(tmp_path, numbers(), numbers()))
    assert [(r.start, r.skip) for r in data.tests] == [("zero", 20)]


def test_copies_with_a_shifted_input(numbered):
    data = emps.load(root=numbered, validation=0.5, drift=0.01)
    for records in (data.train, data.validation):
        plain, up, down = records
        assert np.allclose(up.u - plain.u, 0.01)
        assert np.allclose(down.u - plain.u, -0.01)
        assert all(np.array_equal(plain.y, r.y) and r.skip == plain.skip for r in records)
    assert [r.name for r in data.train] == ["train", "train_up", "train_down"]


def test_the_archive_does_as_well(tmp_path):
    write(tmp_path, numbers(), numbers(-1))
    with ZipFile(tmp_path / "EMPS" / "EMPS.zip", "w") as packed:
        for file in FILES:
            packed.write(tmp_path / file, Path(file).name)
            (tmp_path / file).unlink()
    data = emps.load(root=tmp_path)
    assert scored(data.train[0]) == (1, SAMPLES)
    assert scored(data.tests[0]) == (-21, -SAMPLES)


def test_all_samples_train(numbered):
    data = emps.load(root=numbered)
    assert (data.train[0].samples, data.validation) == (SAMPLES, [])
    assert not data.selection


def test_a_missing_test_file_is_a_note(numbered):
    (numbered / TEST).unlink()
    data = emps.load(root=numbered)
    assert (data.tests, data.leaderboard, data.train[0].samples) == ([], [], SAMPLES)
    (note,) = data.notes
    assert note.startswith("no test records: DATA_EMPS_PULSES.mat")
    (numbered / TEST).write_bytes(b"text " * 99)
    with pytest.raises(ValueError, match=r"remove .* and download them again"):
        emps.load(root=numbered)


def test_a_wrong_file_is_refused_with_advice(numbered):
    savemat(numbered / TEST, {"vir": np.zeros((1, SAMPLES)), "qm": np.zeros((SAMPLES, 1))})
    match = r"'vir' has shape \(1, 24841\).*remove 'DATA_EMPS_PULSES.mat' and any archive"
    with pytest.raises(ValueError, match=match):
        emps.load(root=numbered)


GAIN, MASS, VISCOUS, DRY, LOAD = 35.15, 95.1, 203.5, 20.4, -3.2  # N/V, kg, N s/m, N, N
NOISE = 1e-6  # m rms


def axis(
    targets: list[float], pulses: np.ndarray, seed: int, *, dry: float = DRY, load: float = LOAD
) -> dict[str, np.ndarray]:
    """A mass with viscous and dry friction that a controller moves to a target every 3.5 s.

    Pulses (V) are added to the controller's output. Every move takes 2 s.
    """
    t = np.arange(SAMPLES) / 1000
    move, s = (t // 3.5).astype(int), np.clip(t % 3.5 / 2.0, 0.0, 1.0)
    levels = np.array([0.0, *targets])
    qg = levels[move] + (levels[move + 1] - levels[move]) * s**3 * (10 - 15 * s + 6 * s**2)
    q, v, signals = 0.0, 0.0, []
    for reference, pulse in zip(qg.tolist(), pulses.tolist(), strict=True):
        volts = min(10.0, max(-10.0, 240.0 * (20.0 * (reference - q) - v) + pulse))
        signals.append((q, volts))
        v += 1e-3 / MASS * (GAIN * volts - VISCOUS * v - dry * math.tanh(v / 1e-3) - load)
        q += 1e-3 * v
    qm, vir = np.array(signals).T
    noise = NOISE * np.random.default_rng(seed).standard_normal(SAMPLES)
    return {"t": t, "qg": qg, "qm": qm + noise, "vir": vir}


def pulses() -> np.ndarray:
    """Pulses of 1.5 V for 0.1 s."""
    found, rng = np.zeros(SAMPLES), np.random.default_rng(0)
    for first in range(1500, SAMPLES, 1750):
        found[first : first + 100] = 1.5 * rng.choice([-1, 1])
    return found


def errors(root: Path, *words: str) -> dict[str, float]:
    """Of the test, by a run on the files below ``root``."""
    fit.run(composed("config", [f"data.root='{root}'", "figures=false", *words]), root)
    return json.loads((root / "metrics.json").read_text())["scores"]["test"]


@pytest.mark.numeric
def test_start_states_of_an_integrator(tmp_path):
    """The window of 20 samples finds them; from zero state the position is wrong for good."""
    moves = 4 * [0.24, 0.0]
    free = axis(moves, np.zeros(SAMPLES), 0, dry=0.0, load=0.0)
    (whole,) = emps.load(root=write(tmp_path, free, free)).train
    record = replace(whole[15_000:], start="estimated", skip=20)  # begins in the middle of a move
    keep = 1 - VISCOUS / MASS / 1000
    exact = lfrtorch.LinearModel(
        A=np.array([[1.0, keep / 1000], [0.0, keep]]),  # position, velocity
        B=GAIN / MASS * np.array([[1e-6], [1e-3]]),
        C=np.array([[1.0, 0.0]]),
        D=np.zeros((1, 1)),
        fs=1000.0,
        u_offset=np.zeros(1),
        y_offset=np.zeros(1),
        inputs=record.inputs,
        outputs=record.outputs,
    )
    # 20 noisy positions give the velocity to NOISE / 0.026 s, and the mass rolls on for 0.47 s.
    assert np.abs(exact.simulate(record) - record.y).max() < 5 * NOISE * 0.47 / 0.026
    from_zero = np.abs(exact.simulate(replace(record, start="zero")) - record.y)
    assert from_zero[-1000:].min() > 0.1


@pytest.mark.numeric
@pytest.mark.slow
def test_friction_is_identified(tmp_path):
    """From 15 mm of the linear model to less than 1 mm, on another motion."""
    estimation = axis([0.2, 0.05, 0.24, 0.0, 0.1, 0.02, 0.2, 0.1], np.zeros(SAMPLES), 0)
    root = write(tmp_path, estimation, axis(4 * [0.24, 0.0], pulses(), 1))
    found = errors(root, "+bench=emps_known")
    assert found["lti_rmse"] > 1e-2
    assert found["rmse"] < 1e-3


@pytest.mark.numeric
@pytest.mark.slow
def test_a_drift_of_the_friction_is_forgotten(tmp_path):
    """0.4 N more than in training are 13 mm for equations that integrate."""
    moves = 4 * [0.24, 0.0]
    test = axis(moves, pulses(), 1, load=LOAD + 0.4)
    write(tmp_path, axis(moves, np.zeros(SAMPLES), 0), test)
    integrating = errors(tmp_path, "+bench=emps_known")["rmse"]
    assert integrating > 1e-2
    assert errors(tmp_path, "+bench=emps", "starts=4")["rmse"] < integrating / 2


@pytest.mark.data
def test_official_files(official):
    data = official(emps.load)
    for record in (*data.train, *data.tests):
        assert np.abs(record.u).max() <= 10.0  # V, where the controller saturates
        assert 0.1 < np.ptp(record.y) < 1.0  # m
