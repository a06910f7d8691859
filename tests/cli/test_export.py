"""Exports from the command line: files, what is printed, messages; nothing half written."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from exported import MODELS, OBSERVED

from lfrtorch import NoiseCovariance
from lfrtorch import export as exports
from lfrtorch.cli import command, early


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    MODELS["tanh"].save(tmp_path / "model")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(monkeypatch: pytest.MonkeyPatch, *words: str) -> None:
    monkeypatch.setattr("sys.argv", ["lfrtorch export", *words])
    command.start("export")


def test_c_is_written_with_its_use(folder: Path, monkeypatch, capsys):
    run(monkeypatch, "checkpoint=model", "to=c", "name=engine", "out=firmware/src")
    expected = exports.c_source(MODELS["tanh"], "engine")
    found = [folder / "firmware" / "src" / f"engine.{kind}" for kind in "hc"]
    assert tuple(path.read_text() for path in found) == expected
    assert capsys.readouterr().out.splitlines() == [
        "model: u1 (N), u2 (N) -> y1 (mm), y2 (mm), y3 (mm) at 100 Hz, nx 4, nz 2, nw 3, nn 5",
        "written: firmware/src/engine.h, firmware/src/engine.c",
        "use: engine_step(x, u, x_next, y);",
    ]


def test_a_folder_of_runs_stands_for_the_newest(folder: Path, monkeypatch, capsys):
    dates = ["2026-09-30_10-00-00-000000", "2026-10-01_09-00-00-000000"]
    for i, name in enumerate([dates[1], "bla_2027-01-01_00-00-00-000000", dates[0], "mine"]):
        MODELS["tanh" if i == 0 else "smallest"].save(folder / "runs" / "run" / name / "model")
    (folder / "runs" / "run" / "2028-01-01_00-00-00-000000").mkdir()  # no model yet
    run(monkeypatch, "checkpoint=runs/run", "to=c")
    note, shown, *_ = capsys.readouterr().out.splitlines()
    assert note == f"note: checkpoint is runs/run/{dates[1]}, the newest run in runs/run"
    assert shown.startswith(f"runs/run/{dates[1]}: u1 (N), u2 (N)")
    (folder / "runs" / "run" / dates[1]).rename(folder / "elsewhere")
    run(monkeypatch, "checkpoint=runs/run", "to=c", "name=before")
    assert f"checkpoint is runs/run/{dates[0]}" in capsys.readouterr().out
    monkeypatch.setattr("sys.argv", ["lfrtorch fit", "+bench=boucwen", "init_from=runs/run"])
    early.take_words("config")
    assert f"init_from=runs/run/{dates[0]}" in sys.argv


def test_an_observer_is_written_with_its_model(folder: Path, monkeypatch, capsys):
    words = ["observer=true", "Q=1e-4", "R=[1e-2,1e-2,4e-2]"]
    run(monkeypatch, "checkpoint=model", "to=c", *words)
    noise = NoiseCovariance(Q=1e-4, R=[1e-2, 1e-2, 4e-2])
    expected = exports.c_source(MODELS["tanh"], observer=noise)
    assert tuple((folder / f"model.{kind}").read_text() for kind in "hc") == expected
    assert capsys.readouterr().out.splitlines()[-1] == (
        "use: model_observer_correct(&observer, u, y); model_observer_advance(&observer, u);"
    )


@pytest.mark.parametrize("to", ["c", "casadi", "matlab"])
def test_disturbances_are_the_last_states_of_what_is_written(to: str, folder: Path, monkeypatch):
    noise = NoiseCovariance(Q=1e-4, R=1e-2)
    run(
        monkeypatch, "checkpoint=model", f"to={to}", "observer=true", "Q=1e-4", "R=1e-2",
        "disturbance=input",
    )  # fmt: skip
    model, whole = MODELS["tanh"].with_disturbance("input", noise)
    expected = exports.write(model, to, folder / "other", observer=whole)
    written = sorted(path.name for path in folder.iterdir() if path.is_file())
    assert written == sorted(path.name for path in expected)
    for path in expected:
        if path.suffix != ".mat":
            assert (folder / path.name).read_bytes() == path.read_bytes()


@pytest.mark.parametrize(("K", "words"), [(True, []), (False, ["Q=1e-4", "R=1e-2"])])
def test_the_use_is_that_of_the_observer(K: bool, words: list[str], folder, monkeypatch, capsys):
    casadi = pytest.importorskip("casadi")
    model = OBSERVED["smallest"] if K else MODELS["smallest"]
    model.save(folder / "other")
    run(monkeypatch, "checkpoint=other", "to=casadi", "observer=true", *words)
    use = capsys.readouterr().out.splitlines()[-1].removeprefix("use: ")
    known = {"casadi": casadi, "x": 0.1, "u": 0.2, "y": 0.3, "P": 1.0}
    exec(use, known)
    assert np.isfinite(float(known["after"]["x_next"]))


def test_files_are_replaced_where_that_is_said(folder: Path, monkeypatch):
    (folder / "model.c").write_text("old")
    run(monkeypatch, "checkpoint=model", "to=c", "overwrite=true")
    assert "model_step" in (folder / "model.c").read_text()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["to=c"], "checkpoint is not set: add checkpoint=DIR"),
        (["checkpoint=model"], "to is not set: add to=c"),
        (["checkpoint=model", "to=rust"], "to is 'rust'; give one of c, c_float, casadi"),
        (["checkpoint=model", "to=c", "Q=1"], "give observer=true Q=... R=..."),
        (["checkpoint=model", "to=c", "disturbance=input"], "(observer=true Q=... R=... on the"),
        (
            ["checkpoint=model", "to=c", "observer=true"],
            "this model has no innovation gain K: give Q=... R=..., the noise of a Kalman filter",
        ),
        (
            ["checkpoint=model", "to=c", "observer=true", "Q=auto", "R=1"],
            "Q is auto; give a variance or a list, Q=1e-4 or Q=[1e-4,1e-3]",
        ),
        (["checkpoint=model", "to=c", "observer=true", "Q=1", "R=[1,a,1]"], "R is [1, 'a', 1]"),
        (["checkpoint=model", "to=c", "name=1"], "name is '1'; give letters"),
        (["checkpoint=model", "to=c", "name=there"], "'there.c' exists; give another name, or ove"),
        (["checkpoint=model", "to=c", "out=model"], "'model' is a checkpoint, which holds nothing"),
        (["checkpoint=none", "to=c"], "there is no 'none'"),
        (["checkpoint=model", "to=c", "nane=x"], "did you mean name=x?"),
    ],
)
def test_user_errors_are_one_message(
    words: list[str], message: str, folder: Path, monkeypatch, capsys
):
    (folder / "there.c").write_text("")
    before = sorted(folder.rglob("*"))
    with pytest.raises(SystemExit) as stop:
        run(monkeypatch, *words)
    printed = capsys.readouterr()
    assert stop.value.code == 1
    assert message in printed.err
    assert "Traceback" not in printed.err
    assert sorted(folder.rglob("*")) == before
