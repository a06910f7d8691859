"""Power spectral densities of signals, and of the noise that periods show."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from lfrtorch.analysis.densities import noise_density, noise_of_periods, power_density
from lfrtorch.data.records import Record

pytestmark = pytest.mark.numeric


@given(
    N=st.integers(3, 40),
    periods=st.integers(1, 4),
    skip=st.integers(0, 2),
    unit=st.floats(-12.0, 12.0),
    noise=st.sampled_from([0.0, 1e-3, 1.0]),
    seed=st.integers(0, 1000),
)
@example(N=3, periods=2, skip=0, unit=0.0, noise=1.0, seed=0)  # a tenth of three samples is none
@settings(max_examples=40)
def test_densities_of_any_periods_are_numbers(
    N: int, periods: int, skip: int, unit: float, noise: float, seed: int
):
    """And the noise is known from its density and from its deviation alike, if at all."""
    rng = np.random.default_rng(seed)
    u, y = (np.tile(rng.normal(size=(N, 1)), (periods, 1)) for _ in range(2))
    y = 10.0**unit * (y + noise * rng.normal(size=y.shape))
    record = Record(u, y, 7.0, period=N, skip=skip)
    f, density = power_density(record.y, record.fs)
    assert (density >= 0.0).all()
    assert len(f) == len(density)
    deviation, found = noise_of_periods([record]), noise_density(record)
    assert (deviation is None) == (found is None)
    if deviation is not None and found is not None:
        f, density, same = found  # each line by itself: the mean density times the lines' distance
        assert np.array_equal(same, deviation)
        power = density.sum(axis=0) * record.fs / N
        assert power == pytest.approx(deviation**2, rel=1e-9, abs=1e-24 * 10.0 ** (2 * unit))
