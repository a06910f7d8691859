"""The engine in torch alone, as it runs on a GPU, against the compiled kernels; both dtypes."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from reference import measure, random_cell, random_model
from torch.testing import assert_close

from lfrtorch.least_squares.levenberg_marquardt import LevenbergMarquardt, LMState
from lfrtorch.least_squares.problem import Problem
from lfrtorch.maps.activations import ACTIVATIONS
from lfrtorch.model.model import Model

pytestmark = [pytest.mark.numeric, pytest.mark.usefixtures("fast")]

DEVICES = ["torch", *(["cuda"] if torch.cuda.is_available() else [])]


def some_model(activation: str = "tanh", dtype: torch.dtype = torch.float64) -> Model:
    cell = random_cell(2, 1, 3, 2, 1, 4, radius=0.7, activation=activation, dtype=dtype)
    return random_model(cell)


def some_problem(model: Model, made_by: Model | None = None) -> Problem:
    made_by, noise = made_by or model, np.random.default_rng(0)
    records = [
        replace(measure(made_by, 60), start="zero", skip=2),
        measure(made_by, 50, seed=1, start="periodic"),
        replace(measure(made_by, 40, seed=2), start="estimated"),
    ]
    noisy = [replace(r, y=r.y + 0.1 * noise.normal(size=r.y.shape)) for r in records]
    return Problem.of(model, noisy, ridge=0.1)


def searched(problem: Problem, steps: int = 4) -> LMState:
    optimiser = LevenbergMarquardt()
    state = optimiser.init(problem, problem.theta)
    for _ in range(steps):
        state = optimiser.step(problem, state)
    return state


@pytest.fixture(params=DEVICES)
def device(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Devices without kernels: the CPU with kernels turned off, and a GPU if there is one."""
    if request.param == "cuda":
        return "cuda"
    monkeypatch.setattr("lfrtorch._support.threads.COMPILED_ON", set())
    return "cpu"


@pytest.mark.parametrize("activation", sorted(ACTIVATIONS))
def test_search_without_kernels_is_the_one_with_them(activation: str, device: str, monkeypatch):
    model = some_model(activation)
    with monkeypatch.context() as patch:
        patch.setattr("lfrtorch._support.threads.COMPILED_ON", {"cpu"})
        expected = searched(some_problem(some_model(activation)))
    model.lfr.to(device)
    problem = some_problem(model)
    state = searched(problem)
    assert state.cost == pytest.approx(expected.cost, rel=1e-9)
    assert_close(state.theta.cpu(), expected.theta, rtol=0, atol=1e-6)
    point, gradient = problem.gradient(state.theta)
    r, J = point.residual, problem.jacobian(state.theta)
    assert_close(gradient, 2 * J.mT @ r / problem.size, rtol=0, atol=1e-8)
    y = model.simulate(measure(model, 30))
    assert isinstance(y, np.ndarray)


@pytest.mark.parametrize("kernels", [True, False])
def test_single_precision(kernels: bool, monkeypatch):
    if not kernels:
        monkeypatch.setattr("lfrtorch._support.threads.COMPILED_ON", set())
    double, single = some_problem(some_model()), some_problem(some_model(dtype=torch.float32))
    expected, state = searched(double), searched(single)
    # Compiled loops compute in double precision, whatever the model is in.
    own = torch.float64 if kernels else torch.float32
    assert state.theta.dtype == state.residual.dtype == own
    # eps 1.2e-7 in residuals of order one, a factor of some hundred from the model's time constant
    assert state.cost == pytest.approx(expected.cost, rel=1e-3)
    assert single.rmse(state.theta) == pytest.approx(double.rmse(expected.theta), rel=1e-3)
