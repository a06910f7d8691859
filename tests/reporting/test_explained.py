"""What a filter explains of the errors, and what it explains by chance."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.signal

from lfrtorch.reporting.explained import coherent_part, filtered_part

pytestmark = pytest.mark.numeric


def test_a_linear_filter_of_the_input_is_seen_in_the_error():
    rng = np.random.default_rng(0)
    u, noise = rng.standard_normal((4000, 1)), rng.standard_normal((4000, 1))
    filtered = scipy.signal.lfilter([1.0], [1.0, -0.8], u, axis=0)
    both = filtered / filtered.std() + noise
    # Half of the power; Welch's bias is corrected to within 0.1 at 8 segments.
    assert coherent_part([u], [both]) == pytest.approx(0.5, abs=0.1)
    assert coherent_part([u], [noise]) == pytest.approx(0.0, abs=0.1)
    assert coherent_part([u, u], [filtered, filtered]) == pytest.approx(1.0, abs=0.05)
    assert coherent_part([u[:60]], [noise[:60]]) is None
    # Filters fitted in time: 300 samples and 37 lags leave a standard deviation of 0.06.
    assert coherent_part([u[:300]], [both[:300]]) == pytest.approx(0.5, abs=0.2)
    assert coherent_part([u[:300]], [noise[:300]]) == pytest.approx(0.0, abs=0.2)
    # An error as slow as the input is explained in part by chance.
    slow, other = (scipy.signal.lfilter([1.0], [1.0, -0.97], x, axis=0) for x in (u, noise))
    assert filtered_part([slow[:300]], [other[:300]], 37) == pytest.approx(0.0, abs=0.25)
    parts = [u[:300], u[300:600]], [filtered[:300], filtered[300:600]]
    assert coherent_part(*parts) == pytest.approx(1.0, abs=0.1)
    assert coherent_part([u], [0.0 * noise]) == 0.0
    assert coherent_part([0.0 * u], [noise]) == pytest.approx(0.0, abs=0.1)
