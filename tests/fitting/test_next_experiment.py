"""The next experiment: within its limits, and it tells more than others."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from reference import measure, random_cell, random_model

import lfrtorch
from lfrtorch import InputError, LevenbergMarquardt, Model, Record, multisine, next_experiment
from lfrtorch.fitting.information import informed

pytestmark = pytest.mark.numeric


def plant(u: np.ndarray, noise: float = 0.02, seed: int = 0) -> np.ndarray:
    """A slow system behind a saturation."""
    y, rng = np.zeros(len(u)), np.random.default_rng(seed)
    for k in range(len(u) - 1):
        y[k + 1] = 0.9 * y[k] + 0.1 * np.tanh(2.0 * u[k])
    return y + noise * rng.standard_normal(len(u))


@pytest.fixture(scope="module")
def first() -> tuple[Model, Record]:
    u = multisine(400, rms=0.5, seed=1).u[0, :, 0]
    record = Record(u, plant(u), name="first")
    model = lfrtorch.initialise(lfrtorch.estimate_bla(record, nx=1), record, nz=1, nw=1, nn=3)
    return lfrtorch.fit(model, record, trainer=LevenbergMarquardt(max_iter=40)).model, record


def test_it_tells_more_than_a_flat_multisine_of_the_same_rms(first):
    model, record = first
    found = next_experiment(model, record, limits={"u": (-2, 2), "rms": 0.5}, samples=400)
    flat = multisine(400, rms=0.5, seed=2).u[0, :, 0]

    def told(u: np.ndarray) -> float:
        both = [record, Record(u, plant(u, seed=3))]
        information = informed(model, both).information
        assert information is not None
        s = torch.linalg.svdvals(information.R * information.rmse)
        return float(s[s > 1e-6 * s[0]].log().sum())

    assert told(found.record.u[:, 0]) > told(flat) + 1.0
    again = next_experiment(model, record, limits={"u": (-2, 2), "rms": 0.5}, samples=400)
    assert np.array_equal(again.record.u, found.record.u)
    assert all(found.after[g] <= found.before[g] * 1.000001 for g in found.before)
    assert found.visited[1] >= found.visited[0]
    for text in ("static.Wz", "crest factor", "visited part"):
        assert text in str(found)


def test_limits_are_kept(first):
    model, record = first
    low, high = record.y.min(), record.y.max()
    limits = {"u": (0.1, 0.9), "du": 0.2, "y": (low, high), "rms": 0.3}
    u = next_experiment(model, record, limits=limits, samples=300).record.u
    assert len(u) == 300
    assert abs(u[0, 0] - 0.5) <= 0.2  # it begins at rest in the middle
    assert u.min() >= 0.1 - 1e-12
    assert u.max() <= 0.9 + 1e-12
    assert np.abs(np.diff(u, axis=0)).max() <= 0.2 + 1e-12
    assert np.sqrt(np.mean((u - 0.5) ** 2)) <= 0.3 + 1e-12
    y = model.simulate(u)
    assert y.min() >= low
    assert y.max() <= high
    wide = next_experiment(model, record).record  # no limits: those of the data
    assert wide.samples == record.samples
    assert wide.u.min() >= record.u.min() - 1e-12


def test_short_experiments(first):
    for samples in range(32, 50, 5):  # stretches of few samples have few lines
        found = next_experiment(*first, samples=samples, seed=samples)
        assert found.record.samples == samples


def test_several_channels_are_written_for_a_generator(tmp_path: Path):
    model = random_model(random_cell(2, 2, 3, 2, 1, 3))
    record = measure(model, 300)
    limits = {"u": [(-1, 1), (0, 3)], "rms": [0.4, 2.0]}
    found = next_experiment(model, record, limits=limits, samples=200)
    rows = np.loadtxt(found.save(tmp_path / "next.csv"), delimiter=",", skiprows=1)
    head = (tmp_path / "next.csv").read_text().splitlines()[0]
    assert head == "t [s],u1 (N),u2 (N)"
    np.testing.assert_allclose(rows[:, 1:], found.record.u, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(rows[1, 0], 1 / model.fs)
    assert found.record.u[:, 1].min() >= 0
    assert np.abs(found.record.u[:, 0]).max() <= 1


def test_a_predictor_is_improved_as_one(first):
    _, record = first
    linear = lfrtorch.estimate_bla(record, nx=1, refine="prediction")
    model = lfrtorch.initialise(linear, record, nz=1, nw=1, nn=2)
    found = next_experiment(model, record, samples=100)
    assert found.after["A"] < found.before["A"]


@pytest.mark.parametrize(
    ("limits", "samples", "why"),
    [
        ({"v": 1}, 100, "limits have"),
        ({"u": (1, -1)}, 100, "limits of u are"),
        ({"u": (0, 1), "rms": -1}, 100, "du and rms"),
        ({"y": (50, 60)}, 100, "wider limits of y"),
        ({}, 10, "samples is 10"),
    ],
)
def test_wrong_limits_are_refused(first, limits, samples, why):
    with pytest.raises(InputError, match=why):
        next_experiment(*first, limits=limits, samples=samples)
