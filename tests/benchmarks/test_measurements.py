import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import lfrtorch

SCRIPT = Path(__file__).resolve().parents[2] / "benchmarks" / "measurements.py"


@pytest.fixture(scope="module")
def measurements() -> ModuleType:
    spec = importlib.util.spec_from_file_location("measurements", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_cart_sticks_and_is_under_feedback(measurements: ModuleType):
    u, y = measurements.cart(Path())
    position = y.ravel()
    standing = np.abs(np.diff(position)) < 1e-4
    assert 0.1 < standing.mean() < 0.9
    # The force follows the position: a controller is at work.
    assert np.corrcoef(np.diff(u.ravel()), np.diff(position))[0, 1] < -0.1


def test_linear_case_is_linear(measurements: ModuleType):
    u, y = measurements.linear(Path())
    model = lfrtorch.estimate_bla(lfrtorch.Record(u, y, fs=100.0), nx=4)
    assert model.fit is not None
    assert model.fit.rmse == pytest.approx(0.05, rel=0.1)  # the noise, of 3000 samples
