import gc
import os

# Small matrices: more threads cost more than they give. Emulated machines may have two.
os.environ.setdefault("LFRTORCH_TEST_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", os.environ["LFRTORCH_TEST_THREADS"])  # numpy's

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import settings
from shapes import calls, install
from threadpoolctl import threadpool_limits

gc.disable()  # until all is imported: there is much of it, and nothing in it is garbage
install()

ROOT = Path(__file__).resolve().parents[1]

THREADS = int(os.environ["LFRTORCH_TEST_THREADS"])
torch.set_num_threads(THREADS)
# jaxtyping's plugin of pytest has imported numpy before the variable above was set.
threadpool_limits(THREADS, user_api="blas")

# Same examples in every run, none kept on disk; compilation may take its time.
settings.register_profile("lfrtorch", deadline=None, derandomize=True, database=None)
settings.load_profile("lfrtorch")


def pytest_itemcollected(item: pytest.Item) -> None:
    """The name of a test is the same in each process, or the workers cannot share the tests."""
    if " at 0x" in item.name:
        raise pytest.UsageError(f"{item.nodeid} is named by an address: give ids to parametrize")


def pytest_collection_finish() -> None:
    """From now on garbage is collected, except in what has been imported: it is looked at once."""
    gc.freeze()
    gc.enable()


@pytest.fixture(autouse=True)
def shapes_are_checked() -> None:
    """The first call in each test, again."""
    calls.clear()


@pytest.fixture
def short_paths(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two ridges in the place of seven and the small sizes alone, where sizes are chosen."""
    monkeypatch.setattr("lfrtorch.fitting.choice._RIDGES", ((0.1, 3), (1e-3, 3)))
    monkeypatch.setattr("lfrtorch.fitting.choice._budget", lambda rows: 1e-9)


@pytest.fixture
def coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    """All figures are drawn, of few pixels."""
    monkeypatch.setattr("lfrtorch.reporting.plots._DPI", 40)


@pytest.fixture
def shorter(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """``shorter(period=..., sweep=...)`` simulates so few samples of the Bouc-Wen system."""

    def shorten(**samples: int) -> None:
        for name, count in samples.items():
            monkeypatch.setattr(f"lfrtorch.datasets.boucwen._{name.upper()}", count)

    return shorten


@pytest.fixture
def fast(monkeypatch: pytest.MonkeyPatch) -> Callable[[bool], None]:
    """Quick ways, in a run without them as well; ``fast(False)`` turns them off."""

    def turn(on: bool) -> None:
        monkeypatch.setenv("LFRTORCH_SLOW_PATHS", "" if on else "1")

    turn(True)
    return turn


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


@pytest.fixture
def official(benchmark_root: Path) -> Callable[..., Any]:
    """Reads a benchmark with the reader given; a test whose files are missing is skipped."""

    def load(reader: Callable[..., Any], **options: Any) -> Any:
        try:
            return reader(root=benchmark_root, **options)
        except FileNotFoundError as missing:
            pytest.skip(str(missing))

    return load


@pytest.fixture(autouse=True)
def same_threads() -> Iterator[None]:
    """Whatever a test does to torch's threads ends with it."""
    yield
    torch.set_num_threads(THREADS)
