"""The one residual over records of different lengths, starts and windows."""

import numpy as np
import pytest
import torch
from reference import measure, random_cell, random_model
from torch.testing import assert_close

from lfrtorch.metrics import rmse
from lfrtorch.model import Model
from lfrtorch.records import Record, Start
from lfrtorch.residual import SimulationError


@pytest.fixture
def model() -> Model:
    return random_model(random_cell(2, 2, 2, 2, 1, 3))


def some_records(model: Model) -> list[Record]:
    """Three groups: (30, zero) twice with other windows, (30, periodic), (20, zero)."""
    noise = np.random.default_rng(0)
    records = []
    groups: list[tuple[int, Start, int]] = [
        (30, "zero", 0), (30, "periodic", 4), (30, "zero", 7), (20, "zero", 1)
    ]  # fmt: skip
    for T, start, skip in groups:
        exact = measure(model, T, seed=len(records), start=start, skip=skip)
        y = exact.y + noise.normal(size=exact.y.shape)
        records.append(Record(exact.u, y, exact.fs, start, skip, name=f"{start} {T} {skip}"))
    return records


def test_residual_is_the_error_of_all_scored_samples(model: Model):
    records = some_records(model)
    problem = SimulationError(model, records)
    r = problem.residual(problem.theta)
    expected = [((model.simulate(x) - x.y) / model.scaler.y_scale)[x.skip :] for x in records]
    assert r.shape == (2 * (30 + 30 + 30 + 20),)
    assert problem.size == 2 * (30 + 26 + 23 + 19)
    # The order of the records is the problem's own, and samples that do not count are zero.
    mine, theirs = np.sort(r[r != 0].numpy()), np.sort(np.concatenate(expected).ravel())
    np.testing.assert_allclose(mine, theirs, rtol=0, atol=1e-9)


def test_rmse_is_that_of_the_metrics(model: Model):
    records = some_records(model)
    for record in records:
        problem = SimulationError(model, record)
        score = problem.rmse(problem.theta)
        assert score == pytest.approx(rmse(record, model.simulate(record)), rel=1e-9)


@pytest.mark.parametrize("ridge", [0.0, 0.5])
def test_gradient_and_jacobian_agree(model: Model, ridge: float):
    problem = SimulationError(model, some_records(model), ridge=ridge)
    theta = problem.theta + 0.1
    r, gradient = problem.gradient(theta)
    J = problem.jacobian(theta)
    assert_close(r, problem.residual(theta), rtol=0, atol=1e-9)
    assert_close(gradient, 2 * J.mT @ r / problem.size, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("ridge", [0.0, 0.5])
def test_jacobian_is_the_slope_of_the_residual(model: Model, ridge: float):
    problem = SimulationError(model, some_records(model), ridge=ridge)
    theta = problem.theta
    step = 1e-4 * torch.randn(len(theta), generator=torch.Generator().manual_seed(0)).double()
    expected = (problem.residual(theta + step) - problem.residual(theta - step)) / 2
    # Truncation |step|³ = 1e-11, and the periodic start is known to 1e-10.
    assert_close(problem.jacobian(theta) @ step, expected, rtol=0, atol=1e-8)


def test_penalty_is_no_part_of_the_score(model: Model):
    records = some_records(model)
    plain, ridged = SimulationError(model, records), SimulationError(model, records, ridge=4.0)
    theta = plain.theta + 0.1
    r, longer = plain.residual(theta), ridged.residual(theta)
    assert_close(longer[: len(r)], r, rtol=0, atol=1e-9)
    assert_close(longer[len(r) :], torch.full_like(theta, 2.0 * 0.1), rtol=1e-12, atol=0)
    assert ridged.rmse(theta) == pytest.approx(plain.rmse(theta), rel=1e-9)


def test_jacobian_is_that_of_its_argument_whatever_the_module_holds(model: Model):
    records = some_records(model)
    theta = SimulationError(model, records).theta
    expected = SimulationError(model, records).jacobian(theta)
    problem, other = SimulationError(model, records), SimulationError(model, records)
    problem.residual(theta)
    other.residual(theta + 0.1)
    assert_close(problem.jacobian(theta), expected, rtol=0, atol=1e-8)


def test_frozen_parameters_are_no_part_of_theta(model: Model):
    model.lfr.cell.A.requires_grad_(False)
    before = model.lfr.cell.A.clone()
    problem = SimulationError(model, some_records(model))
    assert len(problem.theta) == model.parameters - 4
    problem.residual(problem.theta + 0.1)
    assert torch.equal(model.lfr.cell.A, before)
    assert problem.jacobian(problem.theta).shape[1] == model.parameters - 4


def test_divergence_is_a_residual_that_is_not_finite(model: Model):
    problem = SimulationError(model, measure(model, 2000))
    theta = problem.theta
    assert not torch.isfinite(problem.residual(theta + 3.0)).all()
    assert torch.isfinite(problem.residual(theta)).all()


@pytest.mark.parametrize("ridge", [-1.0, float("nan")])
def test_negative_ridge(model: Model, ridge: float):
    with pytest.raises(ValueError, match=r"ridge is .*; give a number of at least 0"):
        SimulationError(model, some_records(model), ridge=ridge)


@pytest.mark.parametrize(
    ("nu", "ny", "fs", "message"),
    [(1, 2, 100.0, "input"), (2, 1, 100.0, "output"), (2, 2, 50.0, "50")],
)
def test_records_that_are_not_the_model_s(model: Model, nu: int, ny: int, fs: float, message: str):
    record = Record(np.ones((20, nu)), np.ones((20, ny)), fs, name="lab")
    with pytest.raises(ValueError, match=f"(?s)lab.*{message}"):
        SimulationError(model, record)
