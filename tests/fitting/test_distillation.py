"""One model in the place of a mean: it simulates as the mean does, at other inputs, too."""

from dataclasses import replace

import numpy as np
import pytest

from lfrtorch import LevenbergMarquardt, Record, distil, estimate_bla, fit, initialise
from lfrtorch.fitting.distillation import shuffled
from lfrtorch.metrics import rms


def noisy(samples: int, start: str = "zero") -> Record:
    """A first-order system that saturates at its input, measured with much noise."""
    rng = np.random.default_rng(0)
    u, y = rng.standard_normal(samples), np.zeros(samples)
    for k in range(samples - 1):
        y[k + 1] = 0.7 * y[k] + np.tanh(u[k])
    record = Record(u, y + 0.5 * rng.standard_normal(samples))
    return replace(record, start=start)  # pyright: ignore[reportArgumentType]


@pytest.mark.numeric
@pytest.mark.parametrize("start", ["zero", "periodic"])
def test_a_distilled_model_simulates_as_the_mean(start: str):
    record = noisy(200, start)
    bla = estimate_bla(record, nx=1)
    models = [initialise(bla, record, nz=1, nw=1, nn=3, seed=seed) for seed in range(3)]
    trainer = LevenbergMarquardt(max_iter=15)
    mean = fit(models, record, trainer=trainer, average=3)
    before = [member.simulate(record) for member in mean.members]
    one = distil(mean, record, trainer=trainer)
    assert one.model.sizes == mean.members[0].sizes
    u = np.random.default_rng(1).standard_normal(500)
    of_mean, of_one, *of_members = (
        m.simulate(u)[20:] for m in (mean.model, one.model, *mean.members)
    )
    assert rms(of_one - of_mean) < max(rms(each - of_mean) for each in of_members)
    after = [member.simulate(record) for member in mean.members]
    assert all(map(np.array_equal, before, after))  # the mean is as it was


def test_a_shuffled_input_has_the_amplitudes_and_nearly_the_spectrum():
    k = np.arange(400)
    u = np.c_[np.sin(0.05 * k) ** 3, np.convolve(np.sin(k**2), np.ones(20), "same")]
    found = shuffled(u, np.random.default_rng(0))
    assert np.array_equal(np.sort(found, axis=0), np.sort(u, axis=0))
    assert rms(found - u) > 0.5 * rms(u)
    lines = [np.abs(np.fft.rfft(s, axis=0)) for s in (found, u)]
    assert rms(lines[0] - lines[1]) < 0.2 * rms(lines[1])


def test_one_model_is_no_mean():
    record = noisy(80)
    model = initialise(estimate_bla(record, nx=1), record, nz=1, nw=1, nn=3)
    result = fit(model, record, trainer=LevenbergMarquardt(max_iter=1))
    with pytest.raises(ValueError, match="no mean of several; fit several starts with average=4"):
        distil(result, record)
