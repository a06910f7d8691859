"""The tables of all benchmarks: which run is chosen, what stands in a row, what is missing."""

from __future__ import annotations

import csv
import json
import shlex
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lfrtorch.data.dataset import Dataset, Published
from lfrtorch.data.records import Record
from lfrtorch.datasets import official
from scripts import reproduce

RECORD = Record(np.arange(9.0), np.arange(9.0))


def metrics(validation: float | None, rmse: float | None, seed: int = 0) -> dict[str, Any]:
    """As train.py writes them, with what is read of them, and the time."""
    score = {"rmse": rmse, "lti_rmse": 0.044, "unit": "V", "source": "official"}
    return {
        "sizes": {"nx": 6, "nz": 2, "nw": 2, "nn": 15},
        "parameters": 160,
        "parameters_net": 116,
        "data": {"samples": 80_000},
        "validation": {"rmse": validation},
        "scores": {"test": score | {"samples": 88_000, "skip": 1000}},
        "starts": 4,
        "ranking": [],
        "fit": {"iterations": 200, "seconds": 90.0, "seconds_per_iteration": 0.5, "reason": "end"},
        "command": f"python train.py +bench=wiener_hammerstein data.root=/here seed={seed}",
        "seconds": 100.0,
        "machine": "a machine",
    }


def case(*runs: dict[str, Any]) -> reproduce.Case:
    others = (
        Published("A", {"test": 0.3e-3}, "one (2001)"),
        Published("B", {"test": 0.241e-3}, "two (2002)"),
    )
    data = Dataset("wh", [RECORD], [RECORD], [RECORD], published=others, notes=("a note",))
    return reproduce.Case("wiener_hammerstein", data, runs, [Path()] * len(runs))


def test_validation_chooses_and_the_row_has_all():
    each = case(metrics(2.0, 0.21e-3), metrics(1.0, 0.23e-3), metrics(3.0, 0.26e-3))
    assert each.chosen == 1
    (row,) = reproduce.rows(each)
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    assert cells == [
        "wiener_hammerstein", "test", "official", "mV", "44.0", "**0.230**", "0.230",
        "0.210 .. 0.260", "3", "0.241 (B)", "88000 - 1000",
    ]  # fmt: skip
    assert "| 6, 2, 2, 15 | 160 (116) | 80000 | 4 | 200 | 100 | 500 |" in reproduce.costs(each)
    assert "| `python train.py +bench=wiener_hammerstein data.root=DIR seed=0` |" in (
        reproduce.costs(each)
    )
    assert reproduce.references([each]) == [
        "- wiener_hammerstein, B: two (2002)",
        "- wiener_hammerstein: a note",
    ]


def test_published_results_are_of_the_same_sizes_and_splits_if_there_are_such():
    known = [
        Published("old", {"test": 0.1e-3}, official.LEGACY),
        Published("others", {"test": 0.2e-3}, official.BOARD),
        Published("worse", {"test": 0.6e-3}, official.BOARD),
    ]
    own = Published("paper", {"test": 0.5e-3}, "a paper", sizes=(2, 2))
    larger = Published("paper", {"test": 0.4e-3}, "a paper", sizes=(3, 2))
    for listed, cell in (
        ([*known, own, larger], "0.500 (paper, nz 2, nw 2)"),
        ([*known, larger], "0.200 (others), 0.100 (old)"),
        ([known[0]], "0.100 (old)"),
        ([larger], "0.400 (paper, nz 3, nw 2)"),
        ([], "-"),
    ):
        data = Dataset("wh", [RECORD], [RECORD], [RECORD], published=tuple(listed))
        (row,) = reproduce.rows(reproduce.Case("wh", data, [metrics(1.0, 0.2e-3)]))
        assert row.split(" | ")[-2] == cell


def test_a_run_that_diverges_is_no_number():
    (row,) = reproduce.rows(case(metrics(1.0, 0.2e-3), metrics(None, None)))
    assert "0.200 .. diverges" in row


def test_rows_without_data_or_runs_say_so():
    page = reproduce.written(
        [reproduce.Case("f16", None, missing="no data at hand"), case(metrics(1.0, 0.2e-3))],
        {"wiener_hammerstein": [Path("results/x.png")]},
        quick=False,
    )
    assert "| f16 | no data at hand |" in page
    assert "![x](results/x.png)" in page
    assert "quick" not in page
    widths = {line.count("|") for line in page.splitlines() if line.startswith("| ")}
    assert widths == {12, 10}
    assert "no result to quote" in reproduce.written([], {}, quick=True)


@pytest.mark.parametrize(
    ("value", "unit", "shown"),
    [
        (2.6e-6, "m", "2.60 µm"),
        (2.3e-4, "V", "0.230 mV"),
        (0.34, "V", "0.340 V"),
        (0.01, "ticks/s", "0.0100 ticks/s"),
    ],
)
def test_units(value: float, unit: str, shown: str):
    assert reproduce.shown_in(value, unit) == shown


def test_one_unit_a_benchmark():
    """Where the linear errors are large, as those of the parallel Wiener-Hammerstein system."""
    assert reproduce.prefixed("V", 7e-6, 39e-3) == ("mV", 1e3)
    assert reproduce.prefixed("m", 2.2e-6, 189e-6) == ("µm", 1e6)


def started(monkeypatch: pytest.MonkeyPatch, *words: str) -> int:
    monkeypatch.setattr(sys, "argv", ["reproduce.py", *words])
    return reproduce.main()


def test_missing_files_are_a_row(tmp_path: Path, monkeypatch, capsys):
    results = tmp_path / "RESULTS.md"
    words = ["silverbox", "wiener_hammerstein", f"--results={results}", f"--out={tmp_path / 'out'}"]
    monkeypatch.setattr(
        reproduce,
        "CASES",
        {name: [f"+bench={name}"] for name in ("silverbox", "wiener_hammerstein")},
    )
    assert started(monkeypatch, *words, f"data.root={tmp_path}") == 0
    assert "silverbox: no data. there is no 'Silverbox" in capsys.readouterr().out
    assert results.read_text().count("| no data at hand |") == 2


def test_a_stand_in_is_not_the_benchmark(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(official, "cache", lambda: tmp_path)
    words = ["+bench=parwh"]
    each = reproduce.case("parwh", words, tmp_path, 1, start=False)
    assert each.missing == "no data at hand"
    each = reproduce.case("x", [*words, "data.source=stand-in"], tmp_path, 1, start=False)
    assert each.missing == "not run"
    assert each.dataset is not None
    assert reproduce.published(each, "arrow") == []


def test_wrong_words_are_refused(monkeypatch, capsys):
    with pytest.raises(SystemExit):
        started(monkeypatch, "silverboxx")
    assert "no benchmark silverboxx; there are boucwen" in capsys.readouterr().err


def test_runs_are_repeated_only_if_they_must_be(tmp_path: Path, monkeypatch):
    """One of the same command that came to its end is taken as it is."""
    words = ["+bench=boucwen", "seed=0"]
    found = metrics(1.0, 1.0) | {"command": shlex.join(["python", "train.py", *words])}
    (tmp_path / "metrics.json").write_text(json.dumps(found))
    assert reproduce.run(words, tmp_path, start=False) is None  # nobody knows its time
    (tmp_path / reproduce.RUN).write_text(json.dumps({"seconds": 7.0, "machine": ""}))
    again = reproduce.run(words, tmp_path, start=True)
    assert again is not None
    assert again["seconds"] == 7.0
    assert reproduce.run([*words, "nz=1"], tmp_path, start=False) is None


@pytest.mark.slow
@pytest.mark.data
def test_quick_end_to_end(tmp_path: Path, monkeypatch, benchmark_root: Path):
    words = ["cascaded_tanks", "boucwen", "--quick", f"--out={tmp_path}"]
    assert started(monkeypatch, *words, f"data.root={benchmark_root}") == 0
    page = (tmp_path / "RESULTS.md").read_text()
    for row in ("| cascaded_tanks | test | official | V |", "| boucwen | sweep | official | "):
        assert row in page
    assert (tmp_path / "results" / "boucwen_sweep_density.png").is_file()
    with (tmp_path / "results" / "leaderboard.csv").open() as file:
        (line,) = csv.DictReader(file)
    assert (line["benchmark"], line["unit"]) == ("cascaded_tanks", "V")
    assert 0.1 < float(line["rmse_to_submit"]) < 1.5
