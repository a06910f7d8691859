"""Outputs that are not valid, on the whole way from records to scores."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

import lfrtorch
from lfrtorch.data.records import Record

pytestmark = pytest.mark.numeric

NOISE = 0.01


def measured(T: int, name: str) -> Record:
    """A Hammerstein system with noise, and one sample in fifty far off, which is left out."""
    rng = np.random.default_rng(T)
    u = rng.normal(size=T)
    y = lfilter([0.0, 1.0], [1.0, -0.7], np.tanh(u)) + NOISE * rng.normal(size=T)
    far = rng.random(T) < 0.02
    return Record(u, np.where(far, 20.0, y), start="estimated", name=name, valid=~far)


def test_a_fit_goes_through_outliers_that_are_left_out(tmp_path):
    train, validation, test = (measured(T, f"record_{T}") for T in (400, 200, 301))
    data = lfrtorch.Dataset("mine", train=[train], validation=[validation], tests=[test])
    trainer = lfrtorch.LevenbergMarquardt(max_iter=20)
    run = lfrtorch.identify(data, lfrtorch.Settings(nx=1, nz=1, nw=1, nn=3, trainer=trainer))
    (record,) = run.dataset.tests
    # The outliers are two thousand times the noise.
    assert lfrtorch.rmse(record, run.model.simulate(record)) < 1.3 * NOISE
    lfrtorch.reporting.write(run, tmp_path)  # figures, residuals and advice take them as well


def test_what_needs_every_sample_says_so():
    record = measured(600, "mine")
    with pytest.raises(ValueError, match=r"record 'mine' has \d+ output sample.* a spectrum needs"):
        lfrtorch.estimate_frf(record)
    with pytest.raises(ValueError, match="a prediction from past outputs"):
        lfrtorch.estimate_bla(record, nx=1, refine="prediction")


def test_a_filter_takes_outputs_that_are_not_valid_for_missing():
    record = measured(100, "mine")
    assert record.valid is not None
    bla = lfrtorch.estimate_bla(record, nx=1)
    noise = lfrtorch.NoiseCovariance(Q=1e-4, R=1e-2)
    model = bla.to_model()
    found = model.observer(noise=noise, after=record)
    other = model.observer(noise=noise)
    for u, y, valid in zip(record.u, record.y, record.valid, strict=True):
        other.predict(u)
        other.update(y if valid else None)
    np.testing.assert_allclose(found.state, other.state, rtol=1e-10, atol=1e-12)


def test_limits_of_the_sensor_go_with_modes_that_hardly_count():
    """Modes are looked at one by one, as outputs of their own, which have no limits."""
    record = measured(200, "mine")
    record = replace(record, limits=(None, 19.0), valid=None)
    bla = lfrtorch.estimate_bla(record, nx=3)
    assert lfrtorch.initialise(bla, record, nz=1, nw=1, nn=3).sizes["nz"] == 1


def test_periods_with_outputs_that_are_not_valid_are_fitted_as_signals():
    rng = np.random.default_rng(0)
    u = np.tile(rng.standard_normal(100), 4)
    y, valid = lfilter([0.0, 1.0], [1.0, -0.7], u), np.ones(400, dtype=bool)
    valid[250:255] = False
    record = Record(u, np.where(valid, y, np.nan), period=100, skip=100, valid=valid)
    assert lfrtorch.estimate_bla(record, nx=1).poles == pytest.approx([0.7], abs=1e-6)


def test_outputs_that_are_not_valid_in_the_validation_part_alone_go_through_a_job():
    record = measured(500, "mine")
    valid = np.ones(500, dtype=bool)
    valid[330:335] = False
    record = replace(record, valid=valid, start="zero")
    trainer = lfrtorch.LevenbergMarquardt(max_iter=4)
    settings = lfrtorch.Settings(nx=1, nz=1, nw=1, nn=3, starts=1, trainer=trainer, refit=True)
    assert lfrtorch.identify(record, settings).refit is not None
