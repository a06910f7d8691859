"""Steps of a search whose start states are eliminated are those of one whose are not."""

from dataclasses import replace

import pytest
import torch
from reference import measure, normal, random_cell, random_model
from torch.testing import assert_close

from lfrtorch.data.records import Record
from lfrtorch.least_squares import jacobian
from lfrtorch.least_squares.levenberg_marquardt import LevenbergMarquardt
from lfrtorch.least_squares.linear_systems import SVDSystem
from lfrtorch.least_squares.problem import Problem
from lfrtorch.least_squares.ridge import Ridge
from lfrtorch.model.model import Model

pytestmark = pytest.mark.numeric

COUNT = 20


@pytest.fixture
def model() -> Model:
    return random_model(random_cell(1, 1, 2, 1, 1, 2))


def many_records(model: Model, *, samples: int = 12) -> list[Record]:
    """Short ones with a free start state, and others."""
    exact = [measure(model, samples, seed=seed, skip=0) for seed in range(COUNT)]
    skips = [3 * (i % 2) if samples > 3 else 0 for i in range(COUNT)]
    free = [
        replace(r, y=r.y + 0.1, start="estimated", skip=skip)
        for r, skip in zip(exact, skips, strict=True)
    ]
    return [*free, measure(model, 30, seed=99, start="periodic", skip=0), exact[0]]


def problem_of(model: Model, *, ridge: Ridge = 0.0, **options: int) -> Problem:
    problem = Problem.of(model, many_records(model, **options), ridge=ridge)
    problem.write(problem.theta + 0.05 * torch.sin(torch.arange(len(problem.theta))))
    return problem


@pytest.mark.parametrize("cached", [True, False])
@pytest.mark.parametrize("damping", [1e-14, 1e-3])
@pytest.mark.parametrize("ridge", [0.0, {"static": 0.1, "A": 0.3, "x0": 2.0}, {"static": 1e4}])
def test_steps_are_those_of_the_whole_system(
    model: Model, ridge: Ridge, damping: float, cached: bool, monkeypatch: pytest.MonkeyPatch
):
    if not cached:
        monkeypatch.setattr(jacobian, "CACHED_BYTES", 0)
    problem = problem_of(model, ridge=ridge)
    theta = problem.theta
    J, r = problem.jacobian(theta), problem.residual(theta)
    mine = problem.linearise(theta)
    system, gradient = mine.system(damping, 1e-13)
    assert_close(gradient, J.mT @ r)
    whole = SVDSystem(J, 1e-13)
    assert 0.5 * whole.scale <= system.scale <= 1.000001 * whole.scale
    for factor in (1.0, 1e3):
        step = system.solve(gradient, factor * damping * whole.scale)
        expected = whole.solve(gradient, factor * damping * whole.scale)
        # Directions that J does not see are gauge: the steps do to the output what they do.
        assert_close(J @ step, J @ expected, rtol=1e-5, atol=1e-8)
        if damping > 1e-9:
            assert_close(step, expected, rtol=1e-5, atol=1e-8)
    direction, e = normal(len(theta)), normal(len(r))
    assert_close(mine.tangent(direction), J @ direction)
    assert_close(mine.adjoint(e), J.mT @ e)


def test_records_of_fewer_samples_than_states_and_long_ones(model: Model, monkeypatch):
    for samples in (1, 40):
        if samples == 40:  # blocks of a record's samples
            monkeypatch.setattr("lfrtorch.engine.sensitivity.BLOCK", 16)
            monkeypatch.setattr(jacobian, "CACHED_BYTES", 0)
        problem = Problem.of(model, many_records(model, samples=samples))
        theta = problem.theta
        J = problem.jacobian(theta)
        system, gradient = problem.linearise(theta).system(1e-3, 1e-13)
        whole = SVDSystem(J, 1e-13)
        step, expected = (s.solve(gradient, 1e-2 * whole.scale) for s in (system, whole))
        assert_close(J @ step, J @ expected, rtol=1e-6, atol=1e-9)


def test_a_search_over_many_records_finds_the_model(model: Model):
    records = [
        replace(r, y=r.y - 0.1) if r.start == "estimated" else r for r in many_records(model)
    ]
    problem = Problem.of(model, records)
    assert len(problem.theta) > 2 * COUNT
    search = LevenbergMarquardt(max_iter=60)
    state = search.init(problem, problem.theta + 0.02 * normal(len(problem.theta)))
    first = state.cost
    while not state.reason:
        state = search.step(problem, state)
    assert state.cost < 1e-16 * first
