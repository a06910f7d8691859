"""Published problems, gauge directions, undefined regions, and the options."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import pytest
import torch
from reference import DenseJacobian, normal
from torch import Tensor
from torch.func import jacrev

from lfrtorch.least_squares.levenberg_marquardt import LevenbergMarquardt, LMState
from lfrtorch.least_squares.residual import LeastSquares

pytestmark = pytest.mark.numeric

BOTH = pytest.mark.parametrize("acceleration", [True, False])


def tensor(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


@dataclass
class Problem(LeastSquares):
    """A residual with its Jacobian by autograd; counts what the search asks for."""

    f: Callable[[Tensor], Tensor]
    residuals: int = 0

    def residual(self, theta: Tensor) -> Tensor:
        self.residuals += 1
        return self.f(theta)

    def jacobian(self, theta: Tensor) -> Tensor:
        return torch.atleast_2d(jacrev(self.f)(theta))

    def linearise(self, theta: Tensor) -> DenseJacobian:
        return DenseJacobian(self.jacobian(theta), torch.atleast_1d(self.f(theta)))

    def cost(self, residual: Tensor) -> float:
        return float(residual.square().sum())


def search(problem: Problem, theta: Tensor, optimiser: LevenbergMarquardt) -> list[LMState]:
    """All states to the end of the search; one that has no end is a failure."""
    states = [optimiser.init(problem, theta)]
    while not states[-1].reason:
        states.append(optimiser.step(problem, states[-1]))
        assert len(states) <= optimiser.max_iter + 1
    return states


# --- the problems of Moré, Garbow and Hillstrom (1981) --------------------------------------

KOWALIK_Y = tensor(
    0.1957, 0.1947, 0.1735, 0.1600, 0.0844, 0.0627, 0.0456, 0.0342, 0.0323, 0.0235, 0.0246
)
KOWALIK_U = tensor(4, 2, 1, 0.5, 0.25, 0.167, 0.125, 0.1, 0.0833, 0.0714, 0.0625)
BARD_Y = tensor(
    0.14, 0.18, 0.22, 0.25, 0.29, 0.32, 0.35, 0.39, 0.37, 0.58, 0.73, 0.96, 1.34, 2.10, 4.39
)


def rosenbrock(x: Tensor) -> Tensor:
    return torch.stack([10 * (x[1] - x[0] ** 2), 1 - x[0]])


def powell_singular(x: Tensor) -> Tensor:
    a, b, c, d = x
    return torch.stack([a + 10 * b, 5**0.5 * (c - d), (b - 2 * c) ** 2, 10**0.5 * (a - d) ** 2])


def kowalik_osborne(x: Tensor) -> Tensor:
    u = KOWALIK_U
    return KOWALIK_Y - x[0] * (u**2 + u * x[1]) / (u**2 + u * x[2] + x[3])


def bard(x: Tensor) -> Tensor:
    u = torch.arange(1, 16, dtype=x.dtype)
    v = 16 - u
    return BARD_Y - (x[0] + u / (v * x[1] + torch.minimum(u, v) * x[2]))


def helical_valley(x: Tensor) -> Tensor:
    angle = torch.atan2(x[1], x[0]) / (2 * torch.pi)
    radius = (x[0] ** 2 + x[1] ** 2).sqrt()
    return torch.stack([10 * (x[2] - 10 * angle), 10 * (radius - 1), x[2]])


def brown_dennis(x: Tensor) -> Tensor:
    t = torch.arange(1, 21, dtype=x.dtype) / 5
    return (x[0] + t * x[1] - t.exp()) ** 2 + (x[2] + x[3] * t.sin() - t.cos()) ** 2


class Published(NamedTuple):
    f: Callable[[Tensor], Tensor]
    start: Tensor
    minimum: float


PUBLISHED = [
    Published(rosenbrock, tensor(-1.2, 1), 0.0),
    Published(powell_singular, tensor(3, -1, 0, 1), 0.0),
    Published(kowalik_osborne, tensor(0.25, 0.39, 0.415, 0.39), 3.07505e-4),
    Published(bard, tensor(1, 1, 1), 8.21487e-3),
    Published(helical_valley, tensor(-1, 0, 0), 0.0),
    Published(brown_dennis, tensor(25, 5, -5, -1), 85822.2),
]


@BOTH
@pytest.mark.parametrize("published", PUBLISHED, ids=lambda p: p.f.__name__)
def test_published_minimum_is_reached_and_the_cost_never_rises(
    published: Published, acceleration: bool
):
    optimiser = LevenbergMarquardt(max_iter=300, acceleration=acceleration)
    states = search(Problem(published.f), published.start, optimiser)
    # The minima are published with six digits.
    assert states[-1].cost == pytest.approx(published.minimum, rel=1e-5, abs=1e-9)
    assert states[-1].reason.startswith("converged")
    for before, after in pairwise(states):
        assert after.cost < before.cost or (after.reason and after.cost == before.cost)
        assert torch.equal(after.residual, published.f(after.theta))
        assert after.cost == float(after.residual.square().sum())
        assert after.iteration == before.iteration + 1


# --- linear problems ------------------------------------------------------------------------


@BOTH
def test_linear_problem_is_solved_in_one_step(acceleration: bool):
    J, b = normal(30, 4), normal(30, seed=1)
    optimiser = LevenbergMarquardt(damping=1e-14, acceleration=acceleration)
    problem = Problem(lambda x: J @ x - b)
    state = optimiser.step(problem, optimiser.init(problem, torch.zeros(4, dtype=J.dtype)))
    expected = torch.linalg.lstsq(J, b).solution
    # Damping 1e-14 s_max² against s_min², κ = 3; the finite difference adds eps / h² = 2e-14.
    torch.testing.assert_close(state.theta, expected, rtol=1e-11, atol=1e-11)
    assert state.gain_ratio == pytest.approx(1.0, abs=1e-9)
    assert (state.rank, state.trials) == (4, 1)


def test_damping_falls_to_a_fifth_where_the_model_is_exact():
    """What is gained is what is predicted, at any damping."""
    J, b = normal(30, 4), normal(30, seed=1)
    problem = Problem(lambda x: J @ x - b)
    optimiser = LevenbergMarquardt(damping=1.0)
    state = optimiser.step(problem, optimiser.init(problem, torch.zeros(4, dtype=J.dtype)))
    assert state.gain_ratio == pytest.approx(1.0, abs=1e-9)
    optimiser = LevenbergMarquardt(damping=1e-3, least_damping=1e-3)
    first = optimiser.step(problem, optimiser.init(problem, torch.zeros(4, dtype=J.dtype)))
    start = 1e-3 * float(torch.linalg.svdvals(J)[0]) ** 2
    assert first.damping == pytest.approx(start / 5)
    assert optimiser.step(problem, first).damping == pytest.approx(start / 25)


# --- the first damping ----------------------------------------------------------------------


@BOTH
def test_first_step_lowers_the_damping_as_long_as_that_pays(acceleration: bool):
    # Singular values 1, 1e-2, 1e-3: a damping of 1e-2 leaves nearly all of the last two.
    J = torch.diag(tensor(1, 1e-2, 1e-3))
    problem = Problem(lambda x: J @ x - tensor(1, 1, 1))
    optimiser = LevenbergMarquardt(acceleration=acceleration)
    start = optimiser.init(problem, tensor(0, 0, 0))
    first = optimiser.step(problem, start)
    # Of each entry (λ / (λ + s²))² is left: the sums gained at 1e-5, 1e-6 and 1e-7 are 2.16, 2.74
    # and 2.99, the last one less than a tenth more.
    assert first.trials == 6
    assert first.damping == pytest.approx(1e-7 / 5)
    second = optimiser.step(problem, first)
    assert (second.trials, second.damping) == (1, pytest.approx(1e-7 / 25))


def test_best_trial_of_the_first_step_is_taken():
    # r = -0.99 and J = 0.2: λ = 1000, 100, 10 and 1 of J² lead to 0.105, 0.149, 0.55 and 2.575.
    problem = Problem(lambda x: x**2 - 1)
    optimiser = LevenbergMarquardt(damping=1e3, acceleration=False)
    first = optimiser.step(problem, optimiser.init(problem, tensor(0.1)))
    assert first.trials == 4
    assert float(first.theta) == pytest.approx(0.55)
    assert first.cost == float(problem.f(first.theta).square())


def test_first_step_that_was_refused_raises_the_damping_only():
    problem = Problem(lambda x: torch.where(x < 2.1, x**3 - 8, torch.full_like(x, torch.nan)))
    states = search(problem, tensor(0.5), LevenbergMarquardt(damping=1e-3, acceleration=False))
    plain = replace(LevenbergMarquardt(damping=1e-3, acceleration=False), least_damping=1e-3)
    assert states[1].trials > 1
    assert torch.equal(states[1].theta, search(problem, tensor(0.5), plain)[1].theta)


@BOTH
def test_gauge_directions_are_left_out(acceleration: bool):
    # Only a b and c + d are seen: one direction of (a, b) and one of (c, d) changes nothing.
    data = normal(20, 2)

    def f(x: Tensor) -> Tensor:
        return data @ torch.stack([x[0] * x[1] - 6, x[2] + x[3] - 1])

    optimiser = LevenbergMarquardt(acceleration=acceleration)
    states = search(Problem(f), tensor(1, 2, 0, 0), optimiser)
    assert states[-1].cost < 1e-20
    assert {state.rank for state in states[1:-1]} == {2}
    difference = states[-1].theta[2] - states[-1].theta[3]
    assert abs(float(difference)) < 1e-12  # no step along the gauge
    assert states[-1].theta.norm() < 10


def test_more_parameters_than_residuals():
    J = normal(3, 6)
    states = search(Problem(lambda x: J @ x - 1), normal(6, seed=1), LevenbergMarquardt())
    assert states[-1].cost < 1e-20
    assert states[1].rank == 3


# --- where the residual is undefined --------------------------------------------------------


@BOTH
@pytest.mark.parametrize("undefined", [float("nan"), float("inf")])
def test_step_into_the_undefined_is_rejected(undefined: float, acceleration: bool):
    def f(x: Tensor) -> Tensor:  # from 0.5 a full step leads to 11, far beyond the edge
        return torch.where(x < 2.1, x**3 - 8, torch.full_like(x, undefined))

    optimiser = LevenbergMarquardt(damping=1e-12, acceleration=acceleration)
    states = search(Problem(f), tensor(0.5), optimiser)
    assert states[1].trials > 1
    assert all(torch.isfinite(state.residual).all() for state in states)
    assert float(states[-1].theta) == pytest.approx(2.0, abs=1e-6)


class Flat(Problem):
    """The same entry all over the Jacobian, whatever the residual."""

    entry = 1.0

    def jacobian(self, theta: Tensor) -> Tensor:
        return torch.full((2, 2), self.entry, dtype=theta.dtype)


@pytest.mark.parametrize(("entry", "trials"), [(1.0, 10), (1e149, 9)])
def test_search_gives_up_after_trials_in_vain(entry: float, trials: int):
    start = tensor(1, 1)
    problem = Flat(lambda x: x if torch.equal(x, start) else x * torch.nan)
    problem.entry = entry
    (_, end) = search(problem, start, LevenbergMarquardt())
    assert end.reason == "converged: no step lowers the cost"
    assert torch.equal(end.theta, start)
    assert end.iteration == 1
    # λ grows by 2, 4, 8, ... from 1e-2: nine times 2^45 = 3.5e13, the next is beyond 1e12. That
    # part of the square of 2e149 is no number.
    assert end.trials == trials


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_start_that_is_not_finite_is_refused(bad: float):
    with pytest.raises(ValueError, match="the residual is not finite at the start"):
        LevenbergMarquardt().init(Problem(lambda x: x * bad), tensor(1, 1))


@pytest.mark.parametrize("entry", [0.0, float("nan"), float("inf"), 1e200])
def test_jacobian_that_vanishes_or_is_not_finite_ends_the_search(entry: float):
    """So does one whose squares are not: no damping is above infinity."""
    problem = Flat(lambda x: x + 1)
    problem.entry = entry
    (_, end) = search(problem, tensor(1, 1), LevenbergMarquardt())
    assert end.reason == "the Jacobian vanishes or is not finite"
    assert torch.equal(end.theta, tensor(1, 1))


# --- options --------------------------------------------------------------------------------


def test_search_ends_after_max_iter():
    for limit in (1, 3):
        states = search(Problem(rosenbrock), tensor(-1.2, 1), LevenbergMarquardt(limit))
        assert states[-1].reason == "maximum number of iterations"
        assert states[-1].iteration == LevenbergMarquardt(limit).limit == limit


def test_search_that_spent_its_iterations_goes_on_if_there_are_more():
    problem, start = Problem(rosenbrock), tensor(-1.2, 1)
    two, three = LevenbergMarquardt(max_iter=2), LevenbergMarquardt(max_iter=3)
    spent = search(problem, start, two)[-1]
    assert two.prolonged(spent) == spent
    assert three.prolonged(spent) == replace(spent, reason="")
    end = three.step(problem, three.prolonged(spent))
    assert torch.equal(end.theta, search(problem, start, three)[-1].theta)
    for reason in ("", "converged: the residual vanishes"):
        other = replace(spent, reason=reason)
        assert three.prolonged(other) == other


def test_step_that_is_taken_back_is_tried_again_with_more_damping():
    problem, optimiser = Problem(rosenbrock), LevenbergMarquardt()
    before = optimiser.init(problem, tensor(-1.2, 1))
    after = optimiser.step(problem, before)
    assert after.damping is not None
    back = optimiser.refused(before, after)
    assert (back.theta is before.theta, back.residual is before.residual) == (True, True)
    assert (back.cost, back.iteration, back.scale) == (before.cost, 1, after.scale)
    assert back.damping == 10 * after.damping
    # From the start λ is the same part of the same Jacobian, and ten times the latest one now.
    again = optimiser.step(problem, back)
    assert (again.theta - before.theta).norm() < (after.theta - before.theta).norm()
    assert again.iteration == 2


def test_patience_begins_anew_with_progress():
    problem, optimiser = Problem(lambda x: x - 1), LevenbergMarquardt(patience=2)
    start = replace(optimiser.init(problem, tensor(5, 7)), quiet=1)
    state = optimiser.step(problem, start)
    assert (state.quiet, state.reason) == (0, "")


def test_patience_counts_steps_without_progress():
    # With the tolerance at 1 no decrease counts as progress.
    optimiser = LevenbergMarquardt(damping=1.0, tolerance=1.0, patience=3)
    states = search(Problem(lambda x: x - 1), tensor(5, 7), optimiser)
    assert [state.quiet for state in states] == [0, 1, 2, 3]
    assert states[-1].reason == "converged: the cost no longer falls"


def test_residual_below_the_floor_counts_as_zero():
    # λ is 1, 1/5 and 1/25 of |J|²: what is left is a half, a sixth of that, a twenty-sixth of that.
    # The second step leaves less than the floor, and the search ends one step later.
    optimiser = LevenbergMarquardt(damping=1.0, least_damping=1.0, floor=0.5)
    states = search(Problem(lambda x: x - 1), tensor(5, 7), optimiser)
    rms = [float(state.residual.square().mean().sqrt()) for state in states]
    assert rms == pytest.approx([26**0.5, 26**0.5 / 2, 26**0.5 / 12, 26**0.5 / 312])
    assert states[-1].reason == "converged: the residual vanishes"


def test_acceleration_costs_one_residual_a_trial():
    for acceleration, evaluations in ((False, 1), (True, 2)):
        problem = Problem(rosenbrock)
        optimiser = LevenbergMarquardt(acceleration=acceleration)
        start = optimiser.init(problem, tensor(-1.2, 1))
        problem.residuals = 0
        state = optimiser.step(problem, start)
        assert problem.residuals == evaluations * state.trials


def test_acceleration_is_the_second_order_correction():
    # r = x² - 4 at 3: J = 6, r'' = 2, so δ = -5/6 and a = -½ r''δ² / J, exact to second order.
    problem = Problem(lambda x: x**2 - 4)
    options = LevenbergMarquardt(damping=1e-15)
    state = options.step(problem, options.init(problem, tensor(3)))
    delta = -5 / 6
    assert float(state.theta) == pytest.approx(3 + delta - 0.5 * 2 * delta**2 / 6, rel=1e-12)
    plain = replace(options, acceleration_limit=0.1)  # 2|a| / |δ| is 0.28: not trusted
    state = plain.step(problem, plain.init(problem, tensor(3)))
    assert float(state.theta) == pytest.approx(3 + delta, rel=1e-12)


def test_step_leaves_its_state_alone():
    problem, optimiser = Problem(rosenbrock), LevenbergMarquardt()
    start = optimiser.init(problem, tensor(-1.2, 1))
    first, again = optimiser.step(problem, start), optimiser.step(problem, start)
    assert torch.equal(first.theta, again.theta)
    assert torch.equal(start.theta, tensor(-1.2, 1))


def test_report_holds_numbers():
    problem, optimiser = Problem(rosenbrock), LevenbergMarquardt()
    start = optimiser.init(problem, tensor(-1.2, 1))
    report = optimiser.step(problem, start).report
    assert start.report == {}
    assert report.keys() == {"damping", "gain_ratio", "trials", "rank"}
    assert all(isinstance(value, float | int) for value in report.values())
