"""Trajectories against the plain loop, and the periodic steady state."""

from typing import Any

import numpy as np
import pytest
import reference
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from reference import SIZES, normal, polynomial_cell, random_cell
from torch import Tensor
from torch.testing import assert_close

from lfrtorch.engine import simulation
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.feedback_recurrence import monodromy
from lfrtorch.engine.linearised import linearise, spectral_radius
from lfrtorch.engine.simulation import PERIODIC_TOLERANCE, Trajectory, simulate, steady_state
from lfrtorch.maps.activations import ACTIVATIONS
from lfrtorch.maps.network import Network
from lfrtorch.maps.polynomial import Polynomial

pytestmark = pytest.mark.numeric


class SameNetwork(torch.nn.Module):
    """The map of a Network in the user's own words: takes the generic path."""

    def __init__(self, network: Network):
        super().__init__()
        self.W1, self.b1 = network.Wz, network.bz
        self.W2, self.b2 = network.Ww, network.bw

    def forward(self, z: Tensor) -> Tensor:
        return torch.tanh(z @ self.W1.T + self.b1) @ self.W2.T + self.b2


class Halved(Network):
    """A user's own class that begins with the package's."""

    def forward(self, z: Tensor) -> Tensor:
        return 0.5 * super().forward(z)


class Cube(torch.nn.Module):
    """A static map without parameters."""

    def forward(self, z: Tensor) -> Tensor:
        return z**3


def assert_same(trajectory: Trajectory, expected: Trajectory, tolerance: float):
    for signal, wanted in zip(trajectory, expected, strict=True):
        assert_close(signal, wanted, rtol=tolerance, atol=tolerance)


# --- from a given state ---------------------------------------------------------------------


@given(sizes=SIZES, R=st.integers(1, 3), T=st.integers(1, 12))
@settings(max_examples=25)
def test_simulation_is_the_plain_loop(sizes: dict[str, Any], R: int, T: int):
    cell = random_cell(**sizes)
    u, x0 = normal(R, T, cell.nu), normal(R, cell.nx, seed=1)
    assert_same(simulate(cell, u, x0), reference.simulate(cell, u, x0), 1e-12)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("activation", sorted(ACTIVATIONS))
def test_compiled_is_the_plain_loop_for_every_activation(activation: str, dtype: torch.dtype):
    cell = random_cell(2, 2, 3, 2, 2, 5, activation=activation, dtype=dtype)
    u, x0 = normal(3, 40, 2, dtype=dtype), normal(3, 3, seed=1, dtype=dtype)
    trajectory = simulate(cell, u, x0)
    assert trajectory.y.dtype == dtype
    # Errors of the steps before contract: some 100 eps in all, in either order of the sums.
    eps = torch.finfo(dtype).eps
    assert_same(trajectory, reference.simulate(cell, u, x0), 1000 * eps)


@pytest.mark.usefixtures("fast")
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("degree", [1, 2, 3, 5])
@pytest.mark.parametrize(("nz", "nw"), [(1, 1), (2, 3), (3, 2)])
def test_polynomial_is_compiled_and_the_plain_loop(
    nz: int, nw: int, degree: int, dtype: torch.dtype
):
    cell = polynomial_cell(nz, nw, degree, dtype=dtype)
    u, x0 = normal(3, 20, 2, dtype=dtype), normal(3, 2, seed=1, dtype=dtype)
    assert cell.weights().layout.compiled
    trajectory = simulate(cell, u, x0)
    assert trajectory.y.dtype == dtype
    assert_same(trajectory, reference.simulate(cell, u, x0), 1000 * torch.finfo(dtype).eps)


def test_steady_state_of_a_polynomial_is_the_last_of_very_many_periods():
    cell, u = polynomial_cell(2, 2, 3), normal(2, 10, 2)
    expected = reference.simulate(cell, u, u.new_zeros(2, 2), periods=20)
    assert_same(steady_state(cell, u), expected, 2e-9)


def test_polynomial_that_diverges_is_not_an_exception():
    cell, u = polynomial_cell(1, 1, 3), 1e3 * normal(2, 20, 2)
    assert not simulate(cell, u, u.new_zeros(2, 2)).finite
    assert not steady_state(cell, u).finite


def test_own_class_derived_from_the_polynomial_is_followed():
    class Shifted(Polynomial):
        def forward(self, z: Tensor) -> Tensor:
            return super().forward(z + 1.0)

    cell = random_cell(static=Shifted(1, 1, 2), radius=0.3, feedback=0.01)
    u, x0 = normal(2, 20, 1), normal(2, 2, seed=1)
    assert_same(simulate(cell, u, x0), reference.simulate(cell, u, x0), 1e-12)


def test_linear_cell_is_the_plain_loop():
    cell = random_cell(2, 2, 3, 0, 0)
    u, x0 = normal(2, 30, 2), normal(2, 3, seed=1)
    trajectory = simulate(cell, u, x0)
    assert trajectory.z.shape == trajectory.w.shape == (2, 30, 0)
    assert_same(trajectory, reference.simulate(cell, u, x0), 1e-12)


def test_own_module_equals_the_compiled_network():
    cell = random_cell(1, 1, 2, 2, 2, 4)
    assert isinstance(cell.static, Network)
    own = LFRCell(1, 1, 2, 2, 2, SameNetwork(cell.static), random=False).double()
    own.load_state_dict(cell.state_dict(), strict=False)
    u, x0 = normal(2, 50, 1), normal(2, 2, seed=1)
    assert_same(simulate(own, u, x0), simulate(cell, u, x0), 1e-12)
    assert_same(steady_state(own, u), steady_state(cell, u), 1e-9)


def test_own_module_is_followed_step_by_step_where_newton_fails(monkeypatch):
    monkeypatch.setattr("lfrtorch.engine.newton.MAX_NEWTON", 0)
    cell = random_cell(1, 1, 2, 2, 2, 4)
    assert isinstance(cell.static, Network)
    own = LFRCell(1, 1, 2, 2, 2, SameNetwork(cell.static), random=False).double()
    own.load_state_dict(cell.state_dict(), strict=False)
    u, x0 = normal(2, 30, 1), normal(2, 2, seed=1)
    expected = simulate(cell, u, x0)
    assert_same(simulate(own, u, x0), expected, 1e-12)
    assert_same(simulate(own, u, x0, guess=expected.x), expected, 1e-12)
    periodic = steady_state(cell, u)
    for guess in (None, x0, periodic.x):
        assert_same(steady_state(own, u, guess), periodic, 1e-9)


def test_own_class_derived_from_the_network_is_followed():
    own = random_cell(static=Halved(1, 1, 3))
    halved = random_cell(static=Network(1, 1, 3))
    halved.load_state_dict(own.state_dict())
    with torch.no_grad():
        for name in ("static.Ww", "static.bw"):
            halved.get_parameter(name).mul_(0.5)
    u, x0 = normal(2, 20, 1), normal(2, 2, seed=1)
    assert_same(simulate(own, u, x0), simulate(halved, u, x0), 1e-12)


def test_records_of_a_batch_do_not_mix():
    cell = random_cell(1, 1, 2)
    u, x0 = normal(3, 20, 1), normal(3, 2, seed=1)
    together = simulate(cell, u, x0)
    for r in range(3):
        alone = simulate(cell, u[r : r + 1], x0[r : r + 1])
        assert torch.equal(together.x[r], alone.x[0])


def test_unstable_model_is_not_an_exception():
    cell = random_cell(radius=3.0)
    trajectory = simulate(cell, normal(1, 2000, 1), torch.zeros(1, 2, dtype=torch.float64))
    assert not trajectory.finite
    assert not torch.isfinite(trajectory.y[0, -1]).any()
    assert torch.isnan(steady_state(cell, normal(1, 2000, 1)).y).all()


@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_finite_is_every_output_and_the_state_behind_them(bad: float):
    """The end state of a record is the start of what follows."""
    cell, u = random_cell(1, 1, 2), normal(2, 5, 1)
    for signal, at, finite in (("y", 0, False), ("y", -1, False), ("x", -1, False), ("z", 0, True)):
        trajectory = simulate(cell, u, normal(2, 2, seed=1))
        assert trajectory.finite
        getattr(trajectory, signal)[1, at, 0] = bad
        assert trajectory.finite == finite


# --- periodic steady state ------------------------------------------------------------------


@pytest.mark.parametrize("activation", sorted(ACTIVATIONS))
def test_steady_state_is_the_last_of_very_many_periods(activation: str):
    cell = random_cell(2, 1, 3, 2, 1, 4, activation=activation)
    u = normal(2, 10, 2)
    expected = reference.simulate(cell, u, u.new_zeros(2, 3), periods=50)  # 0.9^500 = 1e-23
    # The gap of 1e-10 at the end of a period is 1e-10 / (1 - 0.9^10) from the solution.
    assert_same(steady_state(cell, u), expected, 2e-9)


def test_steady_state_of_a_linear_cell_is_the_response_in_frequency():
    cell = random_cell(2, 2, 3, 0, 0)
    A, B, C, D = (m.detach().numpy() for m in (cell.A, cell.Bu, cell.Cy, cell.Dyu))
    u = normal(1, 64, 2)
    expected = reference.periodic_response((A, B, C, D), u[0].numpy())
    np.testing.assert_allclose(steady_state(cell, u).y[0].numpy(), expected, rtol=0, atol=1e-9)


def lightly_damped(radius: float, nw: int, dtype: torch.dtype = torch.float64) -> LFRCell:
    """Cell with poles at radius e^(±j) and hardly any feedback."""
    cell = random_cell(1, 1, 2, nw, nw, 3, feedback=1e-5)
    c, s = np.cos(1.0), np.sin(1.0)
    with torch.no_grad():
        cell.A.copy_(radius * torch.tensor([[c, s], [-s, c]]))
    return cell.to(dtype)


@pytest.mark.parametrize("nw", [0, 1])
def test_lightly_damped_model_settles_by_newton(nw: int):
    cell = lightly_damped(0.9999, nw)  # forward passes would take 2e5 samples
    u = normal(2, 30, 1)
    found = steady_state(cell, u)
    scale = float(1 + found.x.abs().max())
    assert (found.x[:, -1] - found.x[:, 0]).abs().max() <= PERIODIC_TOLERANCE * scale
    assert_same(found, reference.simulate(cell, u, found.x[:, 0]), 1e-12 * scale)


def test_good_guess_changes_nothing():
    cell = random_cell()
    u = normal(1, 20, 1)
    cold = steady_state(cell, u)
    for guess in (cold.x[:, 0], cold.x):  # of the start alone, or of all states
        assert_same(steady_state(cell, u, guess), cold, 1e-9)


@pytest.mark.parametrize("radius", [0.5, 0.9, 0.99])
def test_steady_state_in_single_precision(radius: float):
    u = normal(1, 50, 1)
    expected = steady_state(lightly_damped(radius, 1), u)
    found = steady_state(lightly_damped(radius, 1, torch.float32), u.float())
    # eps 1.2e-7 amplified by 1 / (1 - 0.99) = 100, times some rounding errors a step.
    tolerance = 5e-5 * float(1 + expected.x.abs().max())
    assert_close(found.y.double(), expected.y, rtol=0, atol=tolerance)


def test_unstable_periodic_solution_counts_as_diverged():
    cell = random_cell(1, 1, 2, 0, 0, radius=0.5)
    with torch.no_grad():
        cell.A[:] = torch.diag(
            torch.tensor([1.05, 0.5])
        )  # (I - Φ) is regular, x(T) = x(0) solvable
    assert torch.isnan(steady_state(cell, normal(1, 10, 1)).y).all()


def escaping(a: float, c: float) -> LFRCell:
    """x+ = a x + c tanh x + u: beyond a + c = 1 the rest is unstable, between two that are not."""
    cell = random_cell(1, 1, 1, 1, 1, 1)
    with torch.no_grad():
        for parameter in cell.parameters():
            parameter.zero_()
        for name in ("Bu", "Cz", "Cy", "static.Wz", "static.Ww"):
            cell.get_parameter(name).fill_(1.0)
        cell.A.fill_(a)
        cell.Bw.fill_(c)
    return cell


def raised_sine(T: int, amplitude: float) -> Tensor:
    time = torch.arange(T, dtype=torch.float64)
    return amplitude * (1.0 + torch.sin(2 * torch.pi * time / T)).reshape(1, T, 1)


@pytest.mark.parametrize(
    ("a", "c", "T", "amplitude"),
    [(0.5, 0.51, 20, 1e-3), (0.9, 0.2, 10, 1e-4), (0.95, 0.06, 10, 1e-3), (0.99, 0.03, 10, 1e-2)],
)
def test_model_that_leaves_an_unstable_rest_slowly_settles(
    a: float, c: float, T: int, amplitude: float
):
    cell, u = escaping(a, c), raised_sine(T, amplitude)
    x0 = u.new_zeros(1, 1)
    for _ in range(500):
        x0 = simulate(cell, u, x0).x[:, -1]
    assert_same(steady_state(cell, u), simulate(cell, u, x0), 1e-8)


def test_model_that_stays_at_an_unstable_rest_counts_as_diverged():
    """Beside it is a mode that takes more passes to settle than Newton's method waits for."""
    cell = random_cell(1, 1, 2, 1, 1, 1)
    with torch.no_grad():
        for parameter in cell.parameters():
            parameter.zero_()
        cell.A.copy_(torch.diag(torch.tensor([1.05, 0.5])))
        cell.Bu[1], cell.Cy[:] = 1.0, 1.0
    assert torch.isnan(steady_state(cell, normal(1, 5, 1)).y).all()


@pytest.mark.usefixtures("fast")
@pytest.mark.parametrize(("radius", "nw", "most"), [(1.0001, 0, 5), (1.01, 1, 8), (1.1, 1, 6)])
def test_few_passes_tell_that_a_model_diverges(radius: float, nw: int, most: int, monkeypatch):
    passes = []

    def counted(*arguments: Any) -> None:
        passes.append(arguments)
        compiled(*arguments)

    compiled = simulation.simulate_records
    monkeypatch.setattr(simulation, "simulate_records", counted)
    assert torch.isnan(steady_state(lightly_damped(radius, nw), normal(1, 200, 1)).y).all()
    assert len(passes) <= most


# --- linearisation --------------------------------------------------------------------------


def test_slopes_are_the_derivatives_of_one_step():
    cell = random_cell(2, 2, 3, 2, 2, 4)
    u, x = normal(1, 1, 2), normal(1, 3, seed=1)
    F, H = linearise(cell, simulate(cell, u, x).z)
    y_x, next_x = torch.autograd.functional.jacobian(lambda x_: cell(u[0, 0], x_), x[0])
    assert_close(F[0, 0], next_x, rtol=1e-12, atol=1e-13)
    assert_close(H[0, 0], y_x, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("samples", [1 << 14, 3])
def test_monodromy_is_the_product_with_the_last_step_leftmost(samples: int, monkeypatch):
    monkeypatch.setattr("lfrtorch.engine.feedback_recurrence.PASS", samples)
    cell, z = random_cell(1, 1, 3, 2, 2), normal(2, 7, 2)
    F = linearise(cell, z).F
    for r in range(2):
        expected = torch.linalg.multi_dot(list(F[r].flip(0)))
        assert_close(monodromy(cell, z)[r], expected, rtol=1e-12, atol=1e-12)


def test_expanding_but_bounded_trajectory_counts_as_diverged():
    """Its monodromy overflows, and the eigenvalues of infinities crash some builds of LAPACK."""
    # The chaotic Gauss map x+ = exp(-6.2 x²) - 0.5.
    static = Network(1, 1, 1, "rbf", dtype=torch.float64)
    cell = LFRCell(1, 1, 1, 1, 1, static, dtype=torch.float64, random=False)
    with torch.no_grad():
        for weight, value in (
            (cell.Bw, 1.0),
            (cell.Cz, 1.0),
            (static.Wz, 6.2**0.5),
            (static.bz, 0.0),
            (static.Ww, 1.0),
            (static.bw, -0.5),
        ):
            weight.fill_(value)
    u = torch.zeros(1, 8192, 1, dtype=torch.float64)
    start = u.new_full((1, 1), 0.1)
    trajectory = simulate(cell, u, start)
    assert trajectory.finite
    assert not torch.isfinite(monodromy(cell, trajectory.z)).all()
    assert not steady_state(cell, u, start).finite


def test_spectral_radius():
    matrices = torch.tensor([[[0.0, 2.0], [-2.0, 0.0]], [[0.5, 0.0], [0.0, 0.1]]])
    assert_close(spectral_radius(matrices), torch.tensor([2.0, 0.5]))
    matrices[0, 0, 0] = torch.inf
    assert_close(spectral_radius(matrices), torch.tensor([torch.nan, 0.5]), equal_nan=True)


def test_record_that_diverges_leaves_the_others_their_steady_state():
    """A cubic runs away where it is driven hard."""
    cell, loud = polynomial_cell(1, 1, 3), torch.tensor([1e3, 1e-2]).reshape(2, 1, 1)
    y = steady_state(cell, loud * normal(2, 30, 2)).y
    assert torch.isnan(y[0]).all()
    assert torch.isfinite(y[1]).all()


def test_steady_state_of_a_slow_model_is_the_last_of_very_many_periods():
    cell, u = random_cell(2, 1, 3, 2, 2, 4, radius=0.85), normal(2, 5, 2)
    expected = reference.simulate(cell, u, u.new_zeros(2, 3), periods=100)  # 0.95^500 = 7e-12
    assert_same(steady_state(cell, u), expected, 1e-9)
