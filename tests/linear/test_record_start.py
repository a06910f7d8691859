"""Whether a record begins at rest or in motion, by how linear models validate."""

import numpy as np
import pytest
import scipy.signal

from lfrtorch.data.records import Record
from lfrtorch.linear.record_start import StartTrial, try_starts

pytestmark = pytest.mark.numeric


def resonance(before: int, level: float = 0.0) -> Record:
    """A slow resonance with a stiffening spring, ``before`` samples after rest at u = 0."""
    noise, u = np.random.default_rng(0).normal(size=(2, 600 + before))
    u += level - u[before:].mean()  # x = 0 is rest at the mean
    y = scipy.signal.lfilter([1.0], [1, -1.96, 0.9702], u)
    y = np.tanh(y / 1000.0)
    return Record(u[before:], (y + 0.03 * y.std() * noise)[before:])


def tanks() -> Record:
    """Two tanks that begin empty under a pump at full power: outflows grow as roots of levels."""
    draw = np.random.default_rng(1)
    u = np.repeat(draw.uniform(2, 9, 15), 40)
    u[:80] = 9.0
    x, y = np.zeros(2), np.empty(600)
    for k in range(600):
        y[k] = x[1]
        out = np.sqrt(np.maximum(x, 0.0))
        x = x + 0.03 * np.array([u[k] / 4 - out[0], out[0] - out[1]])
    return Record(u, y + 0.01 * draw.normal(size=600))


def test_a_start_in_motion_is_estimated():
    found = try_starts(resonance(2000))
    assert found.estimated < 0.9 * found.zero
    assert found.chosen == "estimated"


def test_rest_at_another_level_than_the_mean_is_no_rest():
    """x = 0 is rest at the mean of the input, and the record begins at rest at 0."""
    assert try_starts(resonance(0, level=2.0)).chosen == "estimated"


def test_tanks_that_an_estimated_start_hurts_begin_from_rest():
    """Rest explains the beginning badly, and the rest of the record better."""
    found = try_starts(tanks())
    assert found.estimated > 1.2 * found.zero
    assert found.chosen == "zero"


def test_no_linear_model_of_a_short_record():
    with pytest.raises(ValueError, match=r"has 36 samples; to tell .* takes 40"):
        try_starts(resonance(0)[:36])


def test_rest_must_be_clearly_better():
    assert StartTrial(0.94, 1.0).chosen == "zero"
    assert StartTrial(0.96, 1.0).chosen == "estimated"
    assert str(StartTrial(0.96, 1.0)).endswith("no harm at rest either: start is estimated")
    assert str(StartTrial(1.0, 0.9)).endswith("with an estimated start: start is estimated")
    assert str(StartTrial(0.9, 1.0)).endswith("with an estimated start: start is zero")
