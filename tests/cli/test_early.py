"""What is wrong with a command line is said before torch is imported, and as it is said later."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from lfrtorch.cli import early

ENDS = """
import contextlib, io, json, sys
from lfrtorch.cli.command import start
ends = []
for command, *words in json.loads(sys.argv[1]):
    sys.argv, said, code = ["lfrtorch", *words], io.StringIO(), None
    try:
        with contextlib.redirect_stderr(said):
            start(command)
    except SystemExit as end:
        code = end.code
    ends.append([code, said.getvalue(), "torch" in sys.modules])
print(json.dumps(ends))
"""
"""Runs commands one after another, and tells of each how it ends and whether torch is there."""

OF_FIT = [
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
]


def of_a_file(words: list[str]) -> list[str]:
    """A command to fit x.csv, unless the words name other data."""
    if words[0].startswith("+"):
        return ["fit", *words]
    given = {word.split("=")[0] for word in words}
    usual = [word for word in ("inputs=force", "fs=100") if word.split("=")[0] not in given]
    return ["fit", "x.csv", "outputs=disp", *usual, *words]


REFUSED = [(of_a_file(words), message) for words, message in OF_FIT] + [
    (["linear", "x.csv", "fs=100", "nx=0"], "nx is 0; give a whole number of at least 1"),
    (["evaluate", "x.csv"], "checkpoint is not set: add checkpoint=DIR"),
    (["simulate", "x.csv", "checkpoint=m", "out=y.csv", "skip=-1"], "skip is -1; give a whole"),
    (["export", "to=c"], "checkpoint is not set: add checkpoint=DIR"),
    (["preview", "+bench=boucwen"], "no file is named; give its path, or path=FILE."),
]


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("early") / "x.csv"
    np.savetxt(path, np.zeros((20, 2)), delimiter=",", header="force,disp", comments="")
    return path


@pytest.fixture(scope="module")
def ends(file: Path) -> list[tuple[int | None, str, bool]]:
    """How each of these commands ends, in one process."""
    commands = json.dumps([command for command, _ in REFUSED])
    done = subprocess.run(
        [sys.executable, "-c", ENDS, commands],
        capture_output=True, text=True, cwd=file.parent, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.parametrize(
    "number", range(len(REFUSED)), ids=[" ".join(words) for words, _ in REFUSED]
)
def test_errors_come_before_torch(number: int, ends: list[tuple[int | None, str, bool]]):
    code, said, has_torch = ends[number]
    assert code == 1
    assert REFUSED[number][1] in said.replace("\n  ", " ")
    assert "Traceback" not in said
    assert not has_torch


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
