"""No index of a compiled kernel leaves its array, whatever comes to the doors."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / "kernel_bounds.py"


@pytest.mark.slow
def test_no_index_leaves_its_array(tmp_path: Path):
    checked = {
        "NUMBA_BOUNDSCHECK": "1",
        "NUMBA_CACHE_DIR": str(tmp_path),
        "LFRTORCH_SLOW_PATHS": "",
    }
    command = [sys.executable, str(SCRIPT), "40"]
    done = subprocess.run(
        command, env=os.environ | checked, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "40 models, no index left its array" in done.stdout
