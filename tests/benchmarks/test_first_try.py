import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture
def first_try(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    spec = importlib.util.spec_from_file_location("first_try", BENCHMARKS / "first_try.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "first_try", module)
    spec.loader.exec_module(module)
    return module


def entry(verdict: str, nonlinear: float, lti: float, **about: Any) -> dict[str, Any]:
    errors = {"nonlinear": nonlinear, "lti": lti}
    recommended = nonlinear if verdict == "better" else lti
    about = {"linear": False, "samples": 400, "seconds": 2.0} | about
    return about | {"verdict": verdict, "errors": errors, "recommended": recommended}


@pytest.mark.parametrize("samples", [1000, 30000])
def test_splits_are_stretches_that_share_no_sample(
    first_try: ModuleType, tmp_path: Path, samples: int
):
    (tmp_path / "disc").mkdir()
    k = np.arange(samples)
    table = np.column_stack([k, -k])
    np.savetxt(tmp_path / "disc/train.csv", table, "%d", ",", header="a,b", comments="")
    begins = set()
    for split in range(first_try.SPLITS):
        found = first_try.case(f"disc {split}", tmp_path)
        u, new = found.u.ravel(), found.new.u.ravel()
        assert len(u) == 0.6 * min(samples, 5000)
        assert (np.diff(u) == 1).all()
        assert (np.diff(new) == 1).all()
        assert not set(u) & set(new)
        np.testing.assert_array_equal(found.y.ravel(), -u)
        begins.add(u[0])
    assert len(begins) == first_try.SPLITS


def test_an_input_that_does_not_move_is_left_out(first_try: ModuleType, tmp_path: Path):
    (tmp_path / "soft_robot").mkdir()
    table = np.random.default_rng(0).standard_normal((400, 5))
    table[:, 1] = 0.0
    np.savetxt(tmp_path / "soft_robot/train.csv", table, "%.4f", ",", header="", comments="a")
    found = first_try.case("soft_robot 0", tmp_path)
    assert found.u.shape[1] == found.new.u.shape[1] == 2
    assert found.y.shape[1] == 2


def test_command_is_run_and_scored_on_new_data(
    first_try: ModuleType, monkeypatch: pytest.MonkeyPatch
):
    words = "test=0", "nx=1", "nz=1", "nw=1", "nn=2", "starts=1", "trainer.max_iter=2"
    monkeypatch.setattr(first_try, "WORDS", words)
    found = first_try.attempt("planted 001", Path())
    assert "failed" not in found, found
    assert found["recommended"] == found["errors"][found["use"]]
    assert found["sizes"] == {"nx": 1, "nz": 1, "nw": 1, "nn": 2, "linear nx": 1}
    assert 0.05 < found["errors"]["lti"] < 0.5
    assert found["seconds"] > 0
    monkeypatch.setattr(first_try, "WORDS", ("nx=none",))
    assert "nx" in first_try.attempt("planted 001", Path())["failed"]


def test_results_are_kept_and_a_label_does_not_touch_another(first_try: ModuleType, tmp_path: Path):
    results = tmp_path / "results.json"
    first_try.keep(results, "a", "planted 001", entry("better", 1.0, 2.0))
    first_try.keep(results, "b", "planted 001", entry("linear", 1.0, 2.0))
    first_try.keep(results, "a", "planted 000", entry("linear", 1.0, 1.0))
    kept = first_try.known(results)
    assert list(kept["a"]) == ["planted 000", "planted 001"]
    assert kept["b"] == {"planted 001": entry("linear", 1.0, 2.0)}


def test_report_counts_what_new_data_say(first_try: ModuleType):
    old = {
        "planted 000": entry("better", 2.0, 1.0, linear=True),  # neither true nor agreed with
        "planted 001": entry("better", 0.5, 1.0),
        "planted 002": entry("linear", 0.9, 1.0, seconds=8.0),
        "planted 003": {"linear": False, "samples": 400, "seconds": 1.0, "failed": "why"},
        "planted 040": entry("better", 0.5, 1.0),
    }
    fresh = {"planted 002": entry("better", 0.5, 1.0)}
    lines = first_try.report({"old": old, "fresh": fresh}).splitlines()
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line]
    table = {row[0]: row[1:] for row in rows[: rows.index(["planted 40 to 199", "old", "fresh"])]}
    assert table["planted 0 to 39"] == ["old", "fresh"]
    assert table["cases, of these failed"] == ["4, 1", "1, 0"]
    assert table["“better” agrees with new data"] == ["1 of 2", "1 of 1"]
    assert table["truth linear: “better”"] == ["1 of 1", "–"]
    # System 2 is worth a nonlinear model: another label found one.
    assert table["best model at most 0.8 of the linear error: “better”"] == ["1 of 2", "1 of 1"]
    assert table["recommended within 1.05 of the better of the two"] == ["1 of 3", "1 of 1"]
    assert table["recommended over the best of all columns"][0] == "2.00, worst 2.00"
    assert table["seconds, 300 to 999 samples"] == ["2.00, worst 8.00", "2.00, worst 2.00"]


def test_page_has_the_tables_of_the_results(first_try: ModuleType):
    page = (BENCHMARKS / "first_try.md").read_text()
    for table in first_try.report(first_try.known(first_try.RESULTS)).split("\n\n"):
        assert table.strip() in page


def test_cases_are_named_in_short(first_try: ModuleType):
    assert first_try.chosen(["planted:3-4", "measured:disc"]) == [
        *("planted 003", "planted 004", "disc 0", "disc 1", "disc 2")
    ]
    assert len(first_try.chosen(["planted", "measured"])) == 260 + 8 * 3
    with pytest.raises(ValueError, match="no cases 'measured:drone'"):
        first_try.chosen(["measured:drone"])
