"""Scores of a checkpoint from the command line: the table of a run, JSON, messages."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import configuration, file_overrides
from reference import measure, random_cell, random_model

import lfrtorch
from lfrtorch.cli import command, evaluate, fit
from lfrtorch.data.dataset import Dataset, Published

MODEL = random_model(random_cell(), fs=50.0)
LINEAR = lfrtorch.LinearModel(
    *(getattr(MODEL.lfr.cell, name).detach().numpy() for name in ("A", "Bu", "Cy", "Dyu")),
    fs=50.0, u_offset=np.zeros(1), y_offset=np.zeros(1),
    inputs=MODEL.inputs, outputs=MODEL.outputs,
)  # fmt: skip


def dataset(fs: float = 50.0, name: str = "u1", unit: str = "N") -> Dataset:
    """A steady state and a record from rest, both off by 0.25 mm where they are scored."""
    periodic, rest = measure(MODEL, 64, start="periodic"), measure(MODEL, 80, seed=1, skip=30)
    inputs = (lfrtorch.Channel(name, unit),)
    tests = [
        replace(record, y=record.y + 0.25, fs=fs, name=called, source="simulated", inputs=inputs)
        for record, called in ((periodic, "steady"), (rest, "rest"))
    ]
    validation = replace(tests[1], name="validation")
    paper = Published("paper", {"rest": 0.125}, "A (2001)")
    return Dataset(
        "small", [validation], [validation], tests, published=(paper,), notes=("a note",),
        linear={"rest": ("validation",)},
    )  # fmt: skip


DATA = "+data={_target_: cli.test_evaluate.dataset}"


@pytest.fixture
def run_folder(tmp_path: Path) -> Path:
    MODEL.save(tmp_path / "run" / "model")
    LINEAR.save(tmp_path / "run" / "linear")
    return tmp_path / "run"


def run(monkeypatch: pytest.MonkeyPatch, *words: str) -> None:
    monkeypatch.setattr(sys, "argv", ["evaluate.py", *words])
    command.run("evaluate", evaluate.main)  # with data of these tests


@pytest.mark.numeric
def test_scores_are_those_of_the_model_from_the_start_of_each_record(
    run_folder: Path, tmp_path: Path, monkeypatch, capsys
):
    out = tmp_path / "scores.json"
    run(monkeypatch, f"checkpoint={run_folder}", DATA, f"out={out}", "nx=7")
    found = json.loads(out.read_text())
    assert found["checkpoint"] == str(run_folder)
    assert set(found["scores"]) == {"steady", "rest"}
    for record in dataset().tests:
        score = found["scores"][record.name]
        assert score["rmse"] == pytest.approx(0.25, rel=1e-8)
        assert score["lti_rmse"] == lfrtorch.rmse(record, LINEAR.simulate(record))
        assert (score["samples"], score["skip"]) == (record.samples, record.skip)
    assert found["validation"]["rmse"] == pytest.approx(0.25, rel=1e-8)
    assert found["sizes"]["nx"] == 2
    assert "scripts/evaluate.py" in found["command"]
    part = found["residuals"]["rest"]["y1"]
    assert part["bias"] == pytest.approx(0.25, rel=1e-8)
    printed = capsys.readouterr()
    assert part["verdict"] in printed.out
    assert printed.err == ""
    for words in ("note: a note", "Simulation RMSE (mm), nx 2, nz 1", "steady ", "paper: A (2001)"):
        assert words in printed.out
    assert "note: the linear model is that of all training records" in printed.out
    rest = next(line for line in printed.out.splitlines() if line.startswith("rest "))
    assert rest.split()[1:7] == ["test", "simulated", "last", "50", "of", "80"]
    assert rest.split()[-2:] == ["0.250", "0.125"]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run", "scores.json"]


def test_the_folder_of_a_run_that_is_at_work_is_a_place_like_others(
    run_folder: Path, monkeypatch, capsys
):
    (run_folder / "config.yaml").touch()
    monkeypatch.chdir(run_folder)
    with run_folder_locked(run_folder):
        run(monkeypatch, "checkpoint=.", DATA)
    assert "Simulation RMSE (mm)" in capsys.readouterr().out


@contextmanager
def run_folder_locked(folder: Path) -> Iterator[None]:
    """As a fit that writes into it has it."""
    fcntl = pytest.importorskip("fcntl", reason="this system has no such locks")
    handle = os.open(folder, os.O_RDONLY)
    fcntl.flock(handle, fcntl.LOCK_EX)
    yield
    os.close(handle)


def test_the_model_folder_of_a_run_will_do(run_folder: Path, monkeypatch, capsys):
    run(monkeypatch, f"checkpoint={run_folder / 'model'}", DATA)
    assert "no linear model is scored" not in capsys.readouterr().out


def test_without_a_linear_model_it_has_no_column(tmp_path: Path, monkeypatch, capsys):
    MODEL.save(tmp_path / "alone")
    run(monkeypatch, f"checkpoint={tmp_path / 'alone'}", DATA, f"out={tmp_path / 'a.json'}")
    found = json.loads((tmp_path / "a.json").read_text())
    assert found["scores"]["rest"]["lti_rmse"] is None
    assert found["validation"]["lti_rmse"] is None
    printed = capsys.readouterr().out
    assert "has no folder linear/, so no linear model is scored" in printed
    rest = next(line for line in printed.splitlines() if line.startswith("rest "))
    assert rest.split()[-4:] == ["of", "80", "0.250", "0.125"]
    assert "linear" not in printed.split("record")[1]


@pytest.mark.numeric
def test_the_linear_model_of_a_run_is_scored_as_a_model(run_folder: Path, monkeypatch, capsys):
    out = run_folder / "scores.json"
    run(monkeypatch, f"checkpoint={run_folder / 'linear'}", DATA, f"out={out}")
    printed = capsys.readouterr().out
    assert "a linear model\n" in printed
    assert "linear  " in printed.split("record")[1]
    assert "NL-LFR" not in printed
    alone = json.loads(out.read_text())["scores"]
    run(monkeypatch, f"checkpoint={run_folder}", DATA, f"out={out}", "overwrite=true")
    both = json.loads(out.read_text())["scores"]
    for name, score in alone.items():
        assert score["rmse"] == pytest.approx(
            both[name]["lti_rmse"], rel=1e-9
        )  # another recurrence
        assert score["lti_rmse"] is None


@pytest.mark.numeric
def test_a_run_is_scored_as_it_scored_itself(csv: Path, tmp_path: Path, monkeypatch, capsys):
    folder = tmp_path / "run"
    folder.mkdir()
    words = [*file_overrides(csv), "nx=1", "nn=2", "trainer.max_iter=1"]
    fit.run(configuration(*words), folder)
    run(monkeypatch, f"checkpoint={folder}", *words, f"out={tmp_path / 'scores.json'}")
    found = json.loads((tmp_path / "scores.json").read_text())
    metrics = json.loads((folder / "metrics.json").read_text())
    for part in ("scores", "validation", "sizes", "parameters_net"):
        assert found[part] == metrics[part]
    table = capsys.readouterr().out.split("Simulation RMSE")
    assert table[1].split("\nnext: ")[0].strip() == table[2].split("\n\nResiduals\n")[0].strip()

    new = tmp_path / "new.csv"
    new.write_text(csv.read_text())
    for path, words, note, samples in (
        (new, [], True, "570 of 600"),
        (new, ["data.test=0.5"], False, "300 of 600"),
        (csv, [], False, "120 of 600"),
    ):
        about = f"checkpoint={folder / 'model'}", "data=file", f"data.path={path}", "data.fs=10"
        run(monkeypatch, *about, *words)
        printed = capsys.readouterr().out
        assert ("note: whole records are scored" in printed) is note
        assert samples in printed


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([DATA], "checkpoint is not set: add checkpoint=DIR"),
        (["checkpoint=/nowhere", DATA], "there is no '/nowhere'; give the folder of a run"),
        (["checkpoint=RUN"], "no data chosen: add +bench=boucwen"),
        (["checkpoint=RUN", DATA, "out=scores.txt"], "the scores are JSON: name it FILE.json"),
        (["checkpoint=RUN", DATA, "out=RUN/there.json"], "there.json' exists; give another name"),
        (["checkpoint=RUN/..", DATA], "is not a checkpoint; give one of those in it: RUN/../run."),
        (["checkpoint=RUN", DATA[:-1] + ", fs: 25}"], "sampled at 25 Hz and the model at 50.0 Hz"),
        (["checkpoint=RUN", DATA[:-1] + ", name: v}"], "inputs u1 (N), but the data have v (N);"),
        (["checkpoint=RUN", DATA[:-1] + ", unit: kN}"], "(N), but the data have u1 (kN);"),
        (["checkpoint=RUN", "+bench=nonsense"], "nonsense"),
    ],
)
@pytest.mark.usefixtures("untraced")
def test_user_errors_are_one_message(
    words: list[str], message: str, run_folder: Path, monkeypatch, capsys
):
    (run_folder / "there.json").write_text("old")
    with pytest.raises(SystemExit) as stop:
        run(monkeypatch, *(word.replace("RUN", str(run_folder)) for word in words))
    printed = capsys.readouterr()
    assert stop.value.code == 1
    assert message.replace("RUN", str(run_folder)) in " ".join(printed.err.split())  # unwrapped
    assert "Traceback" not in printed.err + printed.out
    assert (run_folder / "there.json").read_text() == "old"


def test_scores_are_replaced_where_that_is_said(run_folder: Path, monkeypatch, capsys):
    out = run_folder / "scores.json"
    out.write_text("old")
    run(monkeypatch, f"checkpoint={run_folder}", DATA, f"out={out}", "overwrite=true")
    assert json.loads(out.read_text())["bench"] == "small"
    assert f"Scores in {out}" in capsys.readouterr().out
