"""Names of any alphabet on the command line, from the words to the files of a run."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from command_line import launched
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

import lfrtorch
from lfrtorch.cli import command, linear
from lfrtorch.cli.composition import composed
from lfrtorch.cli.quotes import quoted
from lfrtorch.files.formats import open_table


@pytest.mark.parametrize(
    ("value", "found"),
    [
        ("[Füllstand]", ["Füllstand"]),
        ("Füllstand", "Füllstand"),
        ("[Ü,é,力,Ω,µ, y]", ["Ü", "é", "力", "Ω", "µ", "y"]),
        ("[Temp °C,two words,a-b,c.d]", ["Temp °C", "two words", "a-b", "c.d"]),
        ("[Force (N),Weg [mm],u]", None),
        ("[Force (N), u]", ["Force (N)", "u"]),
        ("[acc[0],acc[12]]", ["acc[0]", "acc[12]"]),
        ("[Ü,3,-1.5,null,true]", ["Ü", 3, -1.5, None, True]),
        ("['Ü,ä',\"it's\",o'clock]", ["Ü,ä", "it's", "o'clock"]),
        ("[[Ü,a],[b]]", [["Ü", "a"], ["b"]]),
        ("[a=b,c#d,C:\\é]", ["a=b", "c#d", "C:\\é"]),
        ("/lab/Prüfstand 2/run (1).csv", "/lab/Prüfstand 2/run (1).csv"),
    ],
)
def test_names_are_read_as_they_are(value, found):
    word = quoted(f"data.inputs={value}")
    if found is None:  # brackets are a list's
        assert word == f"data.inputs={value}"
        return
    cfg = composed("config", ["data=file", word])
    value = cfg.data.inputs
    assert (value if isinstance(value, str) else OmegaConf.to_container(value)) == found


def test_tables_of_names():
    word = quoted("data.units={Füllstand: cm, Force (N): µN, 'a,b': 'm/s'}")
    cfg = composed("config", ["data=file", word])
    expected = {"Füllstand": "cm", "Force (N)": "µN", "a,b": "m/s"}
    assert OmegaConf.to_container(cfg, resolve=True)["data"]["units"] == expected  # pyright: ignore


@pytest.mark.parametrize(
    "word",
    [
        "nx=1,2", "nx=range(1,4)", "x=interval(0,1)", "x=glob(*)", "x=choice(a,b)", "x=[a,[b,c]]",
        "x={a: 1, b: [2]}", "x=null", "x=1e-3", "x=${nx}", "x='a b'", 'x="a"', "x=", "~x", "+x=a b",
        "x.csv", "x=[u,", "hydra.run.dir='x y'", "x=[ü", "--help", "data.path='runs/*.csv'",
    ],
)  # fmt: skip
def test_all_else_is_left_to_hydra(word):
    assert quoted(word) == word


def test_lists_of_names_for_several_runs():
    sweep = OverridesParser.create().parse_override(quoted("x=[Ü],[b,Ö (N)]"))
    assert list(sweep.sweep_string_iterator()) == ["['Ü']", "[b,'Ö (N)']"]


FLOW, LEVEL = "Förderstrom", "Füllstand (µm)"


@pytest.mark.numeric
def test_a_run_on_names_of_any_alphabet(csv: Path, tmp_path, monkeypatch, capsys):
    """Fit, resume, simulate and evaluate; the names are in settings, checkpoint and outputs."""
    u, y = np.loadtxt(csv, delimiter=",", skiprows=1).T
    lab = tmp_path / "Prüfstand (1).csv"
    rows = [f"{a!r};{b!r}" for a, b in zip(u.tolist(), y.tolist(), strict=True)]
    lab.write_text("\n".join([f"{FLOW};{LEVEL}", *rows, ""]), encoding="utf-16")
    monkeypatch.chdir(tmp_path)
    data = [
        "data=file", f"data.path={lab}", f"data.inputs=[{FLOW}]", f"data.outputs=[{LEVEL}]",
        "data.fs=10", "data.start=zero",
    ]  # fmt: skip
    few = ["nx=1", "nz=1", "nw=1", "nn=2", "starts=1", "trainer.max_iter=1", "bla.max_iter=1"]
    few.append("figures=false")
    run = tmp_path / "Läufe"
    launched(monkeypatch, *data, *few, f"hydra.run.dir={run}")
    saved = OmegaConf.load(run / "config.yaml")
    assert saved.data.inputs == [FLOW]
    assert saved.data.outputs == [LEVEL]
    launched(monkeypatch, f"resume={run}", "trainer.max_iter=2")
    model = lfrtorch.load(str(run))
    assert [*map(str, (*model.inputs, *model.outputs))] == [FLOW, LEVEL]
    for name, words in (
        ("simulate", [f"data.path={lab}", "out=ŷ.csv", "data.fs=10", f"data.outputs=[{LEVEL}]"]),
        ("evaluate", data),
    ):
        monkeypatch.setattr("sys.argv", ["lfrtorch", f"checkpoint={run}", *words])
        command.start(name)
    assert "Füllstand_hat" in [column.name for column in open_table(tmp_path / "ŷ.csv").columns]
    assert "Füllstand" in capsys.readouterr().out
    monkeypatch.setattr("sys.argv", ["lfrtorch", *data, "nx=1", "bla.max_iter=1"])
    monkeypatch.setattr(linear, "identify", lambda cfg, *_: print(cfg.data.outputs))
    command.start("linear")
    assert LEVEL in capsys.readouterr().out
