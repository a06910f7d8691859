"""Steps of a predictor keep what its system holds: to first order, and exactly once put back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from reference import measure, normal, random_cell, random_model
from torch import Tensor
from torch.testing import assert_close

from lfrtorch.data.records import with_past_outputs
from lfrtorch.least_squares.held_steps import HeldSteps, ProjectedSystem, Projection
from lfrtorch.least_squares.linear_systems import CholeskySystem
from lfrtorch.least_squares.problem import Problem
from lfrtorch.model.model import Model

pytestmark = pytest.mark.numeric

MASKS = {
    "A": torch.tensor([[True, False], [True, True]]),
    "Bu": torch.tensor([[True, False], [False, False]]),
    "Bw": torch.tensor([[False], [True]]),
    "Cy": torch.tensor([[False, True]]),
}


@pytest.fixture
def model() -> Model:
    """Two inputs, two states, one output, with a gain; entries of four matrices are held."""
    made = random_model(random_cell(2, 1, 2, 1, 1, 3))
    cell = made.lfr.cell
    cell.hold({name: (mask, cell.get_parameter(name).detach()) for name, mask in MASKS.items()})
    return replace(made, K=0.2 * normal(2, 1, seed=3))


def steps(model: Model) -> tuple[Problem, HeldSteps]:
    predictor = model.predictor()
    problem = Problem.of(predictor, with_past_outputs(measure(model, 40)))
    cell, parameters = predictor.lfr.cell, problem.errors.parameters
    return problem, HeldSteps(cell, parameters, len(problem.theta))


def held(problem: Problem, theta: Tensor) -> Tensor:
    """The entries of the system that are held, from the numbers of the predictor."""
    W = problem.errors.parameters.weights(theta)
    K = W.Bu[:, 2:]
    found = {"A": W.A + K @ W.Cy, "Bu": W.Bu[:, :2] + K @ W.Dyu[:, :2], "Bw": W.Bw + K @ W.Dyw}
    return torch.cat([*(found[name][MASKS[name]] for name in found), W.Cy[MASKS["Cy"]]])


def test_a_projected_direction_moves_nothing_that_is_held(model: Model):
    problem, own = steps(model)
    theta, h = problem.theta + 0.1 * normal(len(problem.theta), seed=1), 1e-6
    theta[own.entries] = problem.theta[own.entries]
    direction = own.projection(theta)(normal(1, len(theta), seed=2))[0]
    slope = (held(problem, theta + h * direction) - held(problem, theta - h * direction)) / (2 * h)
    assert direction.norm() > 0.5
    assert slope.abs().max() < 1e-8
    free = int((~own.entries).sum())
    rank = np.linalg.matrix_rank(own.projection(theta)(torch.eye(len(theta)).double()).numpy())
    tied = sum(int(MASKS[name].sum()) for name in ("A", "Bu", "Bw"))
    assert rank == free - tied


def test_a_point_is_put_back_to_what_is_held(model: Model):
    problem, own = steps(model)
    away = own.projection(problem.theta)(0.3 * normal(1, len(problem.theta), seed=4))[0]
    moved = problem.theta + away
    back = own.admissible(moved)
    assert (held(problem, moved) - held(problem, problem.theta)).abs().max() > 1e-3
    assert_close(held(problem, back), held(problem, problem.theta), rtol=0, atol=1e-12)
    lost = torch.full_like(moved, torch.nan)
    assert own.admissible(lost) is lost


def test_a_projected_system_solves_among_the_directions_that_are_left():
    J, entries = normal(20, 5), torch.tensor([False, True, False, False, False])
    normals = normal(5, 1, seed=1).masked_fill(entries[:, None], 0.0)
    project = Projection(entries, normals)
    G, gradient = J.mT @ J, normal(5, seed=2)
    projected = project(project(G).mT)
    step = ProjectedSystem(CholeskySystem(projected, 3), project).solve(gradient, 0.1)
    basis = torch.linalg.svd(project(torch.eye(5).double())).Vh[:3].mT
    inside = torch.linalg.solve(basis.mT @ G @ basis + 0.1 * torch.eye(3), -basis.mT @ gradient)
    assert_close(step, basis @ inside, rtol=1e-9, atol=1e-12)
    assert Projection(torch.zeros(5, dtype=torch.bool)).held is False
    assert project.held
