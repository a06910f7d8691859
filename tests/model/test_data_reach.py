"""Tests of where a model is known: the ranges of its data, and the distance of z from them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from reference import measure, random_cell, random_model

import lfrtorch
from lfrtorch.analysis import canonical, linearise, trim
from lfrtorch.data.records import Record
from lfrtorch.model.model import Model


@pytest.fixture(scope="module")
def model() -> Model:
    return random_model(random_cell(nu=2, ny=2, nx=3, nz=2, nw=2, radius=0.5, feedback=0.4))


@pytest.fixture(scope="module")
def record(model: Model) -> Record:
    return measure(model, 500, seed=1)


@pytest.fixture(scope="module")
def known(model: Model, record: Record) -> Model:
    return model.reaching(record)


@pytest.mark.numeric
def test_the_reach_is_that_of_the_data(known: Model, record: Record):
    reach = known.reach
    assert reach is not None
    np.testing.assert_allclose(reach.u[:, 0], record.u.min(axis=0))
    np.testing.assert_allclose(reach.y[:, 1], record.y.max(axis=0))
    z = known.signals(record).z[0].double().numpy()
    centred = z - z.mean(axis=0)
    distance = np.einsum("ti,ij,tj->t", centred, np.linalg.inv(np.cov(z.T, bias=True)), centred)
    expected = np.sqrt(distance / np.quantile(distance, 0.99))
    np.testing.assert_allclose(reach.z.surprise(z), expected, rtol=1e-3)


@pytest.mark.numeric
def test_missing_outputs_are_left_out(model: Model, record: Record):
    valid = np.ones(record.y.shape, bool)
    valid[np.argmax(record.y[:, 0]), 0] = False
    reach = model.reaching(replace(record, valid=valid)).reach
    assert reach is not None
    assert reach.y[0, 1] == np.sort(record.y[:, 0])[-2]


@pytest.mark.numeric
def test_an_operating_point_beyond_the_data_is_said(known: Model, model: Model):
    s = known.scaler
    assert linearise(known).outside == trim(known, u=s.u_offset).outside == ""
    far = s.u_offset + np.array([30.0, 0.0]) * s.u_scale
    for found in (linearise(known, far), trim(known, u=far)):
        assert f"{known.inputs[0].name} = " in found.outside
        assert "in the data" in found.outside
        assert known.inputs[1].name not in found.outside
    assert "outside of the data" in str(linearise(known, far))
    assert linearise(model, far).outside == ""  # its data are not known


@pytest.mark.numeric
def test_it_is_saved_and_stays_with_the_model(known: Model, record: Record, tmp_path):
    again = lfrtorch.load(known.save(tmp_path / "model"))
    assert again.reach is not None
    assert known.reach is not None
    for name in ("u", "y"):
        np.testing.assert_array_equal(getattr(again.reach, name), getattr(known.reach, name))
    np.testing.assert_array_equal(again.reach.z.axes, known.reach.z.axes)
    assert again.reach.z.farthest == known.reach.z.farthest
    noise = lfrtorch.NoiseCovariance(Q=1e-4, R=1e-2)
    disturbed = known.with_disturbance("input", noise)[0]
    assert disturbed.reach is known.reach
    far = known.scaler.u_offset + 30.0 * known.scaler.u_scale
    local = linearise(known, far)
    assert lfrtorch.LinearModel.load(local.save(tmp_path / "local")).outside == local.outside
    # In other coordinates of z it is as far.
    other = canonical(known, record).model
    assert other.reach is not None
    expected = known.reach.z.surprise(known.signals(record).z[0].double().numpy())
    found = other.reach.z.surprise(other.signals(record).z[0].double().numpy())
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_a_model_that_runs_away_has_none(model: Model, record: Record):
    wild = random_model(random_cell(nu=2, ny=2, nx=3, nz=1, nw=1, radius=30.0))
    wild = replace(wild, inputs=model.inputs, outputs=model.outputs, fs=model.fs)
    assert wild.reaching(record).reach is None
