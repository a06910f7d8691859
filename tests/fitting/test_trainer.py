"""The one training loop: what it keeps, when it stops, and a planted model found again."""

import math
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import torch
from reference import (
    DenseJacobian,
    measure,
    move,
    planted,
    random_cell,
    random_model,
    theta,
    unscaled,
)
from torch import Tensor
from torch.nn.utils import vector_to_parameters

from lfrtorch._support.reasons import Reason
from lfrtorch.data.metrics import nrmse, rmse
from lfrtorch.data.records import Record
from lfrtorch.distributed import ProcessLostError, Ranks
from lfrtorch.fitting.multistart import fit
from lfrtorch.fitting.trainer import EXPLOSION, Fit, Progress
from lfrtorch.least_squares.adam import Adam
from lfrtorch.least_squares.levenberg_marquardt import LevenbergMarquardt
from lfrtorch.least_squares.problem import Problem
from lfrtorch.least_squares.residual import LeastSquares, Point
from lfrtorch.model.loading import load
from lfrtorch.model.model import Model

pytestmark = pytest.mark.numeric

STEP = 1 / 128
"""Exact in the first parameter of models on a grid: sums of them are the same in any order."""


class Sine(torch.nn.Linear):
    """w = sin(W z + b), a user's own map."""

    def forward(self, input: Tensor) -> Tensor:
        return torch.sin(super().forward(input))


def on_a_grid(model: Model) -> Tensor:
    """The weights, the first of them rounded to whole steps."""
    A = model.lfr.cell.A.data
    A[0, 0] = torch.round(A[0, 0] / STEP) * STEP
    return theta(model)


@dataclass(frozen=True)
class Walk:
    """An optimiser that walks down and up: offsets of the first parameter, one an iteration."""

    offsets: tuple[float, ...]
    reason: str = ""

    @dataclass(frozen=True)
    class State:
        theta: Tensor
        point: Point
        iteration: int = 0
        reason: str = ""
        report: Any = None

    @property
    def limit(self) -> int:
        return len(self.offsets)

    def init(self, problem: Any, theta: Tensor, point: Point | None = None) -> State:
        return self.State(theta, problem.evaluate(theta), report={})

    def step(self, problem: Any, state: State) -> State:
        theta = state.theta.clone()
        theta[0] += self.offsets[state.iteration]
        last = state.iteration + 1 == self.limit
        return replace(
            state,
            theta=theta,
            point=problem.evaluate(theta),
            iteration=state.iteration + 1,
            reason=self.reason if last else "",
        )

    @property
    def guarantee(self) -> Any:
        return "stable"

    def prolonged(self, state: State) -> State:
        return state

    def refused(self, before: State, after: State) -> State:
        return replace(before, iteration=after.iteration, reason=after.reason)


class Quadratic(LeastSquares):
    """r = (10 θ1, θ2)."""

    def residual(self, theta: Tensor) -> Tensor:
        return theta * theta.new_tensor([10.0, 1.0])

    def linearise(self, theta: Tensor) -> DenseJacobian:
        return DenseJacobian(torch.diag(theta.new_tensor([10.0, 1.0])), self.residual(theta))

    def cost(self, residual: Tensor) -> float:
        return float(residual @ residual)


# --- planted models -------------------------------------------------------------------------


@pytest.mark.parametrize("sizes", [(1, 1, 2, 1, 1, 2), (2, 2, 2, 1, 2, 3)])
def test_planted_model_is_found_again(sizes: tuple[int, ...]):
    names = ("nu", "ny", "nx", "nz", "nw", "nn")
    model, train, test = planted(**dict(zip(names, sizes, strict=True)))
    before = nrmse(test, model.simulate(test))
    result = fit(model, train, trainer=LevenbergMarquardt(max_iter=60))
    assert before > 1e-2
    # The Gauss-Newton steps converge quadratically; the periodic start is known to 1e-10.
    assert nrmse(test, model.simulate(test)) < 1e-8
    assert result.reason.startswith("converged")


def test_planted_model_is_found_again_with_a_frozen_matrix():
    model, train, test = planted()
    model.lfr.cell.Cz.requires_grad_(False)
    fixed = model.lfr.cell.Cz.clone()
    fit(model, train, trainer=LevenbergMarquardt(max_iter=60))
    assert torch.equal(model.lfr.cell.Cz, fixed)
    assert nrmse(test, model.simulate(test)) < 1e-8


def test_planted_model_is_found_again_with_an_own_module():
    truth, model = (random_model(random_cell(static=Sine(1, 1))) for _ in range(2))
    train, test = measure(truth, 100), measure(truth, 100, seed=2)
    move(model, 0.05)
    fit(model, train, trainer=LevenbergMarquardt(max_iter=60))
    assert nrmse(test, model.simulate(test)) < 1e-8


def test_single_precision_is_fitted_to_its_rounding():
    _, train, test = planted()
    model = random_model(random_cell(radius=0.7, dtype=torch.float32))
    move(model, 0.05)
    result = fit(model, train, trainer=LevenbergMarquardt(max_iter=60))
    assert model.lfr.cell.A.dtype == torch.float32
    assert result.reason.startswith("converged")
    assert nrmse(test, model.simulate(test)) < 1e-4  # some hundred eps of 1.2e-7


def test_adam_lowers_the_cost_in_the_same_loop():
    model, train, _ = planted(T=100)
    result = fit(model, train, trainer=Adam(max_iter=150, learning_rate=3e-3))
    assert result.history[-1].train < 0.5 * result.history[0].train
    assert result.reason == "maximum number of epochs"
    assert result.iterations == 150
    assert result.history[-1].report["gradient_norm"] > 0


# --- what is kept ---------------------------------------------------------------------------


def test_iterate_that_is_best_on_validation_is_kept():
    model, train, _ = planted()
    start = on_a_grid(model)
    truth = random_model(random_cell(radius=0.7))
    vector_to_parameters(start, truth.lfr.parameters())
    truth.lfr.cell.A.data[0, 0] += 2 * STEP  # the validation record is that of the second iterate
    validation = measure(truth, 100, seed=5)
    result = fit(model, train, validation, trainer=Walk((STEP, STEP, STEP, STEP)))
    assert result.chosen_iteration == 2
    assert [p.best for p in result.history] == [True, True, True, False, False]
    assert torch.equal(unscaled(model), unscaled(truth))
    assert result.history[2].validation == pytest.approx(0, abs=1e-12)
    assert result.history[1].validation == pytest.approx(result.history[3].validation, rel=0.2)
    assert result.model is model


def test_iterate_that_is_best_on_training_is_kept_without_validation():
    model, train, _ = planted()
    on_a_grid(model)
    start = unscaled(model)
    train = [measure(model, 100)]
    result = fit(model, train, trainer=Walk((STEP, -STEP, 2 * STEP)))
    assert result.chosen_iteration == 0  # the same error at iteration 2 is no better
    assert torch.equal(unscaled(model), start)
    assert math.isnan(result.history[0].validation)
    assert [p.best for p in result.history] == [True, False, False, False]


def test_iterate_that_diverges_on_validation_is_not_kept():
    model, train, _ = planted()
    start = unscaled(model)
    long = measure(model, 3000, seed=5)
    validation = Record(long.u, long.y + 0.1, long.fs)
    result = fit(model, train[0][:5], validation, trainer=Walk((3.0, 0.0)))  # a pole beyond 3
    assert not math.isfinite(result.history[1].validation)
    assert math.isfinite(result.history[1].train)
    assert result.chosen_iteration == 0
    assert torch.equal(unscaled(model), start)


def test_a_step_to_a_model_that_explodes_on_validation_is_taken_back():
    model, train, _ = planted()
    long = measure(model, 3000, seed=5)
    validation = Record(long.u, long.y + 0.1, long.fs)
    seen: list[Tensor] = []
    walk = Walk((0.01, 3.0, 0.02))
    watching: Any = [lambda m, _: seen.append(theta(m))]
    fit(model, train[0][:5], validation, trainer=walk, monitors=watching)
    moved = [float(each[0] - seen[0][0]) for each in seen]
    assert moved == pytest.approx([0, 0.01, 3.01, 0.03])


def test_a_step_that_is_still_better_than_the_start_is_kept():
    """However much worse than the last one, which may be as good as exact."""
    model, train, _ = planted(T=100)
    truth = random_model(random_cell(radius=0.7))
    vector_to_parameters(on_a_grid(model), truth.lfr.parameters())
    truth.lfr.cell.A.data[0, 0] += 2 * STEP
    seen: list[Tensor] = []
    # To the true model, to half the start's distance from it, back, to three times that, and on.
    walk = Walk((2 * STEP, STEP, -STEP, 3 * STEP, STEP))
    validation, watch = measure(truth, 100, seed=5), lambda m, _: seen.append(theta(m))
    result = fit(model, train, validation, trainer=walk, monitors=[watch])
    assert [float(each[0] - seen[0][0]) / STEP for each in seen] == [0, 2, 3, 2, 5, 3]
    scores = [p.score for p in result.history]
    assert EXPLOSION * scores[1] < scores[2] < scores[0] < scores[4]


def test_a_search_that_goes_back_treads_softly():
    problem, lm = Quadratic(), LevenbergMarquardt(least_damping=1e-2)
    before = lm.init(problem, torch.ones(2, dtype=torch.float64))
    after = lm.step(problem, before)
    back = lm.refused(before, after)
    again = lm.step(problem, back)
    assert torch.equal(back.theta, before.theta)
    assert again.iteration == 2
    # λ is 1 (0.01 of the largest squared singular value), 0.2 after the good step, then 2; the
    # second parameter goes 1 / (1 + λ) of the way.
    assert float(1 - after.theta[1]) == pytest.approx(1 / 2)
    assert float(1 - again.theta[1]) == pytest.approx(1 / 3)


def test_errors_are_in_physical_units():
    model, train, test = planted()
    result = fit(model, train[0], test, trainer=LevenbergMarquardt(max_iter=2))
    chosen = result.history[result.chosen_iteration]
    assert chosen.train == pytest.approx(rmse(train[0], model.simulate(train[0])), rel=1e-9)
    assert chosen.validation == pytest.approx(rmse(test, model.simulate(test)), rel=1e-9)


def test_fitted_model_is_saved_and_loaded(tmp_path):
    model, train, test = planted(T=50)
    fit(model, train, trainer=LevenbergMarquardt(max_iter=2))
    back = load(model.save(tmp_path / "model"))
    assert np.array_equal(back.simulate(test), model.simulate(test))


# --- when it stops --------------------------------------------------------------------------


def test_no_iterations():
    model, train, test = planted(T=50)
    start = unscaled(model)
    for optimiser in (LevenbergMarquardt(max_iter=0), Adam(max_iter=0)):
        result = fit(model, train, test, trainer=optimiser)
        assert (result.iterations, result.chosen_iteration, len(result.history)) == (0, 0, 1)
        assert result.reason == "no iterations asked for"
        assert result.seconds_per_iteration == 0
        assert torch.equal(unscaled(model), start)


def test_reason_of_the_optimiser_ends_the_fit():
    model, train, _ = planted(T=50)
    result = fit(model, train, trainer=LevenbergMarquardt(max_iter=2))
    assert (result.reason, result.iterations) == ("maximum number of iterations", 2)
    assert fit(model, train, trainer=Walk((0.01,) * 3, "tired")).reason == "tired"


def test_ctrl_c_keeps_the_best():
    model, train, _ = planted()
    seen: list[tuple[Tensor, float]] = []

    def interrupt(model: Model, progress: Progress):
        seen.append((unscaled(model), progress.train))
        if progress.iteration == 3:
            raise KeyboardInterrupt

    result = fit(model, train, trainer=Walk((0.01, -0.02, 0.05, 0.0)), monitors=[interrupt])
    assert result.reason == Reason.INTERRUPTED == "interrupted"
    assert result.iterations == 3
    best = min(range(4), key=lambda i: seen[i][1])
    assert result.chosen_iteration == best < 3
    assert torch.equal(unscaled(model), seen[best][0])


def test_ctrl_c_amid_a_trial_keeps_the_best():
    class Interrupted(LevenbergMarquardt):
        def step(self, problem, state):
            if state.iteration == 2:
                problem.residual(state.theta + 1.0)  # a trial is in the weights
                raise KeyboardInterrupt
            return super().step(problem, state)

    model, train, test = planted()
    result = fit(model, train, trainer=Interrupted())
    assert (result.reason, result.chosen_iteration) == (Reason.INTERRUPTED, 2)
    assert rmse(train[0], model.simulate(train[0])) < result.history[0].train
    assert np.isfinite(model.simulate(test)).all()


class Lonely(Ranks):
    """The first of two, which loses the other at some sum."""

    world = 2

    def __init__(self, sums: int):
        self.sums = sums

    def sum(self, part: Tensor) -> Tensor:
        self.sums -= 1
        if self.sums < 0:
            raise ProcessLostError("all of them")
        return part


def test_a_lost_process_keeps_the_best():
    model, train, _ = planted()
    result = fit(model, train, ranks=Lonely(20))
    assert (result.reason, result.detail) == (Reason.PROCESS_LOST, "all of them")
    assert result.outcome == "a process was lost: all of them"
    chosen = result.history[result.chosen_iteration]
    assert chosen.train < result.history[0].train
    error = Problem.of(model, train[::2])
    # The periodic state is known to 1e-10.
    of_all = Problem.of(model, train).size  # as if the other had no error
    own = error.rmse(error.theta) * (error.size / of_all) ** 0.5
    assert own == pytest.approx(chosen.train, rel=1e-9, abs=1e-9)


def test_a_process_lost_before_the_first_iterate_is_an_error():
    model, train, _ = planted(T=50)
    start = theta(model)
    with pytest.raises(ProcessLostError, match="all of them"):
        fit(model, train, ranks=Lonely(2))
    assert torch.equal(theta(model), start)


def test_start_that_diverges_is_refused():
    model, train, _ = planted(T=2000)
    with torch.no_grad():
        model.lfr.cell.A.mul_(5.0)
    start = theta(model)
    for optimiser in (LevenbergMarquardt(), Adam()):
        with pytest.raises(ValueError, match=r"diverges on the training records before.*linear"):
            fit(model, train, trainer=optimiser)
        with pytest.raises(ValueError, match="all models diverge"):
            fit([model, deepcopy(model)], train, trainer=optimiser)
        assert torch.equal(theta(model), start)


# --- monitors -------------------------------------------------------------------------------


def test_monitors_see_every_iteration_with_its_weights():
    model, train, test = planted(T=100)
    calls: list[tuple[int, float, float]] = []

    def watch(model: Model, progress: Progress):
        calls.append((progress.iteration, progress.validation, rmse(test, model.simulate(test))))

    result = fit(model, train, test, trainer=LevenbergMarquardt(4), monitors=[watch, watch])
    assert [call[0] for call in calls] == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4]
    for _, told, seen in calls:
        assert seen == pytest.approx(told, rel=1e-9)
    assert [p.iteration for p in result.history] == [0, 1, 2, 3, 4]
    assert {p.limit for p in result.history} == {4}
    assert result.history[4].seconds_left == 0
    assert 0 < result.seconds_per_iteration < result.seconds


def test_seconds_are_those_of_steps_and_their_judgement(monkeypatch):
    """Not of the monitors: 4 s for the start, 8 s a step, 2 s to judge each, 100 s to show it."""
    now = [1000.0]

    def passes(seconds: float):
        now[0] += seconds

    @dataclass(frozen=True)
    class Slow(Walk):
        def init(self, problem, theta, point=None):
            passes(4.0)
            return super().init(problem, theta, point)

        def step(self, problem, state):
            passes(8.0)
            return super().step(problem, state)

    monkeypatch.setattr("time.perf_counter", lambda: now[0])
    begun = Fit(*planted(T=20)[:2], trainer=Slow((STEP, STEP)))
    judged = begun.problem.rmse_at
    monkeypatch.setattr(begun.problem, "rmse_at", lambda point: (passes(2.0), judged(point))[1])
    result = begun.advance(monitors=[lambda *_: passes(100.0)]).result()
    assert [p.seconds for p in result.history] == [6.0, 16.0, 26.0]
    assert (result.seconds, result.seconds_per_iteration) == (26.0, 8.0)


def test_time_left_is_that_of_the_iterations_so_far():
    progress = Progress(2, 6, 1.0, 1.0, 3.0, True, {}, 1.0)
    assert progress.seconds_left == 6.0
    assert replace(progress, iteration=0).seconds_left == 18.0


def test_usual_duration_is_the_median_without_the_first():
    begun = Fit(*planted(T=20)[:2], trainer=LevenbergMarquardt(max_iter=1)).advance()
    for durations, usual in (((9.0, 1.0, 4.0, 2.0), 2.0), ((9.0,), 9.0)):
        assert begun.at is not None
        begun.at = replace(begun.at, durations=durations)
        assert begun.result().seconds_per_iteration == usual


def test_monitors_never_see_a_trial():
    class Wandering(LevenbergMarquardt):
        def step(self, problem, state):
            state = super().step(problem, state)
            problem.residual(state.theta + 1.0)
            return state

    def watch(model: Model, progress: Progress):
        assert rmse(train[0], model.simulate(train[0])) == pytest.approx(progress.train, rel=1e-9)

    model, train, _ = planted(T=100)
    assert fit(model, train[0], trainer=Wandering(3), monitors=[watch]).iterations == 3


@pytest.mark.parametrize("optimiser", [LevenbergMarquardt(max_iter=5), Adam(max_iter=5)])
def test_same_start_same_bits(optimiser):
    runs = []
    for _ in range(2):
        model, train, test = planted()
        result = fit(model, train, test, trainer=optimiser)
        runs.append((theta(model), [(p.train, p.validation) for p in result.history]))
    assert torch.equal(runs[0][0], runs[1][0])
    assert runs[0][1] == runs[1][1]


def test_ridge_keeps_the_parameters_near_their_start():
    steps = []
    for ridge in (0.0, 1.0, 1e4):
        model, train, _ = planted(T=100)
        start = theta(model)
        Fit(model, train, trainer=LevenbergMarquardt(max_iter=10), ridge=ridge).advance()
        steps.append(float((theta(model) - start).norm()))
    assert steps[0] > steps[1] > 10 * steps[2] > 0
