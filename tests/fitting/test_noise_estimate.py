"""Covariances of the noise inside a system, found again from its records."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from exported import step
from reference import normal, random_cell, random_model

import lfrtorch
from lfrtorch import NoiseCovariance
from lfrtorch.model.model import Model

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


def test_the_noise_of_a_linear_model_is_the_same_in_all_units():
    """Of the outputs, and of the states, which have those units."""
    rng, found = np.random.default_rng(0), []
    A, B, C = np.array([[0.8, 0.3], [-0.3, 0.8]]), np.array([[0.3], [0.15]]), np.array([[1.0, 0.2]])
    u, x, y = rng.normal(size=(400, 1)), np.zeros(2), np.zeros((400, 1))
    for k in range(400):
        y[k] = C @ x + 0.1 * rng.normal()
        x = A @ x + B @ u[k] + 0.03 * rng.normal(size=2)
    for y_unit, x_unit in ((1.0, 1.0), (1e5, 1.0), (1e-6, 1e-3)):
        linear = lfrtorch.LinearModel(
            A, B * x_unit, C * y_unit / x_unit, np.zeros((1, 1)), fs=1.0, u_offset=np.zeros(1),
            y_offset=np.zeros(1), inputs=(lfrtorch.Channel("u"),), outputs=(lfrtorch.Channel("y"),),
        )  # fmt: skip
        noise = lfrtorch.estimate_noise(linear.to_model(), lfrtorch.Record(u, y * y_unit))
        found.append(
            [
                *np.diag(np.asarray(noise.Q)) / x_unit**2,
                float(np.trace(np.asarray(noise.R))) / y_unit**2,
            ]
        )
    np.testing.assert_allclose(found[1:], [found[0]] * 2, rtol=1e-3)
    assert found[0][2] == pytest.approx(0.01, rel=0.3)


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
