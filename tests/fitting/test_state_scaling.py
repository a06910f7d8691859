"""A fit leaves states of unit rms over the training data, and their covariance."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from reference import measure, normal, random_cell, random_model, weights

import lfrtorch
from lfrtorch import analysis
from lfrtorch.data.records import Record, with_past_outputs
from lfrtorch.engine.held import integrating_states
from lfrtorch.fitting.state_scaling import scale_states
from lfrtorch.model.model import Model, state_moment

pytestmark = pytest.mark.numeric


def far_off(seed: int = 0, **sizes: Any) -> Model:
    """A random model with a gain K, whose states are small and large."""
    model = random_model(random_cell(1, 2, 3, 1, 1, 4, seed=seed, **sizes), seed=4)
    cell, factor = model.lfr.cell, torch.tensor([1e-3, 1.0, 30.0], dtype=torch.float64)
    with torch.no_grad():
        cell.A.copy_(cell.A * factor[:, None] / factor)
        for into in (cell.Bu, cell.Bw):
            into.mul_(factor[:, None])
        for of in (cell.Cz, cell.Cy):
            of.div_(factor)
    return replace(model, K=0.05 * factor[:, None] * normal(3, 2))


def records(model: Model) -> list[Record]:
    some, late = measure(model, 150), measure(model, 170, seed=1)
    return [some, replace(late[20:], start="estimated")]


FEW = lfrtorch.LevenbergMarquardt(max_iter=2)


@pytest.mark.parametrize("noise", ["output", "innovation"])
@pytest.mark.parametrize("average", [1, 2])
def test_a_fit_leaves_states_of_unit_rms_and_their_covariance(noise: Any, average: int):
    models = [far_off(seed) for seed in range(average)]
    train = records(models[0])[: 3 - average]  # of many states the estimated start is not unique
    result = lfrtorch.fit(models, train, trainer=FEW, noise=noise, average=average, monitors=[])
    assert result.averaged == average
    for model in (result.model, *result.members):
        moment = state_moment(model, train)
        if noise == "innovation":
            moment = state_moment(model.predictor(), list(map(with_past_outputs, train)))
        np.testing.assert_allclose(moment.diagonal(), 1.0, rtol=1e-4)
        np.testing.assert_allclose(model.state_covariance, moment, atol=1e-4)


def test_signals_are_the_same_in_other_states():
    model = far_off()
    record = measure(model, 200)
    predictor = model.predictor()
    scale_states(predictor, with_past_outputs(record))
    found = predictor.innovation_form()
    for now, before in ((found, model), (found.predictor(), model.predictor())):
        data = record if now is found else with_past_outputs(record)
        for name in ("z", "w", "y"):
            signal = getattr(before.signals(data), name)
            torch.testing.assert_close(getattr(now.signals(data), name), signal)


@pytest.mark.parametrize(("name", "value", "scaled"), [("Cz", 0.0, True), ("Bw", 0.7, False)])
def test_states_scale_if_no_held_entry_moves(name: str, value: float, scaled: bool):
    model = far_off()
    model.lfr.cell.hold({name: (torch.tensor(True), torch.tensor(value, dtype=torch.float64))})
    record = measure(model, 200)
    scale_states(model, record)
    assert (model.lfr.cell.get_parameter(name) == value).all()
    rms = np.sqrt(np.diag(model.state_covariance))
    assert (np.abs(rms - 1.0).max() < 1e-9) == scaled
    np.testing.assert_allclose(model.simulate(record), record.y, rtol=1e-9, atol=1e-9)


def test_states_of_unit_rms_keep_their_bits():
    model = far_off()
    record = measure(model, 100)
    scale_states(model, record)
    once = deepcopy(weights(model.lfr.cell))
    scale_states(model, record)
    assert all(torch.equal(once[name], p) for name, p in weights(model.lfr.cell).items())


def test_exact_integrators_stay_exact():
    u = np.random.default_rng(0).standard_normal((300, 1))
    y = np.cumsum(np.cumsum(u, axis=0), axis=0) + np.cumsum(np.tanh(u), axis=0)
    cell = random_cell(1, 1, 3, 1, 1, 2)
    with torch.no_grad():
        cell.Cz[:, 1:] = 0.0
        cell.A[:, 1:] = torch.tensor([[0.0, 0.0], [1.0, 0.0], [3.0, 1.0]])
    model = replace(random_model(cell), outputs=(lfrtorch.Channel("y"),))
    before = cell.A.detach().clone()
    scale_states(model, Record(u, y, fs=model.fs))
    assert cell.A[2, 1] != before[2, 1]
    assert torch.equal(cell.A.diagonal(), before.diagonal())
    assert integrating_states(cell).tolist() == [False, True, True]


def test_a_state_that_never_moves_stays_as_it_is():
    model = far_off()
    with torch.no_grad():
        for into in (model.lfr.cell.A, model.lfr.cell.Bu, model.lfr.cell.Bw):
            into[1] = 0.0
    scale_states(model, measure(model, 50))
    assert np.diag(model.state_covariance) == pytest.approx([1.0, 0.0, 1.0])


def test_a_model_that_diverges_keeps_its_states():
    model = far_off()
    record = measure(model, 2000)
    with torch.no_grad():
        model.lfr.cell.A.mul_(30.0)
    before = deepcopy(weights(model.lfr.cell))
    scale_states(model, record)
    assert all(torch.equal(before[name], p) for name, p in weights(model.lfr.cell).items())
    assert np.array_equal(model.state_covariance, np.eye(3))


def test_given_start_states_keep_their_coordinates():
    model = far_off()
    truth = deepcopy(model)
    u, x0 = measure(model, 100).u, np.array([2e-3, -1.0, 10.0])
    y = model.simulate(u, start="given", x0=x0)
    known: dict[str, Any] = {"inputs": model.inputs, "outputs": model.outputs, "start": "given"}
    record = Record(u, y, model.fs, x0=x0, **known)
    found = lfrtorch.fit(model, record, trainer=FEW, monitors=[]).model
    np.testing.assert_allclose(found.simulate(record), truth.simulate(record), atol=1e-8)
    np.testing.assert_allclose(found.state_covariance, state_moment(truth, record), rtol=1e-6)


def test_frozen_matrices_keep_their_coordinates():
    model, record = far_off(), records(far_off())[0]
    before = model.lfr.cell.Cz.requires_grad_(False).clone()
    lfrtorch.fit(model, record, trainer=FEW, monitors=[])
    assert torch.equal(model.lfr.cell.Cz, before)
    np.testing.assert_allclose(model.state_covariance, state_moment(model, record))


def test_a_contracting_fit_still_contracts():
    truth, start = far_off(), far_off(1, radius=0.5, feedback=0.05)
    train = measure(replace(truth, scaler=start.scaler), 200)
    trainer = replace(FEW, guarantee="contracting", max_iter=4)
    result = lfrtorch.fit(start, train, trainer=trainer, monitors=[])
    assert analysis.contraction(result.model).rate < 1.0
    kept = result.history[result.chosen_iteration]
    again = lfrtorch.fit(result.model, train, trainer=trainer, monitors=[])
    assert again.history[0].train == pytest.approx(kept.train, rel=1e-6)
