"""Adam is torch's, in steps."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from lfrtorch.least_squares.adam import Adam, Differentiable
from lfrtorch.least_squares.residual import Point

pytestmark = pytest.mark.numeric


class Quadratic(Differentiable):
    """r = (x - 1, 10 (y - 2))."""

    def gradient(self, theta: Tensor, near: Point | None = None) -> tuple[Point, Tensor]:
        weight = theta.new_tensor([1.0, 10.0])
        r = weight * (theta - theta.new_tensor([1.0, 2.0]))
        return Point(theta, r, float(r @ r)), weight * r  # of the mean square: 2/2 weight r


ZERO = torch.zeros(2, dtype=torch.float64)


def test_steps_are_those_of_torch():
    adam, problem = Adam(max_iter=20, learning_rate=0.1), Quadratic()
    state = adam.init(problem, ZERO)
    parameter = torch.nn.Parameter(ZERO.clone())
    theirs = torch.optim.Adam([parameter], lr=0.1)
    while not state.reason:
        state = adam.step(problem, state)
        parameter.grad = problem.gradient(parameter.detach())[1]
        theirs.step()
        assert torch.equal(state.theta, parameter)
        assert torch.equal(state.residual, problem.gradient(parameter.detach())[0].residual)
    assert (state.iteration, state.reason) == (20, "maximum number of epochs")


def test_minimum_is_reached():
    adam, problem = Adam(max_iter=500, learning_rate=0.05), Quadratic()
    state = adam.init(problem, ZERO)
    while not state.reason:
        state = adam.step(problem, state)
    assert state.residual.abs().max() < 1e-2  # within some steps of the learning rate's decay


def test_step_leaves_its_state_alone():
    adam, problem = Adam(), Quadratic()
    start = adam.step(problem, adam.init(problem, ZERO))
    first = adam.step(problem, adam.step(problem, start))
    again = adam.step(problem, adam.step(problem, start))
    assert torch.equal(first.theta, again.theta)


def test_search_that_spent_its_epochs_goes_on_if_there_are_more():
    problem, two, three = Quadratic(), Adam(max_iter=2), Adam(max_iter=3)
    state = two.init(problem, ZERO)
    for reason in ("", "maximum number of epochs"):
        state = two.step(problem, state)
        assert state.reason == reason
    assert two.prolonged(state).reason == state.reason
    longer = three.prolonged(state)
    assert longer.reason == ""
    end = three.step(problem, longer)
    assert (end.iteration, end.reason) == (3, "maximum number of epochs")
    diverged = replace(state, reason="diverged: lower the learning rate")
    assert three.prolonged(diverged).reason == diverged.reason


def test_step_that_might_be_taken_back_is_not():
    adam, problem = Adam(), Quadratic()
    before = adam.init(problem, ZERO)
    after = adam.step(problem, before)
    assert adam.refused(before, after) is after


def test_report_is_the_norm_of_the_gradient():
    state = Adam().init(Quadratic(), ZERO)
    assert state.report == {"gradient_norm": pytest.approx((1.0 + 200.0**2) ** 0.5)}


def test_divergence_is_a_reason():
    class Broken(Quadratic):
        def gradient(self, theta: Tensor, near: Point | None = None) -> tuple[Point, Tensor]:
            point, gradient = super().gradient(theta)
            return point, gradient if not theta.any() else gradient * torch.nan

    adam = Adam()
    state = adam.step(Broken(), adam.init(Broken(), ZERO))
    assert state.reason == "diverged: lower the learning rate"
