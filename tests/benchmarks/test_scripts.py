import subprocess
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
SCRIPTS = sorted(p.stem for p in BENCHMARKS.glob("*.py") if "ArgumentParser" in p.read_text())


@pytest.mark.slow
@pytest.mark.parametrize("script", SCRIPTS)
def test_script_says_what_it_measures(script: str):
    command = [sys.executable, BENCHMARKS / f"{script}.py", "--help"]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    assert run.stdout.startswith(f"usage: {script}.py")
