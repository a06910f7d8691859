"""The comparison with other packages: what a script gets, what is kept of it, the page."""

import argparse
import importlib.util
import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest

FOLDER = Path(__file__).resolve().parents[2] / "benchmarks"
spec = importlib.util.spec_from_file_location("comparison", FOLDER / "comparison.py")
assert spec is not None
assert spec.loader is not None
comparison = importlib.util.module_from_spec(spec)
spec.loader.exec_module(comparison)


@pytest.fixture
def options(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> argparse.Namespace:
    """Records of 400 samples, and scripts in a folder of their own."""
    monkeypatch.setattr(comparison, "SCRIPTS", tmp_path)
    (tmp_path / "given.py").write_text((FOLDER / "contestants" / "given.py").read_text())
    (tmp_path / "two_tanks").mkdir()
    u = np.random.default_rng(0).standard_normal(400)
    table = np.column_stack([u, 2.0 * u])
    np.savetxt(
        tmp_path / "two_tanks/train.csv", table, delimiter=",", header="pump,level", comments=""
    )
    return argparse.Namespace(root=None, wild=tmp_path, peers=Path(sys.prefix))


def ended(options: argparse.Namespace, text: str) -> dict:
    (options.wild / "mine.py").write_text(f'"""A script of mine."""\n\n{text}\n')
    return comparison.run("two_tanks", "mine", options)


def test_the_error_is_that_of_the_last_quarter(options: argparse.Namespace):
    wrong = "from given import every_u, keep, u, y\nassert len(u) == len(y) == 300\n"
    wrong += "found = 2 * every_u\nfound[:300] = 7\nfound[300:] += 0.5\nkeep(found)"
    found = ended(options, wrong)
    assert found["rmse"] == pytest.approx(0.5)
    assert found["nrmse"] == pytest.approx(0.25, rel=0.2)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("raise ValueError('no')", "ValueError: no"),
        ("pass", "no output"),
        ("from given import every_u, keep\nkeep(every_u * float('nan'))", "diverges"),
    ],
)
def test_a_script_that_fails_has_its_reason(options: argparse.Namespace, text: str, why: str):
    assert why in ended(options, text)["failed"]


def test_a_script_that_goes_on_is_ended(
    options: argparse.Namespace, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(comparison, "SECONDS", 1.0)
    monkeypatch.setattr(comparison, "GRACE", 1.0)
    found = ended(options, "import time\ntime.sleep(600)")
    assert found == {"failed": "not done in two minutes"}


def test_as_many_iterations_are_made_as_the_time_allows(
    options: argparse.Namespace, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(comparison, "SECONDS", 60.0)  # ten are left for the simulation
    counts = options.wild / "counts.txt"
    text = "import time\nfrom given import affordable, every_u, keep\n"
    text += "few = affordable(lambda n: time.sleep(0.05 * n), 9000)\n"
    text += "many = affordable(lambda n: None, 1000)\nkeep(every_u)\n"
    text += f"open({str(counts)!r}, 'w').write(f'{{few}} {{many}}')"
    assert "failed" not in ended(options, text)
    few, many = map(int, counts.read_text().split())
    assert many == 1000
    assert 50 < few < 9000  # a thousand of a twentieth of a second each


def test_the_page_has_the_table_of_the_results():
    every = json.loads(comparison.RESULTS.read_text())
    page = (FOLDER / "comparison.md").read_text()
    assert comparison.table(every) in page
    scripts = {path.stem for path in comparison.SCRIPTS.glob("*.py")} - {"given"}
    assert scripts == {*comparison.CONTESTANTS}
    assert {*every} == {*comparison.SYSTEMS}
    assert re.search(r"no test record is used", page)
