import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

import lfrtorch

SCRIPT = Path(__file__).resolve().parents[2] / "benchmarks" / "planted.py"


@pytest.fixture(scope="module")
def benchmark() -> ModuleType:
    spec = importlib.util.spec_from_file_location("planted", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["planted"] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def systems(benchmark: ModuleType) -> list[Any]:
    return [benchmark.planted(number) for number in range(benchmark.COUNT)]


def test_all_are_finite_and_have_new_data(systems: list[Any]):
    for system in systems:
        for signal in (system.u, system.y, system.new_u, system.new_y):
            assert np.isfinite(signal).all(), system.name
        assert 150 <= len(system.u) == len(system.y) <= 5000
        assert len(system.new_u) == len(system.new_y) == system.skip + 2000
        # New data is neither still nor of another size.
        assert 0.25 < system.new_y[system.skip :].std() / system.y.std() < 4, system.name


def test_they_vary(systems: list[Any]):
    assert sum(system.linear for system in systems) == 91
    assert len({system.kind for system in systems}) == 12
    assert 0.3 < np.mean([system.in_motion for system in systems]) < 0.5
    assert sum(system.u.shape[1] == 2 for system in systems) > 10


def test_a_number_repeats(benchmark: ModuleType, systems: list[Any]):
    for number in (0, 5):
        again = benchmark.planted(number)
        np.testing.assert_array_equal(again.y, systems[number].y)
        np.testing.assert_array_equal(again.new_y, systems[number].new_y)
    with pytest.raises(ValueError, match="number is 260"):
        benchmark.planted(260)


@pytest.mark.parametrize("number", [0, 1])
def test_linear_is_what_a_linear_model_explains(systems: list[Any], number: int):
    system = systems[number]
    assert system.linear == (number == 0)
    # The output without noise: what is left is not linear.
    record = lfrtorch.Record(system.new_u, system.new_y, fs=system.fs, start="estimated")
    model = lfrtorch.estimate_bla(record, nx=4)
    assert model.fit is not None
    left = model.fit.rmse / system.new_y.std()
    assert (left < 0.01) == system.linear
