"""The LPV form of a model is the model itself, and its parameters stay within their bounds."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from exported import MODELS, check_run, check_step, inputs
from reference import SIGMA, measure, random_cell, random_model
from torch import Tensor

import lfrtorch
from lfrtorch.analysis import lpv

pytestmark = pytest.mark.numeric


class Hinges(torch.nn.Module):
    """A map of a class of its own with corners, on which no rule for integrals is exact."""

    def __init__(self) -> None:
        super().__init__()
        self.gain = torch.nn.Parameter(torch.tensor(0.2, dtype=torch.float64))

    def forward(self, z: Tensor) -> Tensor:
        return self.gain * torch.cat([z.abs(), z.roll(1, -1).clamp(-0.3, 0.1)], dim=-1)


OWN = random_model(random_cell(1, 1, 2, 2, 4, static=Hinges(), radius=0.5))


@pytest.mark.parametrize("name", [*MODELS, "own"])
def test_it_is_the_model(name: str):
    model = OWN if name == "own" else MODELS[name]
    for form in (lpv(model), lpv(model, schedule="map")):
        check_step(form.step, model)
    u = inputs(model, 30)
    np.testing.assert_allclose(form.simulate(u), model.simulate(u), rtol=0, atol=1e-10)


def test_long_simulations_are_those_of_the_model():
    check_run(lpv(MODELS["tanh"]).step, MODELS["tanh"])


@pytest.mark.parametrize("name", [*SIGMA, "polynomial"])
def test_it_is_the_model_about_any_point(name: str):
    model = MODELS[name]
    x = np.random.default_rng(0).standard_normal(model.lfr.cell.nx)
    form = lpv(model, inputs(model, 1)[0], x=x)
    check_step(form.step, model)


@pytest.mark.parametrize("name", SIGMA)
def test_about_its_rest_the_form_has_no_constant_terms(name: str):
    form = lpv(MODELS[name])
    np.testing.assert_allclose(form.x_next0, form.x0, atol=1e-9)
    local = lfrtorch.analysis.linearise(MODELS[name])
    here = form.at(form.scheduling(form.x0, form.u0))
    expected = (local.A, local.B, local.C, local.D)
    for found, matrix in zip(here, expected, strict=True):
        np.testing.assert_allclose(found, matrix, atol=1e-9)


@pytest.mark.parametrize("name", SIGMA)
def test_parameters_stay_within_their_bounds_however_loud_the_input(name: str):
    model = MODELS[name]
    u0 = model.scaler.u_offset
    for schedule in (None, "map"):
        form = lpv(model, schedule=schedule)
        for amplitude in (0.1, 1.0, 30.0):
            u = u0 + amplitude * (inputs(model, 300) - u0)
            p = form.scheduling(model.signals(u).x[0, :-1].numpy(), u)
            assert (p >= form.bounds[:, 0] - 1e-12).all()
            assert (p <= form.bounds[:, 1] + 1e-12).all()


def test_what_cannot_be_scheduled_is_refused():
    with pytest.raises(lfrtorch.InputError, match="give schedule='map'"):
        lpv(MODELS["polynomial"], schedule="neurons")
    with pytest.raises(lfrtorch.InputError, match="give 'neurons' or 'map'"):
        lpv(MODELS["tanh"], schedule="state")
    with pytest.raises(lfrtorch.InputError, match="give \\(samples, 2\\)"):
        lpv(MODELS["tanh"]).simulate(np.zeros((5, 3)))


@pytest.mark.numeric
@pytest.mark.parametrize("name", ["softplus", "polynomial", "sigmoid", "smallest"])
def test_what_is_seen_lies_within_the_corners(name: str):
    model = MODELS[name]
    records = [measure(model, 200, seed=seed) for seed in (1, 2)]
    form = lpv(model, schedule="map")
    corners = form.seen(records)
    for record in records:
        p = form.scheduling(model.signals(record).x[0, :-1].numpy(), record.u)
        # In the frame of the corners about the first one, all p are between 0 and 1.
        edges = corners[[2**i for i in range(int(np.log2(len(corners))))]] - corners[0]
        along = np.linalg.lstsq(edges.T, (p - corners[0]).T, rcond=None)[0]
        assert along.min() > -1e-6
        assert along.max() < 1.0 + 1e-6
        np.testing.assert_allclose(edges.T @ along, (p - corners[0]).T, atol=1e-6 * np.abs(p).max())


def test_a_linear_model_has_one_corner():
    model = MODELS["linear"]
    assert lpv(model).seen(measure(model, 50, seed=1)).shape == (1, 0)
