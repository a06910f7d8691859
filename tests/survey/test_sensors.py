"""Frozen values and marks are found, and none in signals that are slow, coarse or at rest."""

import numpy as np
import pytest
from scipy.signal import chirp, lfilter

from lfrtorch._support.types import Array
from lfrtorch.survey.sensors import frozen, marked

pytestmark = pytest.mark.numeric

T = 3000
K = np.arange(T)
RNG = np.random.default_rng(0)
INPUTS: dict[str, Array] = {
    "noise": RNG.standard_normal(T),
    "slow noise": lfilter([0.02], [1, -0.98], RNG.standard_normal(T)),
    "sine": np.sin(0.01 * K),
    "chirp": chirp(K, 1e-3, T, 0.3),
    "step": np.where(K < 300, 0.0, 1.0),
    "binary": np.repeat(np.sign(RNG.standard_normal(T // 60)), 60),
    "levels": np.repeat(RNG.uniform(-1, 1, T // 50), 50),
    "ramps": np.interp(K, np.arange(0, T + 200, 200), RNG.uniform(-1, 1, T // 200 + 1)),
}
OUTPUTS = {
    "lag": lambda u: lfilter([0, 0.1], [1, -0.9], u),
    "slow lag": lambda u: lfilter([0, 0.002], [1, -0.998], u),
    "resonance": lambda u: lfilter([0, 1], np.poly(0.97 * np.exp([0.3j, -0.3j])).real, u),
    "dead zone": lambda u: np.sign(u) * np.maximum(np.abs(u) - 0.5 * np.std(u), 0.0),
}


@pytest.mark.parametrize("steps", [0, 0.002, 0.02, 0.3])
@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_no_system_is_frozen(steps: float, noise: float):
    for kind, u in INPUTS.items():
        for name, system in OUTPUTS.items():
            y = system(u)
            y = y + noise * y.std() * np.random.default_rng(1).standard_normal(T)
            if steps:
                y = np.round(y / (steps * y.std()))
            assert frozen(y, u[:, None]) == [], (kind, name)
            assert not marked(y).any(), (kind, name)
            assert not marked(u, of_input=True).any(), kind


@pytest.mark.parametrize("samples", [30, 120])
def test_a_frozen_part_is_found_where_the_input_moves(samples: int):
    for seed in range(20):
        rng = np.random.default_rng(seed)
        u = rng.standard_normal((T, 1))
        good = OUTPUTS["lag"](u[:, 0]) + 0.003 * rng.standard_normal(T)
        first = int(rng.integers(100, T - 200))
        part = slice(first, first + samples)
        y = good.copy()
        y[part] = y[first]
        assert frozen(y, u) == [part]
        u[first - 1 : first + samples] = 0.0
        assert frozen(y, u) == []
        if seed == 0:
            good[-samples:] = good[-samples]
            assert frozen(good, u) == [slice(T - samples, T)]


def test_a_clipped_part_is_not_frozen():
    u = INPUTS["noise"]
    y = OUTPUTS["resonance"](u)
    assert frozen(np.minimum(y, 0.9 * y.max()), u[:, None]) == []
    slow = INPUTS["slow noise"]
    assert frozen(np.minimum(slow, 0.95 * slow.max()), u[:, None]) == []


def test_pulses_and_a_rest_before_a_step_are_no_marks():
    pulses = np.where(K % 500 < 20, 5.0, 0.0) + np.where(K % 500 < 20, 0, 1e-3) * INPUTS["noise"]
    assert not marked(pulses, of_input=True).any()
    rest = np.where(K < 100, 0.0, 20 + 0.1 * INPUTS["noise"])
    assert not marked(rest).any()
