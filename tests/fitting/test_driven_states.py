"""States that w alone drives: placed by the data, silent until the fit uses them."""

import numpy as np
import pytest
from scipy.signal import lfilter

from lfrtorch.data.excitation import multisine
from lfrtorch.data.metrics import rmse
from lfrtorch.data.records import Record
from lfrtorch.fitting.driven_states import distortion_frequencies, relaxation_frequencies
from lfrtorch.fitting.multistart import fit
from lfrtorch.fitting.starts import initialise
from lfrtorch.least_squares.levenberg_marquardt import LevenbergMarquardt
from lfrtorch.linear.bla import estimate_bla

pytestmark = pytest.mark.numeric

RATTLE = 0.15
"""Frequency of the mode that only the nonlinearity excites, over the sampling rate."""


def rattling(periods: int = 3) -> Record:
    """A slow mode, whose cubed output drives a fast one; the input ends at 0.1 of the rate."""
    u = np.tile(multisine(1000, band=(0.005, 0.1), seed=1).u[0, :, 0], periods)
    slow = lfilter([0.1], [1.0, -1.8, 0.9], u)
    decay = 0.97
    fast = lfilter(
        [0.0, 10 * (1.0 - decay)], [1.0, -2 * decay * np.cos(2 * np.pi * RATTLE), decay**2], slow**3
    )
    return Record(u[-1000:], (slow + fast)[-1000:], start="periodic")


def test_frequencies_split_the_errors_above_the_band():
    t = np.arange(4000)
    low = multisine(4000, band=(0.001, 0.05)).u[0]
    tones = 3 * np.cos(2 * np.pi * 0.02 * t) + np.cos(2 * np.pi * 0.15 * t)
    errors = (tones + np.cos(2 * np.pi * 0.3 * t))[:, None]  # the loudest is in the band
    found = distortion_frequencies([low], [errors], 2) / (2 * np.pi)
    assert found == pytest.approx([0.15, 0.3], abs=2e-3)
    with pytest.raises(ValueError, match="modes is 2"):
        distortion_frequencies([np.random.default_rng(0).normal(size=(4000, 1))], [errors], 2)
    with pytest.raises(ValueError, match="modes is 1"):
        distortion_frequencies([low], [0 * errors], 1)


def test_relaxations_cover_two_decades_below_half_the_band():
    low = multisine(4000, band=(0.001, 0.1)).u[0]
    found = relaxation_frequencies([low], 5) / (2 * np.pi)
    assert np.all((found > 0.05 / 100) & (found < 0.05))
    assert found[:-1] / found[1:] == pytest.approx([100**0.2] * 4)
    assert not len(relaxation_frequencies([low], 0))


def test_a_start_with_driven_states_is_the_linear_model():
    record = rattling()
    bla = estimate_bla(record, 2)
    model = initialise(bla, record, nz=1, nw=1, nn=4, relaxations=3, modes=2)
    assert model.sizes["nx"] == 2 + 3 + 4
    assert np.allclose(model.simulate(record), bla.simulate(record), rtol=0, atol=1e-9)
    frequencies = np.abs(np.angle(np.linalg.eigvals(model.lfr.cell.A.detach().numpy())))
    assert np.sum(np.abs(frequencies / (2 * np.pi) - RATTLE) < 0.05) >= 2


def test_modes_are_worth_their_states():
    record = rattling()
    errors = []
    for nx, modes in ((4, 0), (2, 1)):
        bla = estimate_bla(record, nx)
        model = initialise(bla, record, nz=1, nw=1, nn=6, modes=modes)
        found = fit(model, record, trainer=LevenbergMarquardt(max_iter=20)).model
        errors.append(rmse(record, found.simulate(record)))
    assert errors[1] < 0.8 * errors[0]  # 0.6, and more later on: both come to 0 in the end
