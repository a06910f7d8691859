"""Several models at once are what each of them is alone."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from reference import measure, normal, random_cell, random_model
from torch import Tensor, nn
from torch.testing import assert_close

from lfrtorch.engine.lfr import LFR
from lfrtorch.engine.nonlinearity import Polynomial
from lfrtorch.least_squares.joint import JointProblem, stacked
from lfrtorch.least_squares.levenberg_marquardt import LevenbergMarquardt
from lfrtorch.least_squares.problem import Problem
from lfrtorch.model import Model
from lfrtorch.records import Record, Start


class Bend(nn.Module):
    """A user's map with parameters of two shapes."""

    def __init__(self) -> None:
        super().__init__()
        self.gain, self.W = nn.Parameter(torch.tensor(0.7)), nn.Parameter(torch.ones(1, 2))

    def forward(self, z: Tensor) -> Tensor:
        return self.gain * torch.sin(z @ self.W.mT)


pytestmark = pytest.mark.numeric

STATICS = {
    "network": lambda: None,
    "polynomial": lambda: Polynomial(2, 1, 2),
    "own": Bend,
}
KINDS = pytest.mark.parametrize("kind", sorted(STATICS))


def some_models(kind: str, count: int = 3) -> list[Model]:
    feedback = 0.1 if kind == "network" else 0.01
    cells = [
        random_cell(2, 2, 2, 2, 1, 3, seed=s, radius=0.6, feedback=feedback, static=STATICS[kind]())
        for s in range(count)
    ]
    return [random_model(cell) for cell in cells]


def some_records(model: Model) -> list[Record]:
    noise = np.random.default_rng(0)

    def noisy(record: Record) -> Record:
        return replace(record, y=record.y + 0.1 * noise.normal(size=record.y.shape))

    first, second = noisy(measure(model, 40)), noisy(measure(model, 30, seed=1, start="periodic"))
    lines = np.linspace(0.5, 2.0, 16)
    return [
        replace(first, weight=[0.5, 2.0]),
        replace(first, skip=3),
        second,
        replace(second, line_weight=lines),
        replace(noisy(measure(model, 25, seed=2)), start="estimated"),
        replace(first, start="given", x0=[0.3, -0.2]),
    ]


def problems(kind: str) -> list[Problem]:
    models = some_models(kind)
    return [Problem.of(model, some_records(models[0]), ridge=0.1) for model in models]


@KINDS
@pytest.mark.parametrize("start", ["zero", "periodic"])
def test_output_of_stacked_cells(kind: str, start: Start):
    cells = [model.lfr.cell for model in some_models(kind)]
    u, x0 = normal(6, 20, 2), normal(6, 2, seed=1)
    together = LFR(stacked(cells, repeat=2)).trajectory(u, x0, start)
    for s, cell in enumerate(cells):
        pair = slice(2 * s, 2 * s + 2)
        alone = LFR(cell).trajectory(u[pair], x0[pair], start)
        for mine, theirs in zip(together, alone, strict=True):
            assert_close(mine[pair], theirs, rtol=0, atol=1e-9)


@KINDS
def test_residuals_and_systems_are_those_of_each_alone(kind: str):
    stack, alone = JointProblem(problems(kind)), problems(kind)
    which = [0, 2]
    thetas = [alone[i].theta + 0.05 for i in which]
    residuals = stack.residuals(which, thetas)
    jacobians = stack.linearise(which, thetas)
    for i, theta, r, jacobian in zip(which, thetas, residuals, jacobians, strict=True):
        assert_close(r, alone[i].residual(theta), rtol=0, atol=1e-8)
        J = alone[i].jacobian(theta)
        for damping in (1e-2, 1e-15):  # normal equations, and QR
            system, gradient = jacobian.system(damping, 1e-12)
            scale = float(torch.linalg.svdvals(J)[0]) ** 2
            assert system.scale == pytest.approx(scale, rel=1e-6)
            assert_close(gradient, J.mT @ r, rtol=0, atol=1e-7 * scale)
        assert_close(jacobian.tangent(theta), J @ theta, rtol=0, atol=1e-6)
        assert_close(jacobian.adjoint(r), J.mT @ r, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    "kind", ["network", *(pytest.param(k, marks=pytest.mark.slow) for k in ("own", "polynomial"))]
)
def test_searches_in_step_are_searches_one_by_one(kind: str):
    """Five steps, in which the searches need different numbers of trials."""
    optimiser = LevenbergMarquardt(max_iter=5)
    stack, alone = JointProblem(problems(kind)), problems(kind)
    states = [optimiser.init(p, p.theta) for p in stack.problems]
    expected = [optimiser.init(p, p.theta) for p in alone]
    for _ in range(6):
        states = optimiser.steps(stack, states)
        expected = [
            state if state.reason else optimiser.step(problem, state)
            for problem, state in zip(alone, expected, strict=True)
        ]
    for state, wanted in zip(states, expected, strict=True):
        assert (state.iteration, state.reason) == (5, "maximum number of iterations")
        assert state.trials == wanted.trials
        assert state.cost == pytest.approx(wanted.cost, rel=1e-6)
        assert_close(state.theta, wanted.theta, rtol=0, atol=1e-4)


def test_frozen_parameters_stay_frozen():
    models = some_models("network")
    for model in models:
        model.lfr.cell.A.requires_grad_(False)
    records = some_records(models[0])[:3]
    stack = JointProblem([Problem.of(model, records) for model in models])
    thetas = [problem.theta for problem in stack.problems]
    stack.residuals([0, 1, 2], thetas)
    for problem, jacobian in zip(stack.problems, stack.linearise([0, 1, 2], thetas), strict=True):
        gradient = jacobian.system(1e-2, 1e-12)[1]
        assert len(gradient) == len(problem.theta) == models[0].parameter_count - 4


def test_problems_that_are_no_stack():
    models = some_models("network", 2)
    records = some_records(models[0])
    one = Problem.of(models[0], records)
    with pytest.raises(ValueError, match="two problems share one model"):
        JointProblem([one, Problem.of(models[0], records)])
    with pytest.raises(ValueError, match="differ in records, scaling or free parameters"):
        JointProblem([one, Problem.of(models[1], records[:2])])


@pytest.mark.parametrize("signal", ["u", "y"])
def test_problems_of_other_signals_are_no_stack(signal: str):
    """In the second group of the last problem."""
    models = some_models("network")
    records = some_records(models[0])[1:4:2]
    other = replace(records[1], **{signal: getattr(records[1], signal) + 1e-3})
    same = [Problem.of(model, records) for model in models[:2]]
    JointProblem(same)
    with pytest.raises(ValueError, match="differ in records, scaling or free parameters"):
        JointProblem([*same, Problem.of(models[2], [records[0], other])])


def test_problems_of_other_free_parameters_are_no_stack():
    models = some_models("network", 2)
    models[1].lfr.cell.A.requires_grad_(False)
    records = some_records(models[0])
    with pytest.raises(ValueError, match="differ in records, scaling or free parameters"):
        JointProblem([Problem.of(model, records) for model in models])


def test_start_states_that_are_solved_for():
    models = some_models("network", 2)
    records = [record for record in some_records(models[0]) if record.start == "estimated"]
    stack = JointProblem([Problem.judge(m, records) for m in models])
    alone = [Problem.judge(m, records) for m in some_models("network", 2)]
    thetas = [problem.theta for problem in alone]
    for mine, problem, theta in zip(stack.residuals([0, 1], thetas), alone, thetas, strict=True):
        assert_close(mine, problem.residual(theta), rtol=0, atol=1e-10)
