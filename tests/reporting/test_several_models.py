"""One record, simulated by several models."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lfrtorch
from lfrtorch.records import Channel, Record
from lfrtorch.reporting import comparison, several_models

U = np.random.default_rng(0).standard_normal((200, 1))
RECORD = Record(U, np.hstack([U, np.tanh(U)]), 10.0, outputs=(Channel("a"), Channel("b", "m")))


def shown(figure: Any) -> list[list[str]]:
    return [[line.get_label() for line in ax.lines] for ax in figure.axes]


def test_each_output_has_a_row_and_a_model_that_diverges_no_spectrum():
    y = {"good": 0.9 * RECORD.y, "bad": np.full_like(RECORD.y, np.nan)}
    in_time, spectrum, *second = shown(
        several_models.side_by_side(RECORD, y, {"linear": 0.5 * RECORD.y})
    )
    assert in_time == ["measured", "linear, fit 50.0 %", "good, fit 90.0 %", "bad, diverges"]
    assert spectrum == ["output", "linear", "good"]
    assert [len(second[0]), second[1]] == [4, spectrum]


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two settings with two seeds each, as Python writes them."""
    folder = tmp_path_factory.mktemp("runs")
    record = Record(U, np.tanh(U), 10.0, outputs=(Channel("b", "m"),))
    dataset = lfrtorch.Dataset("mine", [record[:100]], [record[100:150]], [record[150:]])
    trainer = lfrtorch.LevenbergMarquardt(max_iter=2)
    for nn, seed in ((1, 0), (1, 1), (3, 0), (3, 1)):
        settings = lfrtorch.Settings(nx=1, nz=1, nn=nn, seed=seed, trainer=trainer)
        run = lfrtorch.identify(dataset, settings)
        words = f"lfrtorch fit nn={nn} seed={seed}"
        lfrtorch.reporting.write(run, folder / f"{nn} {seed}", command=words, draw=False)
    return folder


def test_the_best_run_of_each_setting_simulates_the_record(runs: Path):
    (found,) = comparison.compare([runs])
    record = Record(U[150:], np.tanh(U[150:]), 10.0, outputs=(Channel("b", "m"),))
    figure = found.figures(record)["simulations"]
    best = {label: min(each, key=lambda run: run.error) for label, each in found.settings.items()}
    expected = [
        f"{label}, {several_models.fit_text(record.y[:, 0], y[:, 0])}"
        for label, run in sorted(best.items(), key=lambda one: one[1].error)
        for y in [lfrtorch.load(run.folder).simulate(record)]
    ]
    in_time, _ = shown(figure)
    assert in_time[0] == "measured"
    assert in_time[1].startswith("linear (nx 1), ")
    assert in_time[2:] == expected


def test_models_of_other_channels_are_left_out(runs: Path):
    (found,) = comparison.compare([runs])
    assert found.simulations(RECORD) is None
    assert "simulations" not in found.figures(RECORD)


def test_settings_that_are_alike_in_their_first_letters_stay_apart(runs: Path, tmp_path: Path):
    for source in runs.iterdir():
        nn, seed = source.name.split()
        copy = shutil.copytree(source, tmp_path / source.name)
        metrics = json.loads((copy / "metrics.json").read_text())
        metrics["command"] = f"lfrtorch fit trainer.tolerance={'1' * 40}{nn} seed={seed}"
        (copy / "metrics.json").write_text(json.dumps(metrics))
    (found,) = comparison.compare([tmp_path])
    record = Record(U[150:], np.tanh(U[150:]), 10.0, outputs=(Channel("b", "m"),))
    in_time, _ = shown(found.simulations(record))
    assert len(in_time) == 2 + len(found.settings) == 4


def test_a_damaged_linear_model_costs_no_page(runs: Path, tmp_path: Path):
    copy = shutil.copytree(runs, tmp_path / "runs")
    for linear in copy.glob("*/linear/model.json"):
        linear.write_text("{")
    (found,) = comparison.compare([copy])
    record = Record(U[150:], np.tanh(U[150:]), 10.0, outputs=(Channel("b", "m"),))
    in_time, _ = shown(found.simulations(record))
    assert in_time[0] == "measured"
    assert not any(label.startswith("linear") for label in in_time)
