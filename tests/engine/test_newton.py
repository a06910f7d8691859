"""All states at once against the plain loop over time."""

from collections.abc import Callable
from typing import Any
from unittest.mock import patch

import pytest
import reference
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from reference import SIZES, normal, random_cell
from torch import Tensor, nn
from torch.testing import assert_close

import lfrtorch.engine.newton
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.linear_recurrence import linear_recurrence, scan
from lfrtorch.engine.linearised import linearise as linearise_of
from lfrtorch.engine.newton import newton_states
from lfrtorch.maps.activations import ACTIVATIONS

pytestmark = [pytest.mark.numeric, pytest.mark.usefixtures("fast")]

WAYS = [linear_recurrence, scan]  # of the CPU, and of any other device


def found(
    cell: LFRCell,
    u: Tensor,
    x0: Tensor,
    way: Callable[..., Tensor] = linear_recurrence,
    **options: Any,
) -> Tensor | None:
    with patch.object(lfrtorch.engine.newton, "linear_recurrence", way):
        x = newton_states(cell, u, x0, **options)
    return x if torch.isfinite(x).all() else None


def states(*arguments, **options) -> Tensor:
    x = found(*arguments, **options)
    assert x is not None
    return x


def iterations(cell: LFRCell, u: Tensor, x0: Tensor, **options) -> int:
    with patch("lfrtorch.engine.newton.linearise", wraps=linearise_of) as calls:
        states(cell, u, x0, **options)
    return calls.call_count


class Cubic(nn.Module):
    """A user's own map, with a parameter that does not look like a network's."""

    def __init__(self):
        super().__init__()
        self.c = nn.Parameter(torch.zeros(2, 3))

    def forward(self, z: Tensor) -> Tensor:
        return z.tanh() ** 3 @ self.c.mT


class Square(nn.Module):
    """A map that grows without bound."""

    def forward(self, z: Tensor) -> Tensor:
        return z**2


class Logistic(nn.Module):
    """x+ = 4 x (1 - x) where Bw = Cz = 1: chaotic and bounded."""

    def forward(self, z: Tensor) -> Tensor:
        return 4.0 * z * (1.0 - z)


def logistic() -> LFRCell:
    cell = LFRCell(1, 1, 1, 1, 1, Logistic(), dtype=torch.float64, random=False)
    with torch.no_grad():
        cell.Bw.fill_(1.0)
        cell.Cz.fill_(1.0)
    return cell


# --- the plain loop -------------------------------------------------------------------------


@given(sizes=SIZES, R=st.integers(1, 3), T=st.integers(1, 30), way=st.sampled_from(WAYS))
@settings(max_examples=25)
def test_states_are_those_of_the_plain_loop(sizes: dict[str, Any], R: int, T: int, way):
    cell = random_cell(**sizes, feedback=0.5)
    u, x0 = normal(R, T, cell.nu), normal(R, cell.nx, seed=1)
    x = states(cell, u, x0, way)
    assert x.shape == (R, T + 1, cell.nx)
    assert_close(x, reference.simulate(cell, u, x0).x, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("activation", sorted(ACTIVATIONS))
def test_equal_to_rounding_in_either_precision(activation: str, dtype: torch.dtype, way):
    cell = random_cell(2, 2, 3, 2, 2, 5, activation=activation, feedback=0.5, dtype=dtype)
    u, x0 = normal(2, 200, 2, dtype=dtype), normal(2, 3, seed=1, dtype=dtype)
    x = states(cell, u, x0, way)
    assert x.dtype == dtype
    # Errors of the steps before contract: some 100 eps in all, in either order of the sums.
    tolerance = 1000 * torch.finfo(dtype).eps
    assert_close(x, reference.simulate(cell, u, x0).x, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("way", WAYS)
def test_own_map(way):
    cell = random_cell(1, 1, 3, 3, 2, static=Cubic(), feedback=0.5)
    u, x0 = normal(2, 100, 1), normal(2, 3, seed=1)
    assert_close(
        states(cell, u, x0, way), reference.simulate(cell, u, x0).x, rtol=1e-12, atol=1e-12
    )


@pytest.mark.parametrize("way", WAYS)
def test_linear_cell_is_found_at_the_first_step(way):
    cell = random_cell(2, 2, 3, 0, 0)
    u, x0 = normal(2, 50, 2), normal(2, 3, seed=1)
    expected = reference.simulate(cell, u, x0).x
    assert_close(states(cell, u, x0, way), expected, rtol=1e-12, atol=1e-12)
    # The second finds rounding errors at most to take off, which are relative to large states.
    for unit in (1.0, 1e12):
        assert iterations(cell, unit * u, unit * x0) <= 2


def test_states_that_hardly_move_are_found_at_once():
    """A change is relative to states of unit size, too, where the signals are far smaller."""
    cell = random_cell(1, 1, 3, 2, 2, 4, feedback=0.5)
    with torch.no_grad():  # rest is x = 0
        cell.get_parameter("static.bz").zero_()
        cell.get_parameter("static.bw").zero_()
    u, x0 = 1e-12 * normal(2, 50, 1), 1e-12 * normal(2, 3, seed=1)
    assert iterations(cell, u, x0) == 1


# --- periodic steady state ------------------------------------------------------------------


@pytest.mark.parametrize("nw", [0, 2])
def test_periodic_states_are_those_of_very_many_periods(nw: int):
    cell = random_cell(1, 1, 3, nw, nw, 4, radius=0.6, feedback=0.3)
    u = normal(2, 5, 1)
    expected = reference.simulate(cell, u, u.new_zeros(2, 3), periods=60).x  # 0.9^300 = 2e-14
    for way in WAYS:
        x = states(cell, u, normal(2, 3, seed=1), way, periodic=True)
        assert_close(x, expected, rtol=1e-12, atol=1e-12)
        assert_close(x[:, -1], x[:, 0], rtol=1e-13, atol=1e-13)


def test_periodic_states_in_single_precision():
    cell = random_cell(1, 1, 3, 2, 2, 4, dtype=torch.float32)
    u = normal(2, 50, 1, dtype=torch.float32)
    x = states(cell, u, u.new_zeros(2, 3), periodic=True)
    expected = reference.simulate(cell, u, u.new_zeros(2, 3), periods=5).x
    assert_close(x, expected, rtol=1e-5, atol=1e-5)  # 100 eps


# --- the guess ------------------------------------------------------------------------------


@pytest.mark.parametrize("periodic", [False, True])
def test_nearby_guess_takes_fewer_iterations_to_the_same_states(periodic: bool):
    cell = random_cell(1, 1, 3, 2, 2, 4, feedback=1.0)
    u, x0 = normal(2, 300, 1), normal(2, 3, seed=1)
    cold = states(cell, u, x0, periodic=periodic)
    guess = cold + 1e-6 * normal(*cold.shape, seed=2)  # nor does it start at x0
    before = guess.clone()
    warm = states(cell, u, x0, periodic=periodic, guess=guess)
    assert torch.equal(guess, before)
    assert_close(warm, cold, rtol=1e-12, atol=1e-12)
    few = iterations(cell, u, x0, periodic=periodic, guess=guess)
    # The error is squared by each: 1e-12, then nothing. From far off it takes some more.
    assert few <= 3 < iterations(cell, u, x0, periodic=periodic)


def test_a_large_record_does_not_hide_a_small_one():
    cell = random_cell(feedback=1.0)
    u = normal(2, 100, 1) * torch.tensor([1.0, 1e9]).reshape(2, 1, 1)
    x = states(cell, u, u.new_zeros(2, 2))
    expected = reference.simulate(cell, u, u.new_zeros(2, 2)).x
    assert_close(x[0], expected[0], rtol=1e-12, atol=1e-12)


# --- what is given up -----------------------------------------------------------------------


@pytest.mark.parametrize("periodic", [False, True])
@pytest.mark.parametrize("way", WAYS)
def test_model_that_diverges_or_is_chaotic(way, periodic: bool):
    u = normal(1, 2000, 1)
    diverging = random_cell(radius=3.0)
    assert found(diverging, u, u.new_zeros(1, 2), way, periodic=periodic) is None
    assert found(logistic(), u, u.new_full((1, 1), 0.1), way, periodic=periodic) is None


@pytest.mark.parametrize("way", WAYS)
def test_unstable_periodic_solution(way):
    cell = random_cell(1, 1, 2, 0, 0)
    u, x0 = normal(1, 10, 1), torch.zeros(1, 2, dtype=torch.float64)
    for pole, stable in ((0.95, True), (1.05, False), (-1.05, False)):  # all have x(T) = x(0)
        with torch.no_grad():
            cell.A[:] = torch.diag(torch.tensor([pole, 0.5]))
        assert (found(cell, u, x0, way, periodic=True) is not None) == stable
        assert found(cell, u, x0, way) is not None


def test_unstable_fixed_point_whose_transition_overflows():
    """Nothing is left to update there, and infinite entries crash some builds' eigenvalues."""
    u = torch.zeros(1, 2000, 1, dtype=torch.float64)
    assert found(logistic(), u, u.new_zeros(1, 1)) is not None
    assert found(logistic(), u, u.new_zeros(1, 1), periodic=True) is None


def test_integrator_has_no_periodic_solution():
    cell = LFRCell(1, 1, 1, dtype=torch.float64, random=False)
    with torch.no_grad():
        cell.A.fill_(1.0)
        cell.Bu.fill_(1.0)
    u = torch.ones(1, 8, 1, dtype=torch.float64)
    assert found(cell, u, u.new_zeros(1, 1), periodic=True) is None


def test_record_that_fails_leaves_the_others_alone():
    """The second is driven so hard that a quadratic map diverges."""
    cell = random_cell(static=Square(), feedback=0.2)
    u = normal(2, 40, 1) * torch.tensor([0.1, 1e3]).reshape(2, 1, 1)
    x = newton_states(cell, u, u.new_zeros(2, 2))
    expected = reference.simulate(cell, u[:1], u.new_zeros(1, 2)).x
    assert_close(x[:1], expected, rtol=1e-12, atol=1e-12)
    assert torch.isnan(x[1]).all()


def test_guess_that_is_not_finite():
    cell = random_cell()
    u, x0 = normal(1, 20, 1), torch.zeros(1, 2, dtype=torch.float64)
    guess = torch.full((1, 21, 2), torch.nan, dtype=torch.float64)
    for periodic in (False, True):
        assert found(cell, u, x0, guess=guess, periodic=periodic) is None


def test_iterations_have_an_end():
    cell = random_cell(1, 1, 3, 2, 2, 4, feedback=1.0)
    u, x0 = normal(1, 300, 1), normal(1, 3, seed=1)
    needed = iterations(cell, u, x0)
    for allowed in (needed - 1, needed):
        with patch.object(lfrtorch.engine.newton, "MAX_NEWTON", allowed):
            assert (found(cell, u, x0) is not None) == (allowed == needed)
