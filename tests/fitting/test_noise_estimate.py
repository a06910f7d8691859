"""Covariances of the noise inside a system, found again from its records."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from reference import normal, random_cell, random_model
from test_extended_kalman_filter import step

import lfrtorch
from lfrtorch import NoiseCovariance
from lfrtorch.model import Model

pytestmark = pytest.mark.numeric


def measured(model: Model, q: float, r: float, T: int, seed: int) -> lfrtorch.Record:
    """A record of a model with noise on its states, and on its outputs relative to their scale."""
    nx, ny, scale = model.lfr.cell.nx, len(model.outputs), model.scaler.y_scale
    rng = np.random.default_rng(seed)
    u, x, y = model.scaler.u_offset + rng.normal(size=(T, 1)), np.zeros(nx), np.empty((T, ny))
    for k in range(T):
        x_next, y[k] = step(model, x, u[k])
        x = x_next + q**0.5 * rng.normal(size=nx)
    y += r**0.5 * scale * rng.normal(size=y.shape)
    return lfrtorch.Record(u, y, fs=model.fs, inputs=model.inputs, outputs=model.outputs)


def test_the_variances_are_those_of_the_greatest_likelihood():
    model, (q, r) = random_model(random_cell(1, 1, 2, 1, 1, 3)), (1e-2, 1e-2)
    record = measured(model, q, r, 1500, seed=0)
    noise = lfrtorch.estimate_noise(model, record)
    scale = model.scaler.y_scale
    truth = NoiseCovariance(q, r * scale**2)
    gain = model.observer(noise=noise).follow(record.u, record.y)
    gain -= model.observer(noise=truth).follow(record.u, record.y)
    assert 0.0 <= gain < 10.0  # twice that is about chi-squared with a few degrees of freedom
    assert np.sqrt(np.diag(noise.R)) == pytest.approx(np.sqrt(r) * scale, rel=0.2)


def test_what_nothing_disturbs_has_no_noise_on_its_states():
    model = random_model(random_cell(1, 2, 2, 1, 1, 3))
    record = measured(model, 0.0, 1e-2, 400, seed=0)
    noise = lfrtorch.estimate_noise(model, record)
    assert (np.diag(noise.Q) < 1e-4).all()
    assert np.sqrt(np.diag(noise.R)) == pytest.approx(0.1 * model.scaler.y_scale, rel=0.15)


def test_the_noise_of_an_innovation_form_follows_from_its_errors():
    model = replace(random_model(random_cell(1, 2, 3, 1, 1, 3)), K=0.2 * normal(3, 2, seed=5))
    record = replace(measured(model, 0.0, 1e-2, 300, seed=0), skip=50)
    noise = lfrtorch.estimate_noise(model, [record, record])
    e = (record.y - model.predict(record))[50:]
    assert np.diag(noise.R) == pytest.approx(np.mean(e**2, axis=0), rel=1e-9)
    observer = model.observer(noise=noise, after=record)
    np.testing.assert_allclose(observer.state, model.observer(after=record).state, atol=1e-6)


def test_samples_at_a_limit_are_missing_ones():
    model = random_model(random_cell(1, 1, 2, 1, 1, 3))
    record = measured(model, 0.0, 1e-4, 200, seed=0)
    limit = np.quantile(record.y, 0.6)
    cut = replace(record, y=np.minimum(record.y, limit), limits=[None, limit])
    noise = lfrtorch.estimate_noise(model, cut)
    assert np.sqrt(np.diag(noise.R)) == pytest.approx(1e-2 * model.scaler.y_scale, rel=0.3)
