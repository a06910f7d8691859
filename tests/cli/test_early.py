"""What is wrong with a command line is said before torch is imported, and as it is said later."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from lfrtorch.cli import early

ENDS = """
import sys
from lfrtorch.cli.command import start
sys.argv = ["lfrtorch", *{words}]
try:
    start({command!r})
finally:
    assert "torch" not in sys.modules
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "x.csv"
    np.savetxt(path, np.zeros((20, 2)), delimiter=",", header="force,disp", comments="")
    return path


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["nx=three"], "nx is 'three'; give a whole number of at least 1, or auto"),
        (["nx=-3"], "nx is -3; give a whole number of at least 1, or auto"),
        (["nxx=3"], "there is no setting 'nxx'; did you mean nx=3?"),
        (["nx=3", "trainer.max_iter=ten"], "trainer: max_iter is 'ten'; give a whole number"),
        (["nx=3", "inputs=power"], "has no column 'power', named in inputs"),
        (["nx=3", "fs=null"], "data: the sampling frequency of 'x.csv' is not known; give fs=HZ"),
        (["nx=3", "fs=-1"], "data: fs is -1; give a positive number"),
        (["nx=3", "noise=both"], "noise is 'both'; give 'output' or 'innovation'."),
        (["nx=3", "activation=swish"], "activation is 'swish'; give 'tanh', 'sigmoid', 'relu', 'r"),
        (["nx=3", "structure=serial"], "structure is 'serial'; give 'free', 'wiener', 'hammer"),
        (["nx=3", "structure=wiener", "modes=1"], "and modes is 1: its w drives no states; give"),
        (["nx=3", "dtype=float16"], "dtype is float16; give float64 or float32."),
        (["resume=runs/nowhere"], "resume is 'runs/nowhere', which is not the folder of a run"),
        (["+bench=boucwe"], "there is no bench=boucwe; give boucwen"),
    ],
)
def test_errors_come_before_torch(file: Path, words: list[str], message: str):
    known = [] if words[0].startswith("+") else ["x.csv", "outputs=disp"]
    for word in ("inputs=force", "fs=100"):
        if known and not any(other.startswith(word.split("=")[0]) for other in words):
            known.append(word)
    refused("fit", [*known, *words], message, file.parent)


@pytest.mark.parametrize(
    ("command", "words", "message"),
    [
        ("linear", ["x.csv", "fs=100", "nx=0"], "nx is 0; give a whole number of at least 1"),
        ("evaluate", ["x.csv"], "checkpoint is not set: add checkpoint=DIR"),
        ("simulate", ["x.csv", "checkpoint=m", "out=y.csv", "skip=-1"], "skip is -1; give a whole"),
        ("export", ["to=c"], "checkpoint is not set: add checkpoint=DIR"),
        ("preview", ["+bench=boucwen"], "no file is named; give its path, or path=FILE."),
    ],
)
def test_so_do_those_of_other_commands(file: Path, command: str, words: list[str], message: str):
    refused(command, words, message, file.parent)


def refused(command: str, words: list[str], message: str, folder: Path) -> None:
    ended = subprocess.run(
        [sys.executable, "-c", ENDS.format(words=words, command=command)],
        capture_output=True, text=True, cwd=folder, check=False,
    )  # fmt: skip
    assert ended.returncode == 1
    assert message in ended.stderr.replace("\n  ", " ")
    assert "Traceback" not in ended.stderr


def test_what_is_right_passes(file: Path, monkeypatch: pytest.MonkeyPatch):
    for words in (
        [str(file), "inputs=force", "outputs=disp", "fs=100", "nx=auto"],
        ["+bench=boucwen"],
        ["+bench=boucwen", "trainer=adam", "trainer.max_iter=5"],
        ["-m", "+bench=boucwen", "nx=1,2"],
        ["+bench=nanodrone", "data.root=nowhere"],
    ):
        monkeypatch.setattr(sys, "argv", ["lfrtorch fit", *words])
        early.take_words("config")
