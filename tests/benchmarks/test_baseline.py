import re
import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks.ratios import LIMIT, ratio, show

ROOT = Path(__file__).resolve().parents[2]


def seconds(ratios: np.ndarray) -> np.ndarray:
    """Pairs of times with these ratios, at a load that changes from pair to pair."""
    load = 1 + np.arange(len(ratios)) % 7
    return np.stack([load, load * ratios], axis=1)


def test_interval_is_that_of_the_order_statistics():
    # Of 15 fair coins fewer than 4 show heads with probability 0.018, fewer than 5 with 0.059.
    found = ratio(seconds(np.random.default_rng(0).permutation(np.arange(1.0, 16.0))))
    assert np.allclose(found, (8, 4, 12))


def test_interval_covers_the_median_as_often_as_it_says():
    rng = np.random.default_rng(0)
    intervals = [ratio(seconds(rng.lognormal(size=20))) for _ in range(400)]
    missed = sum(not (low <= 1 <= high) for _, low, high in intervals)
    assert 0 < missed <= 30  # 4.1 % of 400 are 16.5, and 4 sigma are 16


@pytest.mark.parametrize(
    ("middle", "spread", "verdict"),
    [(1.0, 0.01, "| met |"), (1.05, 0.2, "open"), (1.1, 0.01, "not met"), (0.9, 0.1, "| met |")],
)
def test_only_a_whole_interval_beyond_the_limit_fails(
    middle: float, spread: float, verdict: str, capsys: pytest.CaptureFixture[str]
):
    times = seconds(middle + np.linspace(-spread, spread, 20))
    assert show({"case": times}) == (verdict == "not met")
    row = capsys.readouterr().out.splitlines()[-1]
    assert row.startswith("| case |")
    assert verdict in row
    assert f"≤ {LIMIT}" in row


@pytest.mark.slow
def test_checkout_is_as_fast_as_itself():
    case = "Bouc-Wen, simulation"
    script = ROOT / "benchmarks" / "baseline.py"
    command = [sys.executable, script, ROOT, "--pairs", "12", "--case", case]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert "Traceback" not in run.stderr
    (row,) = re.findall(rf"\| {case} \| .*", run.stdout)
    assert 0.5 < float(row.split("|")[4]) < 2  # the load of the machine may change
    assert "outcomes" not in run.stdout
    assert (run.returncode == 1) == ("not met" in row)


def test_another_folder_than_a_checkout_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    monkeypatch.setattr(sys, "argv", ["baseline.py", str(tmp_path)])
    with pytest.raises(SystemExit) as end:
        runpy.run_path(str(ROOT / "benchmarks" / "baseline.py"), run_name="__main__")
    assert end.value.code == 2
    assert "no checkout of lfrtorch" in capsys.readouterr().err
