"""Fits over windows of records."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
import torch
from reference import measure, normal, random_cell, random_model
from torch.nn.utils import parameters_to_vector, vector_to_parameters

import lfrtorch
from lfrtorch._support.errors import InputError
from lfrtorch.data.records import Record
from lfrtorch.fitting.settings import Settings
from lfrtorch.fitting.trainer import Fit
from lfrtorch.fitting.windows import windows
from lfrtorch.model.model import Model

numeric = pytest.mark.numeric


@pytest.fixture
def model() -> Model:
    return random_model(random_cell(1, 1, 2, 1, 1, 2))


def counted(T: int, **options) -> Record:
    """A record whose samples say where they stand."""
    return Record(np.arange(T, dtype=float), np.arange(T, dtype=float), **options)


@pytest.mark.parametrize("start", ["zero", "estimated", "periodic"])
@pytest.mark.parametrize(("T", "skip", "horizon"), [(100, 0, 25), (103, 7, 20), (60, 10, 49)])
def test_windows_have_every_scored_sample_and_the_weight_of_the_record(start, T, skip, horizon):
    record = counted(T, start=start, skip=skip, weight=2.0)
    found = windows([record], horizon, nx=2)
    scored = [window.y[window.skip :, 0] for window in found]
    assert all(len(samples) == horizon for samples in scored)
    assert set(np.concatenate(scored)) == set(range(skip, T))
    total = sum(float(window.weight) * horizon for window in found)
    assert total == pytest.approx(2.0 * (T - skip))
    first, *others = found
    assert {window.start for window in others} == {"estimated"}
    assert first.start == ("estimated" if start == "periodic" else start)
    assert first.skip == (0 if start == "periodic" else skip)


@pytest.mark.parametrize("start", ["zero", "estimated", "periodic"])
@pytest.mark.parametrize("skip", [0, 7, 40])
def test_start_states_of_validation_are_fitted_to_samples_before_a_window(start, skip):
    T, horizon = 203, 25  # 20 samples for each state before a window
    record = counted(T, start=start, skip=skip)
    found = windows([record], horizon, nx=1, fitted=False)
    scored = np.concatenate([window.y[window.skip :, 0] for window in found])
    assert set(scored) == set(range(skip, T))
    total = sum(float(window.weight) * horizon for window in found)
    assert total == pytest.approx(T - skip)
    for window in found:
        assert window.samples == window.skip + horizon
        first = window.y[window.skip, 0]
        assert (window.y[:, 0] == np.arange(first - window.skip, first + horizon) % T).all()
        if window.y[0, 0] or start == "periodic":
            assert window.start == "estimated"
            assert window.skip == max(20, skip)
        else:
            assert window.start == start


def test_windows_keep_the_reference():
    record = counted(100, reference=np.arange(100.0))
    for fitted in (True, False):
        for window in windows([record], 20, nx=2, fitted=fitted):
            assert window.reference is not None
            assert np.array_equal(window.reference, window.u)


def test_a_record_that_is_no_longer_than_a_window_stays_as_it_is():
    record = counted(50, start="periodic", skip=10)
    (same,) = windows([record], 40, nx=2)
    assert same is record


def test_a_given_start_and_the_limits_are_kept():
    record = counted(50, start="given", x0=np.ones(2), limits=(None, 40.0))
    first, second = windows([record], 25, nx=2)
    assert first.start == "given"
    assert second.x0 is None
    assert second.limits is not None


@pytest.mark.parametrize(
    ("horizon", "options", "message"),
    [
        (3, {}, "too few samples of 1 output"),
        (20, {"start": "periodic", "line_weight": np.ones(51)}, "line_weight"),
    ],
)
def test_windows_that_cannot_be_say_so(horizon, options, message):
    with pytest.raises(InputError, match=message):
        windows([counted(100, **options)], horizon, nx=2)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"horizon": 1}, "horizon is 1; give a whole number of at least 2."),
        ({"horizon": "all"}, "horizon is 'all'"),
    ],
)
def test_horizons_that_cannot_be_say_so(given, message):
    with pytest.raises(InputError, match=message):
        Settings(nx=2, **given)


def moved(model: Model) -> Model:
    """The model with other weights."""
    found = deepcopy(model)
    weights = parameters_to_vector(found.lfr.parameters()).detach()
    vector_to_parameters(weights + 0.03 * normal(len(weights)), found.lfr.parameters())
    return found


@numeric
def test_a_fit_over_windows_finds_the_system(model: Model):
    train, test = (measure(model, T, seed=T) for T in (400, 300))
    trainer = lfrtorch.LevenbergMarquardt(max_iter=60)
    result = lfrtorch.fit(moved(model), train, trainer=trainer, horizon=20, monitors=[])
    error = lfrtorch.rmse(test, result.model.simulate(test))
    assert error < 1e-4 * lfrtorch.rmse(test, moved(model).simulate(test))


@numeric
def test_validation_in_windows_compares_with_whole_records_and_training_does_not(model: Model):
    record = measure(model, 200, seed=1)
    fit = Fit(moved(model), record, record, horizon=20)
    fit.begin()
    (start,) = fit.history
    whole = lfrtorch.rmse(record, fit.model.simulate(record))
    assert start.train < 0.95 * whole
    assert start.validation == pytest.approx(whole, rel=0.02)


@numeric
def test_poles_of_a_fit_over_windows_stay_within_the_limit_of_whole_records(model: Model):
    trainer = lfrtorch.LevenbergMarquardt(guarantee="stable")
    problem = Fit(model, measure(model, 400), trainer=trainer, horizon=20).problem
    slow = problem.theta
    slow[:4] = torch.diag(slow.new_tensor([0.99, 0.5])).flatten()
    assert torch.equal(problem.admissible(slow), slow)


@numeric
def test_the_job_takes_a_horizon(model: Model):
    train, test = (replace(measure(model, 300, seed=i), name=f"record {i}") for i in (1, 2))
    trainer = lfrtorch.LevenbergMarquardt(max_iter=4)
    settings = Settings(nx=2, nz=1, nn=2, horizon=30, refit=True, first_part=0.5, trainer=trainer)
    dataset = lfrtorch.Dataset("windows", [train], [replace(train[200:], skip=20)], [test])
    run = lfrtorch.identify(dataset, settings, observer=lfrtorch.Observer())
    assert run.settings.horizon == 30
    assert run.refit is not None


@pytest.mark.parametrize("fitted", [True, False])
def test_windows_leave_out_holes_that_are_longer(fitted: bool):
    valid = np.ones((300, 2), dtype=bool)
    valid[100:170, 1] = False
    record = Record(np.arange(300.0), np.ones((300, 2)), start="estimated", valid=valid)
    found = windows([record], 25, nx=1, fitted=fitted)
    assert all(window.scored.any(axis=0).all() for window in found)
    scored = np.concatenate([window.u[window.skip :, 0] for window in found])
    assert {*range(100), *range(200, 300)} <= {*scored}


def test_records_of_which_no_window_has_all_outputs_are_refused():
    y = np.ones((100, 2))
    valid = np.stack([np.arange(100) < 45, np.arange(100) > 55], axis=1)
    with pytest.raises(InputError, match=r"no window of 10 samples .* horizon"):
        windows([Record(np.arange(100.0), y, valid=valid)], 10, nx=1)
