import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # numpy's, read at its import; see below

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from hypothesis import settings

ROOT = Path(__file__).resolve().parents[1]

torch.set_num_threads(1)  # small matrices: more threads cost more than they give

# Same examples in every run, none kept on disk; compilation may take its time.
settings.register_profile("lfrtorch", deadline=None, derandomize=True, database=None)
settings.load_profile("lfrtorch")


@pytest.fixture(scope="session")
def benchmark_root() -> Path:
    """Folder of the nonlinear benchmarks, one subfolder a benchmark."""
    given = os.environ.get("LFRTORCH_DATA")
    root = Path(given) if given else ROOT.parent / "shared" / "data" / "nonlinear_benchmarks"
    if root.is_dir():
        return root
    if given:
        pytest.fail(f"LFRTORCH_DATA is {given!r}, which is not a folder")
    pytest.skip("no benchmark files: set LFRTORCH_DATA to a folder of the nonlinear benchmarks")


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Whatever a test does to torch's threads ends with it."""
    yield
    torch.set_num_threads(1)
