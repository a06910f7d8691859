"""Updates from the command line: the new model, what is printed, messages."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from command_line import configuration

import lfrtorch
from lfrtorch.cli import fit

pytestmark = pytest.mark.numeric
SIZES = ["nx=1", "nz=1", "nw=1", "nn=2", "starts=1", "trainer.max_iter=15", "figures=false"]


def words(path: Path) -> list[str]:
    return ["data=file", f"data.path={path}", "data.fs=1"]


def test_a_run_is_updated_with_a_file(csv: Path, tmp_path: Path, capsys):
    fit.run(configuration(*words(csv), *SIZES), tmp_path / "run")
    u, y = np.loadtxt(csv, delimiter=",", skiprows=1).T
    new = tmp_path / "new.csv"
    rows = "\n".join(f"{a:.17g},{5 + 1.2 * (b - 5):.17g}" for a, b in zip(u, y, strict=True))
    new.write_text(f"u,y\n{rows}\n")
    folder = tmp_path / "updated"
    capsys.readouterr()
    last = fit.run(configuration(*words(new), f"update={tmp_path / 'run'}"), folder)
    printed = capsys.readouterr().out
    assert "The old data count" in printed
    assert "rms error on" in printed
    found = json.loads((folder / "metrics.json").read_text())
    assert found["new"]["after"] == [last]
    assert found["new"]["after"][0] < 0.3 * found["new"]["before"][0]
    scores = found["tests"]["test"]
    assert scores["after"][0] < 0.5 * scores["before"][0]
    assert lfrtorch.load(folder).information is not None
    with pytest.raises(lfrtorch.InputError, match="a linear model: give the folder of a run"):
        fit.run(configuration(*words(new), f"update={tmp_path / 'run' / 'linear'}"), folder)
    with pytest.raises(lfrtorch.InputError, match="update and init_from"):
        fit.run(configuration(*words(new), "update=a", "init_from=b"), folder)
