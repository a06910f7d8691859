"""Tests of states and inputs at rest with given outputs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from reference import random_cell, random_model

import lfrtorch
from lfrtorch.analysis import linearise, trim
from lfrtorch.model.model import Model

pytestmark = pytest.mark.numeric

NAN = np.nan


@pytest.fixture(scope="module")
def model() -> Model:
    return random_model(random_cell(nu=2, ny=2, nx=3, nz=2, nw=2, radius=0.5, feedback=0.4))


def held(model: Model, found: lfrtorch.analysis.Trim) -> None:
    """The simulation from there stays there."""
    y = model.simulate(np.tile(found.u, (200, 1)), start="given", x0=found.x)
    np.testing.assert_allclose(y, np.tile(found.y, (200, 1)), rtol=0, atol=1e-6)


def test_outputs_that_a_constant_input_reaches_are_found_again(model: Model):
    u = model.scaler.u_offset + model.scaler.u_scale * np.array([0.4, -0.7])
    y = model.simulate(np.tile(u, (400, 1)))[-1]
    for given in ({"y": y}, {"y": [y[0], NAN], "u": [NAN, u[1]]}, {"u": u}):
        found = trim(model, **given)
        held(model, found)
        np.testing.assert_allclose(found.y, y, rtol=1e-6)
        np.testing.assert_allclose(found.u, u, rtol=1e-6)
        np.testing.assert_allclose(found.residual, 0.0, atol=1e-6)


def test_of_several_inputs_it_is_one_next_to_the_offsets(model: Model):
    s = model.scaler
    y = trim(model, u=s.u_offset).y
    found = trim(model, y=[y[0], NAN])
    np.testing.assert_allclose(found.u, s.u_offset, atol=1e-4 * s.u_scale.max())
    held(model, trim(model))


def test_out_of_reach_the_outputs_are_the_nearest_and_the_residual_says_so(model: Model):
    s = model.scaler
    low, high = s.u_offset - 0.3 * s.u_scale, s.u_offset + 0.3 * s.u_scale
    wanted = trim(model, u=s.u_offset).y + 5.0 * s.y_scale
    found = trim(model, y=wanted, bounds=(low, high))
    held(model, found)
    assert (found.u >= low - 1e-9).all()
    assert (found.u <= high + 1e-9).all()
    np.testing.assert_allclose(found.residual, found.y - wanted, rtol=1e-6)
    best = np.linalg.norm(found.residual / s.y_scale)
    for u in np.random.default_rng(0).uniform(low, high, (20, 2)):
        other = (trim(model, u=u).y - wanted) / s.y_scale
        assert best <= np.linalg.norm(other) * (1 + 1e-6)


def test_an_integrator_rests_anywhere():
    cell = random_cell(nu=1, ny=1, nx=2, nz=1, nw=1, radius=0.5, feedback=0.4)
    with torch.no_grad():
        cell.A[:] = torch.tensor([[1.0, 0.1], [0.0, 0.5]])
        cell.Bw[0], cell.Bu[0], cell.Cy[:], cell.Dyu[:] = 0.0, 0.0, torch.tensor([[1.0, 0.0]]), 0.0
        cell.Dyw[:], cell.Cz[:, 0] = 0.0, 0.0
    model = random_model(cell)
    for y in (-3.0, 0.0, 50.0):
        found = trim(model, y=y)
        held(model, found)
        np.testing.assert_allclose(found.y, y, atol=1e-6)
        assert np.abs(linearise(model, found).poles).max() > 1.0 - 1e-6


def test_a_linearisation_carries_state_input_output_and_gain(model: Model):
    K = torch.full((3, 2), 0.1, dtype=torch.float64)
    found = trim(model, y=trim(model).y)
    local = linearise(replace(model, K=K), found)
    assert local.x_offset is not None
    assert local.K is not None
    np.testing.assert_array_equal(local.x_offset, found.x)
    np.testing.assert_array_equal(local.u_offset, found.u)
    np.testing.assert_allclose(local.y_offset, found.y, rtol=1e-12)
    np.testing.assert_allclose(local.K * model.scaler.y_scale, 0.1, rtol=1e-12)
    doubled = local.transformed(2.0 * np.eye(3))
    assert doubled.x_offset is not None
    np.testing.assert_allclose(doubled.x_offset, 2.0 * found.x)


def test_a_linearisation_is_saved_with_its_state(model: Model, tmp_path):
    local = linearise(model)
    again = lfrtorch.LinearModel.load(local.save(tmp_path / "local"))
    np.testing.assert_array_equal(again.x_offset, local.x_offset)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"y": [1.0]}, "y is .*; give 2 number"),
        ({"u": [1.0, np.inf]}, "u is .*; give 2 number"),
        ({"bounds": (3.0, 2.0)}, "give the smallest input"),
        ({"bounds": ([1.0, 2.0, 3.0], 5.0)}, "give two bounds of 2"),
        ({"u": [9.0, NAN], "bounds": (0.0, 1.0)}, "outside of the bounds"),
    ],
)
def test_what_cannot_be_meant_is_refused(model: Model, given: dict, message: str):
    with pytest.raises(ValueError, match=message):
        trim(model, **given)
