"""A model on new files from the command line: outputs, scores, messages; nothing half written."""

from __future__ import annotations

import copy
import json
import sys
import weakref
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from omegaconf import DictConfig
from reference import random_cell, random_model

import lfrtorch
from lfrtorch._support.types import Array
from lfrtorch.cli import command, simulate
from lfrtorch.cli.composition import composed
from lfrtorch.cli.errors import user_errors
from lfrtorch.files.formats import open_table
from lfrtorch.files.stream import Block, FileStream
from lfrtorch.use.file_simulation import BEGINNING

MODEL = random_model(random_cell(2, 2, 3, 2, 1, 4), fs=50.0)
T = 300
U = np.random.default_rng(0).normal(MODEL.scaler.u_offset, MODEL.scaler.u_scale, size=(T, 2))
NOISE = 0.1 * np.random.default_rng(1).normal(size=(T, 2))
Y = MODEL.simulate(U) + NOISE


def csv(path: Path, **columns: Array) -> Path:
    rows = np.stack([*columns.values()], axis=1)
    lines = [",".join("" if np.isnan(v) else repr(float(v)) for v in row) for row in rows]
    path.write_text("\n".join([",".join(columns), *lines]) + "\n")
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A checkpoint, inputs, and inputs with outputs and times."""
    MODEL.save(tmp_path / "model")
    inputs = {"u1": U[:, 0], "u2 (N)": U[:, 1]}
    csv(tmp_path / "inputs.csv", **inputs)
    times = {"t": np.arange(T) / 50.0}
    csv(tmp_path / "both.csv", **times, **inputs, **{"y1": Y[:, 0], "y2": Y[:, 1]})
    return tmp_path


@cache
def usual() -> DictConfig:
    return composed("simulate")


def run(monkeypatch: pytest.MonkeyPatch, folder: Path, *words: str) -> None:
    """The command line without the start of Hydra, which takes a quarter of a second."""
    monkeypatch.chdir(folder)
    cfg = copy.deepcopy(usual())
    cfg.merge_with_dotlist(["checkpoint=model", *words])
    with user_errors():
        simulate.simulate(cfg)


def launched(monkeypatch: pytest.MonkeyPatch, folder: Path, *words: str) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "argv", ["simulate.py", "checkpoint=model", *words])
    command.start("simulate")


def refused(monkeypatch, capsys, folder: Path, *words: str) -> str:
    """The message; the folder is as it was."""
    before = sorted(folder.rglob("*"))
    with pytest.raises(SystemExit) as stop:
        run(monkeypatch, folder, *words)
    printed = capsys.readouterr()
    assert stop.value.code == 1
    assert "Traceback" not in printed.err + printed.out
    assert sorted(folder.rglob("*")) == before
    return printed.err


def columns(path: Path) -> dict[str, Array]:
    table = open_table(path)
    names = [column.name for column in table.columns]
    return dict(zip(names, table.read(range(len(names))).T, strict=True))


# --- what is written ------------------------------------------------------------------------


@pytest.mark.numeric
@pytest.mark.parametrize("extension", ["csv", "npz", "parquet"])
def test_outputs_of_inputs_alone(extension: str, folder: Path, monkeypatch, capsys):
    launched(monkeypatch, folder, "data.path=inputs.csv", f"out=made/x.{extension}")
    found = columns(folder / "made" / f"x.{extension}")
    assert list(found) == ["sample", "y1_hat", "y2_hat"]
    assert np.array_equal(found["sample"], np.arange(T))
    assert np.array_equal(np.stack([found["y1_hat"], found["y2_hat"]], 1), MODEL.simulate(U))
    printed = capsys.readouterr()
    assert printed.err == ""
    assert "model: u1 (N), u2 (N) -> y1 (mm), y2 (mm) at 50 Hz, nx 3, nz 2, nw 1" in printed.out
    assert "note: 'inputs.csv': nothing says how it is sampled; the model's 50 Hz" in printed.out
    assert "has no column y1, y2, so nothing is scored" in printed.out
    assert "RMSE" not in printed.out


@pytest.mark.numeric
def test_a_column_named_like_time_is_the_time(folder: Path, monkeypatch, capsys):
    """A file at another rate is not simulated as if it were at the model's."""
    run(monkeypatch, folder, "data.path=both.csv", "out=x.csv")
    assert next(iter(columns(folder / "x.csv"))) == "t"
    said = capsys.readouterr().out
    assert "note: 'both.csv': the column 't' is taken for the time, 50 Hz\n" in said
    slow = columns(folder / "both.csv")
    csv(folder / "slow.csv", **slow | {"t": 2 * slow["t"]})
    message = refused(monkeypatch, capsys, folder, "data.path=slow.csv", "out=y.csv")
    assert "says 25 Hz and the model runs at 50 Hz" in message
    run(monkeypatch, folder, "data.path=slow.csv", "data.fs=50", "out=y.csv")  # as it is told


@pytest.mark.numeric
def test_measured_outputs_are_scored(folder: Path, monkeypatch, capsys):
    run(monkeypatch, folder, "data.path=both.csv", "data.time=t", "skip=100", "out=x.csv")
    found = columns(folder / "x.csv")
    assert list(found) == ["t", "y1_hat", "y1", "y1_error", "y2_hat", "y2", "y2_error"]
    assert np.array_equal(found["t"], np.arange(T) / 50.0)
    for i, name in enumerate(["y1", "y2"]):
        assert np.array_equal(found[name], Y[:, i])
        assert np.array_equal(found[f"{name}_error"], found[name] - found[f"{name}_hat"])
    lines = capsys.readouterr().out.splitlines()
    assert not any(line.startswith("note") for line in lines)
    rows = [line.split() for line in lines if line.startswith("both.csv")]
    for i, row in enumerate(rows):
        rmse = np.sqrt(np.mean(NOISE[100:, i] ** 2))
        assert row[:7] == ["both.csv", f"y{i + 1}", "mm", "last", "200", "of", "300"]
        assert float(row[7]) == pytest.approx(rmse, rel=5e-3)
        assert float(row[8]) == pytest.approx(100 * rmse / np.std(Y[100:, i]), rel=5e-3)
    assert len(rows) == 2


@pytest.mark.numeric
def test_columns_of_other_names(folder: Path, monkeypatch, capsys):
    csv(folder / "lab.csv", pos=Y[:, 0], b=U[:, 1], a=U[:, 0], ang=Y[:, 1])
    words = ["data=file", "data.path=lab.csv", "data.inputs=[a,1]", "data.outputs=[pos,ang]"]
    launched(monkeypatch, folder, *words, "data.fs=50", "out=x.csv")
    found = columns(folder / "x.csv")
    assert np.array_equal(found["y1_hat"], MODEL.simulate(U)[:, 0])
    assert np.array_equal(found["y1"], Y[:, 0])
    assert "note" not in capsys.readouterr().out


@pytest.mark.numeric
def test_inputs_beyond_those_of_training_are_said(folder: Path, monkeypatch, capsys):
    loud = np.array(U)
    loud[7, 1] = MODEL.scaler.u_offset[1] - 8.0 * MODEL.scaler.u_scale[1]
    csv(folder / "loud.csv", u1=U[:, 0], u2=loud[:, 1])
    run(monkeypatch, folder, "data.path=loud.csv", "data.fs=50", "out=x.csv")
    said = [line for line in capsys.readouterr().out.splitlines() if "extrapolates" in line]
    assert len(said) == 1
    assert said[0].startswith("note: the input u2 goes 8.00 standard deviations of the training")


@pytest.mark.numeric
def test_a_wrong_start_state_is_said(folder: Path, monkeypatch, capsys):
    y = Y.copy()
    y[:BEGINNING, 1] += 10.0
    csv(folder / "late.csv", u1=U[:, 0], u2=U[:, 1], y1=Y[:, 0], y2=y[:, 1])
    words = ["data.path=late.csv", "data.fs=50", "out=x.csv", "overwrite=true"]
    run(monkeypatch, folder, *words, "skip=0")
    assert "the error over the first 100 scored samples is 1" in capsys.readouterr().out
    run(monkeypatch, folder, *words, "skip=100")
    assert "scored samples" not in capsys.readouterr().out


@pytest.mark.numeric
def test_missing_outputs_are_left_out_of_the_scores(folder: Path, monkeypatch, capsys):
    y = np.where(np.arange(T) % 3 == 0, np.nan, Y[:, 0])
    csv(folder / "some.csv", u1=U[:, 0], u2=U[:, 1], y1=y, y2=Y[:, 1])
    run(monkeypatch, folder, "data.path=some.csv", "out=x.csv")
    lines = capsys.readouterr().out.splitlines()
    rows = [line.split()[3:5] for line in lines if line.startswith("some.csv")]
    assert rows == [["190", "of"], ["last", "285"]]  # 15 of 300 are left out
    assert np.array_equal(columns(folder / "x.csv")["y1"], y, equal_nan=True)


def test_several_files(folder: Path, monkeypatch, capsys):
    words = ["data.path='*.csv'", "out=made", "format=parquet"]
    run(monkeypatch, folder, *words)
    for name in ("inputs", "both"):
        found = columns(folder / "made" / f"{name}.parquet")
        assert np.array_equal(found["y1_hat"], MODEL.simulate(U)[:, 0])
    assert capsys.readouterr().out.count("both.csv  y") == 2
    run(monkeypatch, folder, "data.path=[both.csv,inputs.csv]", "out=listed")
    assert sorted(p.name for p in (folder / "listed").iterdir()) == ["both.csv", "inputs.csv"]


def test_files_are_replaced_where_that_is_said(folder: Path, monkeypatch):
    (folder / "x.csv").write_text("old")
    run(monkeypatch, folder, "data.path=inputs.csv", "out=x.csv", "overwrite=true")
    assert len(columns(folder / "x.csv")["y1_hat"]) == T


@pytest.mark.numeric
def test_the_linear_model_of_a_run(folder: Path, monkeypatch, capsys):
    cell = MODEL.lfr.cell
    linear = lfrtorch.LinearModel(
        *(getattr(cell, name).detach().numpy() for name in ("A", "Bu", "Cy", "Dyu")),
        fs=50.0, u_offset=np.ones(2), y_offset=np.ones(2),
        inputs=MODEL.inputs, outputs=MODEL.outputs,
    )  # fmt: skip
    linear.save(folder / "run" / "linear")
    run(monkeypatch, folder, "checkpoint=run", "data.path=inputs.csv", "out=x.npz")
    assert np.array_equal(columns(folder / "x.npz")["y2_hat"], linear.simulate(U)[:, 1])
    assert "at 50 Hz, nx 3\n" in capsys.readouterr().out
    csv(folder / "loud.csv", u1=99.0 * U[:, 0], u2=U[:, 1])
    run(monkeypatch, folder, "checkpoint=run/linear", "data.path=loud.csv", "out=y.csv")
    assert "extrapolates" not in capsys.readouterr().out


# --- the start ------------------------------------------------------------------------------


@pytest.mark.numeric
def test_a_given_start(folder: Path, monkeypatch):
    run(monkeypatch, folder, "data.path=inputs.csv", "out=x.npz", "start=given", "x0=[1,-2,0.5]")
    expected = MODEL.simulate(U, start="given", x0=[1, -2, 0.5])
    assert np.array_equal(columns(folder / "x.npz")["y1_hat"], expected[:, 0])


@pytest.mark.numeric
def test_an_estimated_start_goes_on_where_the_measurement_was_cut(
    folder: Path, monkeypatch, capsys
):
    u, y = U[100:], MODEL.simulate(U)[100:]
    csv(folder / "cut.csv", u1=u[:, 0], u2=u[:, 1], y1=y[:, 0], y2=y[:, 1])
    run(monkeypatch, folder, "data.path=cut.csv", "out=x.npz", "start=estimated", "estimate=50")
    found = columns(folder / "x.npz")
    assert np.allclose(found["y1_hat"], y[:, 0], rtol=0, atol=1e-8)  # tolerance of the state
    printed = capsys.readouterr().out
    assert "start: the state is estimated from the first 50 samples of 'cut.csv'; RMSE" in printed
    assert [line.split()[3:7] for line in printed.splitlines() if line.startswith("cut.csv ")] == [
        ["last", "150", "of", "200"]
    ] * 2


@pytest.mark.numeric
def test_a_measured_start_begins_at_the_first_output(folder: Path, monkeypatch, capsys):
    run(monkeypatch, folder, "data.path=both.csv", "out=x.npz", "start=measured")
    found = columns(folder / "x.npz")
    expected = MODEL.simulate(lfrtorch.Record(U, Y, 50.0, "measured"))
    assert np.allclose(found["y1_hat"], expected[:, 0], rtol=0, atol=1e-9)
    assert found["y1_hat"][0] == pytest.approx(Y[0, 0], abs=1e-6)
    assert capsys.readouterr().out.count("  last 299 of 300  ") == 2
    csv(folder / "gap.csv", u1=U[:, 0], u2=U[:, 1], y1=np.full(T, np.nan), y2=Y[:, 1])
    with pytest.raises(SystemExit):
        run(monkeypatch, folder, "data.path=gap.csv", "data.fs=50", "out=y.npz", "start=measured")
    assert "needs two samples and all outputs of the first" in capsys.readouterr().err


@pytest.mark.numeric
def test_no_start_is_fitted_to_samples_that_are_scored(folder: Path, monkeypatch, capsys):
    for words, fitted, scored in (
        (["skip=299"], 299, "last 1 of 300"),
        (["estimate=1000"], 300, "not scored"),
        (["estimate=50", "skip=70"], 50, "last 230 of 300"),
    ):
        run(monkeypatch, folder, "data.path=both.csv", "out=x.npz", "start=estimated",
            "overwrite=true", *words)  # fmt: skip
        printed = capsys.readouterr().out
        assert f"from the first {fitted} samples of 'both.csv'" in printed
        assert printed.count(f"  {scored}  ") == 2
    csv(folder / "one.csv", u1=U[:1, 0], u2=U[:1, 1], y1=Y[:1, 0], y2=Y[:1, 1])
    run(monkeypatch, folder, "data.path=one.csv", "data.fs=50", "out=y.npz", "start=estimated")
    assert capsys.readouterr().out.count("not scored  ") == 2


@pytest.mark.numeric
@pytest.mark.parametrize("start", ["zero", "estimated"])
@pytest.mark.parametrize(("samples", "period"), [(300, None), (40, None), (300, 60), (12, None)])
def test_evaluate_scores_the_same_samples(
    start: str, samples: int, period: int | None, folder: Path, monkeypatch, capsys
):
    """Also where an input repeats, and its output takes time to settle."""
    u = U[np.arange(samples) % (period or samples)]
    y = MODEL.simulate(u) + 0.01 * NOISE[:samples]
    y[: period or 0] += 0.1
    csv(folder / "x.csv", u1=u[:, 0], u2=u[:, 1], y1=y[:, 0], y2=y[:, 1])
    given = "data.path=x.csv", "data.fs=50"
    run(monkeypatch, folder, *given, f"start={start}", "out=made.csv")
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    here = [line[3:] for line in lines if line[:1] == ["x.csv"]]
    words = ["data=file", *given, f"data.start={start}", "out=scores.json"]
    monkeypatch.setattr(sys, "argv", ["evaluate.py", "checkpoint=model", *words])
    command.start("evaluate")
    score = json.loads((folder / "scores.json").read_text())["scores"]["x"]
    skip = {"estimated": min(50, samples // 5), "zero": period or round(samples / 20)}[start]
    said = f"last {samples - skip} of {samples}"
    assert said in capsys.readouterr().out
    assert score["skip"] == skip
    for row, error in zip(here, score["rmse_by_output"], strict=True):
        assert " ".join(row[:4]) == said
        assert float(row[4]) == pytest.approx(error, rel=5e-3)


# --- long files -----------------------------------------------------------------------------


class Thousands(FileStream):
    """Blocks of a thousand samples; at most so many of them were alive at once."""

    alive = 0

    def blocks(self, samples: int = 1000) -> Iterator[Block]:
        seen: list[weakref.ref[Any]] = []
        for block in super().blocks(1000):
            seen.append(weakref.ref(block.u.base if block.u.base is not None else block.u))
            Thousands.alive = max(Thousands.alive, sum(ref() is not None for ref in seen))
            yield block


@pytest.mark.numeric
@pytest.mark.parametrize("extension", ["csv", "parquet"])
def test_blocks_give_the_numbers_of_one_simulation(extension: str, folder: Path, monkeypatch):
    u = np.random.default_rng(2).normal(size=(20_500, 2))
    np.savez(folder / "long.npz", u1=u[:, 0], u2=u[:, 1], y1=u[:, 0], y2=u[:, 1])
    monkeypatch.setattr(simulate, "FileStream", Thousands)
    monkeypatch.setattr(Thousands, "alive", 0)
    run(monkeypatch, folder, "data.path=long.npz", f"out=x.{extension}")
    found = columns(folder / f"x.{extension}")
    assert np.array_equal(np.stack([found["y1_hat"], found["y2_hat"]], 1), MODEL.simulate(u))
    assert np.array_equal(found["sample"], np.arange(20_500))
    assert 1 <= Thousands.alive <= 3


# --- refusals -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["checkpoint=null", "data.path=inputs.csv", "out=x.csv"], "checkpoint is not set"),
        (["out=x.csv"], "data.path is not set: add data.path=FILE"),
        (["data.path=inputs.csv"], "out is not set: add out=FILE.csv"),
        (["data.path=input.csv", "out=x.csv"], "no file 'input.csv'; there is 'inputs.csv'"),
        (["data.path='*.txt'", "out=x"], "no file matches '*.txt'"),
        (["data.path='*.csv'", "out=x.csv"], "2 files cannot be written to one, 'x.csv'"),
        (["data.path=[both.csv,model/../both.txt]", "out=x"], "several files are called 'both'"),
        (["data.path=both.csv", "out=x.xlsx"], "out is 'x.xlsx'; give a file of .csv"),
        (["data.path=both.csv", "out=0.5"], "out is '0.5'; give a file of .csv"),
        (["data.path=both.csv", "out=[x]"], "out is ['x']; give a file or a folder"),
        (["data.path=both.csv", "out=inputs.csv"], "'inputs.csv' exists; give another name"),
        (["data.path=both.csv", "out=both.csv", "overwrite=true"], "is the file that is read"),
        (["data.path=both.csv", "out=x", "format=xlsx"], "format is 'xlsx'"),
        (["data.path=both.csv", "out=x.csv", "data.inputs=[u1,u3]"], "has no column 'u3'"),
        (["data.path=both.csv", "out=x.csv", f"skip={T}"], f"skip={T} leaves none of the {T} samp"),
        (["data.path=both.csv", "out=x.csv", "data.fs=25"], "data.fs is 25 Hz"),
        (["data.path=both.csv", "out=x.csv", "data.fs=fast"], "data.fs is 'fast'"),
        (["data.path=both.csv", "out=x.csv", "data.time=u2"], "u2 (N) has the unit 'N', which is"),
        (["data.path=both.csv", "out=x.csv", "start=periodic"], "start is 'periodic'; give zero"),
        (["data.path=both.csv", "out=x.csv", "start=given"], "x0 with start=given"),
        (["data.path=both.csv", "out=x.csv", "x0=[1,2,3]"], "x0 with start=given"),
        (["data.path=both.csv", "out=x.csv", "start=given", "x0=[1]"], "x0 has 1 entries"),
        (["data.path=both.csv", "out=x.csv", "start=given", "x0=[a]"], "give a list of finite"),
        (["data.path=both.csv", "out=x.csv", "start=given", "x0=1"], "give a list of finite"),
        (["data.path=inputs.csv", "out=x.csv", "start=estimated"], "needs measured outputs"),
        (["data.path=both.csv", "out=x.csv", "estimate=0"], "estimate is 0"),
        (["data.path=both.csv", "out=x.csv", "skip=-1"], "skip is -1"),
        (["data.path=both.csv", "out=x.csv", "checkpoint=both.csv"], "is a file, and a checkpoint"),
    ],
)
def test_user_errors_are_one_message(
    words: list[str], message: str, folder: Path, monkeypatch, capsys
):
    assert message in refused(monkeypatch, capsys, folder, *words)


def test_a_gap_in_the_inputs_is_named_by_its_line(folder: Path, monkeypatch, capsys):
    u = np.where(np.arange(T) == 200, np.nan, U[:, 0])
    csv(folder / "gap.csv", u1=u, u2=U[:, 1])
    message = refused(monkeypatch, capsys, folder, "data.path=gap.csv", "out=x.csv")
    assert "'gap.csv', line 202: column 'u1' has no finite number; interpolate the gap" in message


@pytest.mark.numeric
def test_a_model_that_diverges_writes_nothing(folder: Path, monkeypatch, capsys):
    model = random_model(random_cell(2, 2, 3, 2, 1, 4, radius=300.0), fs=50.0)
    model.save(folder / "model")
    first = np.argmin(np.isfinite(model.simulate(U)).all(axis=1))
    assert first > 0
    message = refused(monkeypatch, capsys, folder, "data.path=inputs.csv", "out=x.csv")
    said = f"'inputs.csv': the model diverges: its output is not finite at sample {first};"
    assert said in message
    (folder / "x.csv").write_text("old")
    words = ["data.path=inputs.csv", "out=x.csv", "overwrite=true"]
    assert said in refused(monkeypatch, capsys, folder, *words)
    assert (folder / "x.csv").read_text() == "old"


def test_columns_of_other_names_are_asked_for_in_words_of_the_command_line(
    folder: Path, monkeypatch, capsys
):
    csv(folder / "other.csv", a=U[:, 0], b=U[:, 1])
    with pytest.raises(SystemExit):
        launched(monkeypatch, folder, "data.path=other.csv", "out=x.csv", "data.fs=50")
    assert "say which columns these are with inputs=[...]" in capsys.readouterr().err
