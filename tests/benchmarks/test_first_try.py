import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import lfrtorch

SCRIPT = Path(__file__).resolve().parents[2] / "benchmarks" / "first_try.py"


@pytest.fixture(scope="module")
def first_try() -> ModuleType:
    spec = importlib.util.spec_from_file_location("first_try", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["first_try"] = module
    spec.loader.exec_module(module)
    return module


def test_cart_sticks_and_is_under_feedback(first_try: ModuleType):
    signals = first_try.cart(Path())["cart"]
    position = signals.y.ravel()
    standing = np.abs(np.diff(position)) < 1e-4
    assert 0.1 < standing.mean() < 0.9
    # The force follows the position: a controller is at work.
    assert np.corrcoef(np.diff(signals.u.ravel()), np.diff(position))[0, 1] < -0.1


def test_linear_case_is_linear(first_try: ModuleType):
    signals = first_try.linear(Path())["linear"]
    model = lfrtorch.estimate_bla(lfrtorch.Record(signals.u, signals.y, fs=100.0), nx=4)
    assert model.fit is not None
    assert model.fit.rmse == pytest.approx(0.05, rel=0.1)  # the noise, of 3000 samples


def test_grid_goes_on_and_keeps_errors(first_try: ModuleType, tmp_path: Path, monkeypatch):
    monkeypatch.setattr(first_try, "NX", (1, 2))
    monkeypatch.setattr(first_try, "NZ", (1,))
    monkeypatch.setattr(first_try, "NW", (1,))
    monkeypatch.setattr(first_try, "NN", (2,))
    monkeypatch.setattr(first_try, "SEEDS", (0,))
    monkeypatch.setattr(first_try, "ITERATIONS", 2)
    results = tmp_path / "grid.json"
    first_try.grid("linear", Path(), tmp_path, results, 0.0)
    assert not results.exists()
    first_try.grid("linear", Path(), tmp_path, results, 60.0)
    kept = json.loads(results.read_text())["linear"]
    assert sorted(entry["nx"] for entry in kept) == [1, 2]
    assert all(0.0 < entry["error"] < np.inf for entry in kept)
    first_try.grid("linear", Path(), tmp_path, results, 60.0)
    assert json.loads(results.read_text())["linear"] == kept


def test_missing_files_are_named(first_try: ModuleType, tmp_path: Path, capsys):
    assert not first_try.at_hand("tanks", tmp_path)
    assert "tanks is left out" in capsys.readouterr().err
    assert first_try.at_hand("cart", tmp_path)


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.parametrize("case", ["tanks", "silverbox", "emps", "ced", "cart", "linear"])
def test_what_is_chosen_is_near_the_best_of_the_grid(
    first_try: ModuleType, case: str, benchmark_root: Path, tmp_path: Path
):
    row = first_try.attempt(case, benchmark_root, tmp_path, first_try.RESULTS)
    # How long it takes is the machine's.
    wrong = [part for part in row["found wrong"].split(", ") if not part.endswith("min")]
    assert wrong in ([], [""]), row
