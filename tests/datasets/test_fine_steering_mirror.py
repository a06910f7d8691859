"""Fine steering mirror: the split, the files, and scores as the board has them."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lfrtorch
from lfrtorch.datasets import fine_steering_mirror
from lfrtorch.reporting import scores
from lfrtorch.reporting.evaluation import Evaluation

FILE = "FineSteeringMirror/combined_data.npz"
LEVELS = 100, 200, 300
N = 120
REALISATIONS = {"train": 6, "test": 3}


def numbered(level: int, use: str) -> np.ndarray:
    """Samples say their level, realisation, period, channel and number."""
    k, channel, r, p = np.indices((N, 3, REALISATIONS[use], 2))
    return 1e6 * level + 1e5 * r + 1e4 * p + 1e3 * channel + k + (use == "test") * 1e9


def write(root: Path, *uses: str, **changed: Any) -> Path:
    """A file of the official layout with some of its arrays; its root."""
    arrays: dict[str, Any] = {}
    for use in uses:
        for level in LEVELS:
            arrays[f"u_{level}mV_{use}"] = numbered(level, use)
            arrays[f"y_{level}mV_{use}"] = -numbered(level, use)
    path = root / FILE
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, **(arrays | changed))
    return root


def test_split(tmp_path):
    data = fine_steering_mirror.load(root=write(tmp_path, "train", "test"))
    names = [f"train_{level}_{r}" for level in LEVELS for r in range(1, 6)]
    assert [r.name for r in data.train] == names
    for i, record in enumerate(data.train):
        whole = numbered(LEVELS[i // 5], "train")[:, :, i % 5]
        assert np.array_equal(record.u, whole.mean(axis=2))
        assert np.array_equal(record.y, -whole.mean(axis=2))
        assert record.skip == 0
    held = [(level, 5, p) for level in LEVELS for p in range(2)]
    for record, (level, r, p) in zip(data.validation, held, strict=True):
        assert record.name == f"validation_{level}_{r + 1}_{p + 1}"
        assert np.array_equal(record.u, numbered(level, "train")[:, :, r, p])
    tested = [(level, r, p) for level in LEVELS for r in range(3) for p in range(2)]
    for record, (level, r, p) in zip(data.tests, tested, strict=True):
        assert record.name == f"level_{level}_{r + 1}_{p + 1}"
        assert np.array_equal(record.y, -numbered(level, "test")[:, :, r, p])
    for record in (*data.validation, *data.tests):
        assert record.skip == 100
    for record in (*data.train, *data.validation, *data.tests):
        assert (record.fs, record.start, record.period) == (6400.0, "periodic", N)
        channels = [str(c) for c in (*record.inputs, *record.outputs)]
        assert channels == [f"u{i} (V)" for i in (1, 2, 3)] + [f"y{i} (m)" for i in (1, 2, 3)]
    assert {data.score_of(r) for r in data.tests} == {f"level_{level}" for level in LEVELS}
    assert data.linear["level_200"] == tuple(f"train_200_{r}" for r in range(1, 6))
    assert data.notes == ()


def test_what_trains(tmp_path):
    root = write(tmp_path, "train", "test")
    data = fine_steering_mirror.load(root=root, levels=[300, 100], validation=2)
    assert [r.name[:9] for r in data.train] == ["train_300"] * 4 + ["train_100"] * 4
    assert len(data.validation) == 8
    assert len(data.tests) == 18  # of all levels
    assert list(data.linear) == ["level_300", "level_100"]
    assert fine_steering_mirror.load(root=root, validation=0).validation == []
    both = fine_steering_mirror.load(root=root, mean=False).train[3]
    assert np.array_equal(both.u[:N], numbered(100, "train")[:, :, 3, 0])
    assert np.array_equal(both.y[N:], -numbered(100, "train")[:, :, 3, 1])
    assert (both.samples, both.period, both.start) == (2 * N, N, "periodic")


def test_without_test_arrays(tmp_path):
    data = fine_steering_mirror.load(root=write(tmp_path, "train"))
    assert (data.tests, len(data.train), dict(data.linear)) == ([], 15, {})
    assert data.notes[0].startswith("no test records: ")
    some = {name: numbered(100, "test") for name in ("u_100mV_test", "y_100mV_test")}
    data = fine_steering_mirror.load(root=write(tmp_path, "train", **some))
    assert len(data.tests) == 6
    assert data.notes[0].startswith("no test records level_200, level_300: ")


def test_one_realisation_trains_at_least(tmp_path):
    with pytest.raises(ValueError, match="give 0 to 5"):
        fine_steering_mirror.load(root=write(tmp_path, "train"), validation=6)


@pytest.mark.parametrize(
    ("changed", "match"),
    [
        ({"y_200mV_train": np.zeros((N, 3, 6))}, r"y_200mV_train \(120, 3, 6\)"),
        ({"u_100mV_test": np.zeros((N, 3, 3, 2))}, r"y_100mV_test \(0,\)"),
        ({"u_100mV_train": np.full((N, 3, 6, 2), np.nan)}, "without NaN"),
    ],
)
def test_another_layout(tmp_path, changed, match):
    with pytest.raises(ValueError, match=match) as told:
        fine_steering_mirror.load(root=write(tmp_path, "train", **changed))
    assert str(told.value).endswith("beside it, and download them again.")


@pytest.mark.numeric
def test_a_score_is_the_mean_over_outputs_realisations_and_periods(tmp_path):
    """A model of gain 1 on outputs that are the inputs and an offset of known size."""
    rng = np.random.default_rng(0)
    arrays, expected = {}, {}
    for level in LEVELS:
        u = rng.standard_normal((N, 3, 6, 2))
        offset = rng.uniform(1, 2, (1, 3, 3, 2))
        arrays |= {f"u_{level}mV_train": u, f"y_{level}mV_train": u}
        tested = u[:, :, :3]
        arrays |= {f"u_{level}mV_test": tested, f"y_{level}mV_test": tested + offset}
        expected[f"level_{level}"] = offset
    data = fine_steering_mirror.load(root=write(tmp_path, **arrays))
    model = lfrtorch.LinearModel(
        A=np.zeros((1, 1)), B=np.zeros((1, 3)), C=np.zeros((3, 1)), D=np.eye(3), fs=6400.0,
        u_offset=np.zeros(3), y_offset=np.zeros(3),
        inputs=data.train[0].inputs, outputs=data.train[0].outputs,
    ).to_model()  # fmt: skip
    evaluation = Evaluation(dataset=data, model=model)
    found = scores.scored(evaluation)
    assert list(found["scores"]) == list(expected)
    for name, offset in expected.items():
        score = found["scores"][name]
        assert score["rmse"] == pytest.approx(offset.mean(), rel=1e-9)
        assert score["rmse_by_output"] == pytest.approx(offset.mean(axis=(0, 2, 3)), rel=1e-9)
        assert (score["records"], score["scored"]) == (6, 6 * 20)
        assert score["lti_rmse"] is None
    assert found["validation"]["records"]["validation_100"]["rmse"] < 1e-9
    text = scores.table(evaluation)
    assert "(µm)" in text
    assert "0.0866" in text


@pytest.mark.data
def test_the_official_file(official):
    data = official(fine_steering_mirror.load)
    assert all(r.u.shape == (8192, 3) for r in (*data.train, *data.validation, *data.tests))
    for record in data.train:
        volts = 1e-3 * int(record.name.split("_")[1])
        assert np.sqrt(np.mean(record.u**2)) == pytest.approx(volts, rel=0.05)
