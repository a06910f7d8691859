"""Eigenvalues of A that a search keeps within the unit circle."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from reference import normal, random_cell, random_model
from torch import Tensor

from lfrtorch.data.records import Record
from lfrtorch.engine.cell import LFRCell
from lfrtorch.fitting.multistart import fit
from lfrtorch.least_squares.adam import Adam
from lfrtorch.least_squares.bounded_system import BoundedSystem
from lfrtorch.least_squares.guarantee import guarantee_of
from lfrtorch.least_squares.levenberg_marquardt import LevenbergMarquardt
from lfrtorch.least_squares.linear_systems import CholeskySystem, System
from lfrtorch.least_squares.problem import Problem
from lfrtorch.least_squares.stable_states import (
    PoleBounds,
    fading,
    largest_modulus,
    stabilised,
    within,
)
from lfrtorch.maps.network import Network
from lfrtorch.model.model import Model

pytestmark = pytest.mark.numeric

LIMIT = 1.0 - 1e-6

NONE = torch.zeros(4, dtype=torch.bool)


def matrix(*poles: complex, seed: int = 0) -> Tensor:
    """Random A with these eigenvalues, each complex one beside its conjugate."""
    blocks = [
        torch.tensor(
            [[p.real, p.imag], [-p.imag, p.real]] if p.imag else [[p.real]], dtype=torch.float64
        )
        for p in map(complex, poles)
    ]
    diagonal = torch.block_diag(*blocks)
    T = normal(*diagonal.shape, seed=seed) + 3.0 * torch.eye(len(diagonal))
    return T @ diagonal @ torch.linalg.inv(T)


def moduli(A: Tensor) -> list[float]:
    return sorted(np.abs(np.linalg.eigvals(A.numpy())))


# --- back into the circle -------------------------------------------------------------------


def test_a_stable_matrix_stays_to_the_bit():
    A = matrix(0.99, 0.3, 0.5 + 0.8j)
    assert stabilised(A, NONE, LIMIT) is A


def test_only_the_poles_outside_move_and_to_the_limit():
    A = matrix(1.2, 0.3, 0.7 + 0.8j)  # of modulus 1.063
    found = stabilised(A, NONE, LIMIT)
    assert moduli(found) == pytest.approx([0.3, LIMIT, LIMIT, LIMIT], rel=1e-9)
    angles = np.sort(np.angle(np.linalg.eigvals(found.numpy())))
    assert angles == pytest.approx(np.sort(np.angle(np.linalg.eigvals(A.numpy()))), abs=1e-9)


def test_exact_integrators_stay():
    A = torch.zeros(4, 4, dtype=torch.float64)
    A[:3, :3] = matrix(1.1, 0.2, 0.3)
    A[3, :3], A[3, 3] = 1.0, 1.0
    integrating = torch.tensor([False, False, False, True])
    found = stabilised(A, integrating, LIMIT)
    assert torch.equal(found[3], A[3])
    assert torch.equal(found[:, 3], A[:, 3])
    assert moduli(fading(found, integrating))[-1] == pytest.approx(LIMIT)


@pytest.mark.parametrize("poles", [(1.0005, 0.3, 0.2 + 0.4j), (0.1, 0.3, 0.71 + 0.714j)])
def test_entries_that_are_held_stay_where_a_pole_is_taken_back(poles: tuple[complex, ...]):
    """By about the least change: to first order it is along the slope of the free entries."""
    A = matrix(*poles)
    held = torch.arange(16).view(4, 4) % 3 == 0
    found = within(A, NONE, held, LIMIT)
    assert torch.equal(found[held], A[held])
    assert moduli(found)[-1] < LIMIT + 1e-9
    beyond = moduli(A)[-1] - LIMIT
    leaf = A.clone().requires_grad_()
    torch.linalg.eigvals(leaf).abs().max().backward()
    assert leaf.grad is not None
    slope = leaf.grad.masked_fill(held, 0.0)
    assert float((found - A).norm()) == pytest.approx(beyond / float(slope.norm()), rel=0.1)
    inside = matrix(0.3, 0.2, 0.1 + 0.2j)
    assert within(inside, NONE, held, LIMIT) is inside


# --- steps within it ------------------------------------------------------------------------


def bounded(system: System, A: Tensor) -> BoundedSystem:
    return BoundedSystem(system, PoleBounds(A, NONE, LIMIT))


def test_a_step_within_the_limit_is_that_of_the_system():
    A, J, gradient = matrix(0.5, 0.3, 0.2 + 0.4j), normal(30, 20), 1e-3 * normal(20, seed=1)
    system = CholeskySystem(J.mT @ J, 20)
    assert torch.equal(bounded(system, A).solve(gradient, 0.1), system.solve(gradient, 0.1))


@pytest.mark.parametrize("poles", [(0.999, 0.3, 0.2 + 0.4j), (0.1, 0.3, 0.7 + 0.714j)])
def test_a_step_beyond_the_limit_is_the_best_one_that_ends_there(poles: tuple[complex, ...]):
    """Against the minimum in the plane of the first order, from its basis."""
    A, J, damping = matrix(*poles), normal(30, 20), 0.1
    slope = torch.zeros(20, dtype=A.dtype)
    leaf = A.clone().requires_grad_()
    torch.linalg.eigvals(leaf).abs().max().backward()
    assert leaf.grad is not None
    slope[:16] = leaf.grad.flatten()
    G = J.mT @ J
    H = G + damping * torch.eye(20)
    gradient = -0.02 / slope.square().sum() * (H @ slope)  # the free step takes the pole to > 1
    step = bounded(CholeskySystem(G, 20), A).solve(gradient, damping)
    room = LIMIT - moduli(A)[-1]
    assert LIMIT - 1e-5 < moduli(A + step[:16].view(4, 4))[-1] < LIMIT + 1e-9
    first = room * slope / slope.square().sum()
    plane = torch.linalg.svd(slope.unsqueeze(0)).Vh[1:].mT
    inside = torch.linalg.solve(plane.mT @ H @ plane, -plane.mT @ (gradient + H @ first))
    best = first + plane @ inside
    assert float((step - best).norm()) < 0.05 * float(best.norm())


def test_a_bound_that_others_make_needless_holds_no_step_back():
    """The free step takes one pole out and another in; the second stays free."""
    A = torch.diag(torch.tensor([0.9995, 0.9994, 0.3, 0.2], dtype=torch.float64))
    J, gradient = torch.eye(16, dtype=torch.float64), torch.zeros(16, dtype=torch.float64)
    gradient[0], gradient[5] = -0.01, 0.01
    step = bounded(CholeskySystem(J, 16), A).solve(gradient, 0.0)
    assert float(step[0]) == pytest.approx(LIMIT - 0.9995, abs=1e-9)
    assert float(step[5]) == pytest.approx(-0.01)


def test_room_shrinks_by_what_a_step_takes_each_pole_beyond():
    """One pole goes in and the other out, so that they change their order."""
    A = torch.diag(torch.tensor([0.999, 0.95, 0.3], dtype=torch.float64))
    bounds, step = PoleBounds(A, NONE[:3], LIMIT), torch.zeros(12, dtype=torch.float64)
    assert bounds.room.tolist() == pytest.approx([LIMIT - 0.999, LIMIT - 0.95])
    assert bounds.tightened(step, bounds.room) is None
    step[0], step[4] = -0.2, 0.08
    found = bounds.tightened(step, bounds.room)
    assert found is not None
    assert found.tolist() == pytest.approx([LIMIT - 0.999, LIMIT - 0.95 - (1.03 - LIMIT)])


def test_poles_of_delays_bound_no_step():
    """Three samples of delay: an eigenvalue 0 of one eigenvector, which has no derivative."""
    A = torch.diag(torch.ones(3, dtype=torch.float64), 1)
    A[3, 3] = 0.999
    J, gradient = normal(30, 20), 1e-6 * normal(20, seed=1)
    system = CholeskySystem(J.mT @ J, 20)
    step = bounded(system, A).solve(gradient, 0.1)
    assert torch.equal(step, system.solve(gradient, 0.1))


# --- a fit ----------------------------------------------------------------------------------


def unstable_data() -> tuple[Model, Record]:
    """A stable start, and data of a model whose A is outside and whose map holds it back."""
    truth = random_model(random_cell(1, 1, 2, 1, 1, 3, seed=4))
    cell = truth.lfr.cell
    assert isinstance(cell.static, Network)
    with torch.no_grad():
        cell.A.copy_(torch.diag(torch.tensor([1.02, 0.5])))
        cell.Bw.copy_(torch.tensor([[-0.3], [0.0]]))
        cell.Cz.copy_(torch.tensor([[1.0, 0.0]]))
        cell.Dzu.zero_()
        cell.static.Wz.fill_(1.0)
        cell.static.Ww.fill_(1 / 3)
        for bias in (cell.static.bz, cell.static.bw):
            bias.zero_()
    u = 0.3 * np.random.default_rng(0).normal(size=(400, 1))
    record = Record(u, truth.simulate(u), fs=truth.fs, inputs=truth.inputs, outputs=truth.outputs)
    with torch.no_grad():
        cell.A[0, 0] = 0.9
        cell.Bw[0, 0] = -0.05
    return truth, record


@pytest.mark.parametrize("trainer", [LevenbergMarquardt(max_iter=12), Adam(150, 2e-2)])
def test_a_fit_keeps_A_stable_unless_told(trainer):
    radii = {}
    for stable in (True, False):
        model, record = unstable_data()
        radius = []

        def watch(model: Model, _, radius: list[float] = radius) -> None:
            radius.append(moduli(model.lfr.cell.A.detach())[-1])

        options = replace(trainer, guarantee="stable" if stable else None)
        result = fit(model, record, trainer=options, monitors=[watch])
        assert result.history[-1].train < result.history[0].train
        radii[stable] = max(radius)
    assert radii[True] <= largest_modulus(400) * (1 + 1e-9)
    assert radii[False] > 1.001


def test_a_start_that_is_not_stable_stays_within_its_own_circle():
    model, record = unstable_data()
    with torch.no_grad():
        model.lfr.cell.A[0, 0] = 1.01
    problem = Problem.of(model, record, guarantee=partial(guarantee_of, "stable", record.samples))
    theta = problem.theta.clone()
    assert problem.admissible(theta) is theta
    theta[0] = 1.3
    assert float(problem.admissible(theta)[0]) == pytest.approx(1.01)


def test_a_guarantee_has_a_name_or_a_rate():
    with pytest.raises(ValueError, match="guarantee is 'yes'; give 'stable', 'contracting',"):
        LevenbergMarquardt(guarantee="yes")  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("rate", [1e308, -0.5, 1.0])
def test_a_rate_that_is_none_is_refused_before_anything_is_proven(rate: float):
    cell = LFRCell(1, 1, 2, dtype=torch.float64)
    with pytest.raises(ValueError, match="give a rate above 0 and below 1"):
        guarantee_of(rate, 100, cell)
