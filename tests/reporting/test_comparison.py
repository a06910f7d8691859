"""Runs side by side."""

from __future__ import annotations

import csv
import json
import math
import os
import sys
from pathlib import Path

import pytest

from lfrtorch.cli import compare as command
from lfrtorch.reporting import comparison

ERRORS = {(5, 0): 4e-6, (5, 1): 2e-6, (10, 0): 1e-6, (10, 1): 3e-6, (15, 0): 2e-6, (15, 1): None}
"""By neurons and seed."""


def written(folder: Path, nn: int, seed: int, error: float | None, bench: str = "tanks") -> None:
    score = {"rmse": error, "unit": "m"}
    metrics = {
        "bench": bench,
        "command": f"lfrtorch fit +bench={bench} nn={nn} seed={seed}",
        "parameters_net": 10 + nn,
        "validation": {"rmse": error, "lti_rmse": 1e-5, "records": {"validation": score}},
        "scores": {"test": score},
        "fit": {"seconds": 2.0 * nn, "reason": "maximum number of iterations"},
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
    assert {name: len(runs) for name, runs in found.settings.items()} == {
        "nn=10": 2,
        "nn=5": 2,
        "nn=15": 2,
    }
    text = str(found)
    assert "validation (µm)" in text
    assert text.index("nn=10,seed=0") < text.index("nn=10,seed=1") < text.index("nn=15,seed=1")


def test_command_writes_page_and_tables(
    study: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    written(study / "other", 5, 0, 0.5, bench="drives")
    monkeypatch.setattr(sys, "argv", ["lfrtorch compare", str(study), f"out={study / 'out'}"])
    command.launch()
    assert "drives: RMSE of 1 run" in capsys.readouterr().out
    text = (study / "out" / "comparison.csv").read_text()
    rows = list(csv.DictReader(text.splitlines()))
    assert len(rows) == len(ERRORS) + 1
    assert {row["nn"] for row in rows if row["dataset"] == "tanks"} == {"5", "10", "15"}
    assert "| nn=5,seed=0 |" in (study / "out" / "comparison.md").read_text()
    assert (study / "out" / "comparison.html").read_text().count("data:image/png") == 6


def test_data_words_choose_the_record_that_is_simulated(
    study: Path, monkeypatch: pytest.MonkeyPatch
):
    (study / "x.csv").write_text("u,y\n" + "".join(f"{k % 7},{k % 5}\n" for k in range(60)))
    data = f"data=file data.path={study / 'x.csv'} data.inputs=[u] data.outputs=[y] data.fs=10"
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
    file.write_text(json.dumps(json.loads(file.read_text()) | change))
    with pytest.raises(ValueError, match="is not of a run"):
        comparison.compare([tmp_path])


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no named pipes")
def test_metrics_that_are_no_file_are_not_waited_for(tmp_path: Path):
    os.mkfifo(tmp_path / "metrics.json")
    with pytest.raises(ValueError, match="is not of a run"):
        comparison.compare([tmp_path])


def test_other_files_of_that_name_are_refused(tmp_path: Path):
    (tmp_path / "metrics.json").write_text("{}")
    with pytest.raises(ValueError, match="is not of a run"):
        comparison.compare([tmp_path])
