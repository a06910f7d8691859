"""Runs side by side."""

from __future__ import annotations

import csv
import json
import math
import os
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lfrtorch
from lfrtorch.cli import compare as command
from lfrtorch.records import Channel, Record
from lfrtorch.reporting import comparison

U = np.random.default_rng(0).standard_normal((200, 1))
RECORD = Record(U, np.hstack([U, np.tanh(U)]), 10.0, outputs=(Channel("a"), Channel("b", "m")))

ERRORS = {(5, 0): 4e-6, (5, 1): 2e-6, (10, 0): 1e-6, (10, 1): 3e-6, (15, 0): 2e-6, (15, 1): None}
"""By neurons and seed."""


def written(folder: Path, nn: int, seed: int, error: float | None, bench: str = "tanks") -> None:
    score = {"rmse": error, "unit": "m", "lti_rmse": 2e-5}
    metrics = {
        "bench": bench,
        "command": f"lfrtorch fit +bench={bench} nn={nn} seed={seed}",
        "parameters_net": 10 + nn,
        "validation": {"rmse": error, "lti_rmse": 1e-5, "records": {"validation": score}},
        "scores": {"test": score},
        "lti_nx": 3,
        "fit": {"seconds": 2.0 * nn, "reason": "maximum number of iterations"},
        "chosen_iteration": 0 if nn == 15 else 7,
    }
    folder.mkdir(parents=True)
    (folder / "metrics.json").write_text(json.dumps(metrics))


@pytest.fixture
def study(tmp_path: Path) -> Path:
    for (nn, seed), error in ERRORS.items():
        written(tmp_path / f"nn={nn},seed={seed}", nn, seed, error)
    return tmp_path


def test_front_and_settings(study: Path):
    (found,) = comparison.compare([study])
    assert found.varied == ["nn", "seed"]
    assert [(run.parameters, run.error) for run in found.front] == [(15, 2e-6), (20, 1e-6)]
    assert math.isnan(found.runs[-1].error)
    assert set(found.settings) == {"nn=10", "nn=5", "nn=15"}
    assert [len(runs) for runs in found.settings.values()] == [2, 2, 2]
    text = str(found)
    assert "validation (µm)" in text
    head, rows = found.rows()
    assert head[4] == "median"
    *rows, linear = rows
    assert linear == ["linear (nx 3)", None, None, 10.0, None, 20.0, None, None]
    assert "kept the start: maximum number of iterations" in str(rows[-1])
    assert "kept" not in str(rows[0])
    medians = {str(row[0]).partition(",")[0]: row[4] for row in rows}
    assert medians == pytest.approx({"nn=10": 1.0, "nn=5": 2.0, "nn=15": 2.0})
    assert text.index("nn=10,seed=0") < text.index("nn=10,seed=1") < text.index("nn=15,seed=1")


def test_command_writes_page_and_tables(study: Path, monkeypatch, capsys):
    written(study / "other", 5, 0, 0.5, bench="drives")
    monkeypatch.setattr(sys, "argv", ["lfrtorch compare", str(study), f"out={study / 'out'}"])
    command.launch()
    assert "drives: RMSE of 1 run" in capsys.readouterr().out
    text = (study / "out" / "comparison.csv").read_text()
    rows = list(csv.DictReader(text.splitlines()))
    assert len(rows) == len(ERRORS) + 1
    assert {row["nn"] for row in rows if row["dataset"] == "tanks"} == {"5", "10", "15"}
    assert "| nn=5,seed=0 " in (study / "out" / "comparison.md").read_text()
    assert (study / "out" / "comparison.html").read_text().count("data:image/png") == 2


def test_data_words_choose_the_record_that_is_simulated(study: Path, monkeypatch):
    (study / "x.csv").write_text("u,y\n" + "".join(f"{k % 7},{k % 5}\n" for k in range(60)))
    data = f"data=file data.path={study / 'x.csv'} data.inputs=[u] data.outputs=[y] data.fs=10"
    data += " data.start=zero"
    chosen = []
    monkeypatch.setattr(command, "run", lambda *_, record: chosen.append(record))
    in_a_study = study / "nn=5,seed=0"  # a folder with the look of a setting
    for words in ([], data.split()):
        monkeypatch.setattr(sys, "argv", ["lfrtorch compare", str(in_a_study), *words])
        command.launch()
    assert chosen[0] is None
    assert chosen[1].name == "validation"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["data._target_=os.getcwd"], "names code"),
        (["data=file", "data.path=gone.csv"], "gone.csv"),
    ],
)
def test_data_that_are_gone_or_that_a_folder_makes_by_code_are_not_shown(
    study: Path, words: list[str], said: str, capsys: pytest.CaptureFixture[str]
):
    best = study / "nn=10,seed=0" / ".hydra"
    best.mkdir()
    (best / "overrides.yaml").write_text(json.dumps(words))
    command.run([study])
    printed = capsys.readouterr().out
    assert said in printed
    assert "the page shows no record" in printed
    assert (study / "comparison.html").is_file()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["none"], "no folder"),
        (["."], "no run came to its end"),
        ([".", "nm=3"], "no setting 'nm'"),
    ],
)
def test_folders_without_runs_are_refused(
    words: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["lfrtorch compare", *words])
    with pytest.raises(SystemExit):
        command.launch()
    assert said in capsys.readouterr().err


@pytest.mark.parametrize(
    "change",
    [
        {"bench": []},
        {"command": 5},
        {"parameters_net": "x"},
        {"scores": 1},
        {"validation": {"rmse": [], "lti_rmse": 1.0, "records": {}}},
        {"fit": {"seconds": {}, "reason": "done"}},
        {"fit": {"seconds": 1.0, "reason": 1}},
    ],
)
def test_metrics_of_other_kinds_are_refused(tmp_path: Path, change: dict):
    written(tmp_path / "run", 5, 0, 1.0)
    file = tmp_path / "run" / "metrics.json"
    for text in (json.dumps(json.loads(file.read_text()) | change), "{}"):
        file.write_text(text)
        with pytest.raises(ValueError, match="is not of a run"):
            comparison.compare([tmp_path])


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no named pipes")
def test_metrics_that_are_no_file_are_not_waited_for(tmp_path: Path):
    os.mkfifo(tmp_path / "metrics.json")
    with pytest.raises(ValueError, match="is not of a run"):
        comparison.compare([tmp_path])


def shown(figure: Any) -> list[list[str]]:
    return [[line.get_label() for line in ax.lines] for ax in figure.axes]


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
    drawn = found.figures(record)
    best = {label: min(each, key=lambda run: run.error) for label, each in found.settings.items()}
    (linear, _), *simulated = found.simulations(record).items()
    assert linear == "linear (nx 1)"
    assert [label for label, _ in simulated] == sorted(best, key=lambda label: best[label].error)
    for label, y_hat in simulated:
        assert np.array_equal(y_hat, lfrtorch.load(best[label].folder).simulate(record))
    assert shown(drawn["close_up"])[0] == ["measured", linear, *dict(simulated)]
    assert shown(drawn["density"])[0][0] == "output"


def test_models_of_other_channels_are_left_out(runs: Path):
    (found,) = comparison.compare([runs])
    assert not found.simulations(RECORD)
    assert found.figures(RECORD).keys() == {"parameters", "seeds"}
    assert comparison.Comparison("alone", found.runs[:1]).figures(RECORD) == {}


def test_settings_that_are_alike_in_their_first_letters_stay_apart(runs: Path, tmp_path: Path):
    for source in runs.iterdir():
        nn, seed = source.name.split()
        copy = shutil.copytree(source, tmp_path / source.name)
        metrics = json.loads((copy / "metrics.json").read_text())
        metrics["command"] = f"lfrtorch fit trainer.tolerance={'1' * 40}{nn} seed={seed}"
        (copy / "metrics.json").write_text(json.dumps(metrics))
    (found,) = comparison.compare([tmp_path])
    record = Record(U[150:], np.tanh(U[150:]), 10.0, outputs=(Channel("b", "m"),))
    assert len(found.simulations(record)) == 1 + len(found.settings) == 3


def test_a_damaged_linear_model_costs_no_page(runs: Path, tmp_path: Path):
    copy = shutil.copytree(runs, tmp_path / "runs")
    for linear in copy.glob("*/linear/model.json"):
        linear.write_text("{")
    (found,) = comparison.compare([copy])
    record = Record(U[150:], np.tanh(U[150:]), 10.0, outputs=(Channel("b", "m"),))
    simulated = found.simulations(record)
    assert simulated
    assert not any(label.startswith("linear") for label in simulated)
