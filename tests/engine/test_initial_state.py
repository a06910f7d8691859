"""Initial states that are estimated from the output: known ones, hidden ones, faded ones."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from reference import POLES, normal, random_cell, special_poles
from torch import Tensor
from torch.testing import assert_close

from lfrtorch._support import threads
from lfrtorch.engine import initial_state, sensitivity
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.initial_state import estimated_start, start_from_beginning
from lfrtorch.engine.sensitivity import Linearisation, Rows
from lfrtorch.engine.simulation import Trajectory, simulate
from lfrtorch.maps.network import Network

pytestmark = pytest.mark.numeric


def simulate_estimated(cell: LFRCell, u: Tensor, y: Tensor, weight: Tensor) -> Trajectory:
    return simulate(cell, u, estimated_start(cell, u, y, weight))


def test_estimated_initial_state_is_the_one_that_made_the_output():
    cell, u, x0 = random_cell(2, 2, 3, 2, 2, 4), normal(3, 60, 2), normal(3, 3, seed=1)
    made = simulate(cell, u, x0)
    found = simulate_estimated(cell, u, made.y, torch.ones_like(made.y))
    assert_close(found.x[:, 0], x0, rtol=0, atol=1e-8)
    assert_close(found.y, made.y, rtol=0, atol=1e-9)


@pytest.mark.parametrize("noise", [0.0, 0.3])
@pytest.mark.parametrize("sizes", [(1, 1, 2, 0, 0, 0), (2, 2, 3, 2, 2, 4), (1, 2, 4, 1, 2, 3)])
def test_machine_code_and_torch_find_the_same_initial_states(sizes, noise: float, fast):
    """From rest and from near, with and without the prior that few samples need."""
    nu, ny, nx, nz, nw, nn = sizes
    cell, u = random_cell(nu, ny, nx, nz, nw, nn), normal(5, 40, nu)
    y = simulate(cell, u, normal(5, nx, seed=1)).y
    y = y + noise * normal(5, 40, ny, seed=2)
    weight = torch.ones_like(y)
    weight[:, 12:] = 0.0
    ways: list[Callable[..., Tensor]] = [estimated_start, start_from_beginning]
    ways.append(lambda cell, u, y, weight: estimated_start(cell, u, y, weight, near))
    near = normal(5, nx, seed=1)
    found = [way(cell, u, y, weight) for way in ways]
    fast(False)
    # Both end the search where a step gains 1e-8 of the cost: errors of 1e-4 in the state.
    for way, by_code in zip(ways, found, strict=True):
        assert_close(way(cell, u, y, weight), by_code, rtol=0, atol=1e-4)


def test_a_linear_model_is_not_simulated_from_states_that_cannot_be_better(monkeypatch):
    cell, u = random_cell(1, 1, 2, 0, 0), normal(1, 60, 1)
    y = simulate(cell, u, normal(1, 2, seed=1)).y + 0.1 * normal(1, 60, 1, seed=2)
    tried = []
    monkeypatch.setattr(threads, "COMPILED_ON", set())
    monkeypatch.setattr(
        initial_state, "simulate", lambda *a, **b: tried.append(1) or simulate(*a, **b)
    )
    simulate_estimated(cell, u, y, torch.ones_like(y))
    # From rest, one step each, and one for each weight of the prior on its way down.
    assert len(tried) <= 6


def test_the_search_from_the_state_of_a_model_close_by_is_short_and_ends_at_the_same(monkeypatch):
    monkeypatch.setattr(threads, "COMPILED_ON", set())
    cell, u = random_cell(1, 1, 3, 2, 2, 4), normal(2, 60, 1)
    y = simulate(cell, u, normal(2, 3, seed=1)).y + 0.1 * normal(2, 60, 1, seed=2)
    weight, factors, rows = torch.ones_like(y), [], Linearisation.rows
    near = estimated_start(cell, u, y, weight)
    with torch.no_grad():
        for parameter in cell.parameters():
            parameter.mul_(1.0 + 1e-4)
    monkeypatch.setattr(
        Linearisation, "rows", lambda *given, **named: factors.append(1) or rows(*given, **named)
    )
    whole = estimated_start(cell, u, y, weight)
    searched = len(factors)
    assert_close(estimated_start(cell, u, y, weight, near), whole, rtol=0, atol=1e-4)
    assert len(factors) - searched <= searched - 2
    # One that is no use is not begun at.
    assert torch.equal(estimated_start(cell, u, y, weight, torch.full_like(near, torch.nan)), whole)


@pytest.mark.parametrize("compiled", [True, False])
def test_samples_after_the_last_that_counts_play_no_part(compiled: bool, fast):
    cell, u = random_cell(1, 1, 2, 1, 1, 3, radius=0.5), normal(1, 3000, 1)
    y = simulate(cell, u, normal(1, 2, seed=1)).y
    with torch.no_grad():
        cell.state_covariance.mul_(2.0)  # known: no simulation from rest tells it
    weight = torch.ones_like(y)
    weight[:, 20:] = 0.0
    fast(compiled)
    whole = estimated_start(cell, u, y, weight)
    y[:, 20:] = torch.nan
    assert torch.equal(estimated_start(cell, u, y, weight), whole)


def test_no_sample_is_looked_at_after_the_transition_has_faded(monkeypatch):
    monkeypatch.setattr(threads, "COMPILED_ON", set())
    cell, u = random_cell(1, 1, 2, 1, 1, 3, radius=0.5), normal(1, 3000, 1)
    y = simulate(cell, u, normal(1, 2, seed=1)).y
    weight = torch.ones_like(y)
    whole, looked_at = estimated_start(cell, u, y, weight), []

    def watched(self: Linearisation, *given: Any, **named: Any) -> Iterator[Rows]:
        for block in rows(self, *given, **named):
            looked_at.append(block.time.stop)
            yield block

    rows = Linearisation.rows
    monkeypatch.setattr(Linearisation, "rows", watched)
    monkeypatch.setattr(sensitivity, "PASS", 64)
    assert_close(estimated_start(cell, u, y, weight), whole, rtol=0, atol=1e-8)
    assert set(looked_at) == {64}
    # From rest, a few Gauss-Newton steps and as many in each pass of the prior, if it is needed.
    assert len(looked_at) <= initial_state.ITERATIONS * (1 + initial_state.PASSES)


def test_estimated_initial_state_counts_what_is_weighted_only():
    cell, u, x0 = random_cell(1, 1, 2), normal(2, 60, 1), normal(2, 2, seed=1)
    y = simulate(cell, u, x0).y
    weight = torch.ones_like(y)
    y[:, 3:6] += 10.0
    weight[:, 3:6] = 0.0
    found = simulate_estimated(cell, u, y, weight)
    assert_close(found.x[:, 0], x0, rtol=0, atol=1e-8)


def test_estimated_initial_state_of_a_state_that_no_output_shows_is_the_likeliest():
    """Given the other one, and the covariance of both over the training data."""
    cell, u = random_cell(1, 1, 2, 0, 0), normal(1, 30, 1)
    with torch.no_grad():
        cell.A.copy_(torch.diag(torch.tensor([0.5, 0.4])))
        cell.Cy[0, 1] = 0.0
        cell.state_covariance.copy_(torch.tensor([[1.0, 0.8], [0.8, 1.0]]))
    y = simulate(cell, u, u.new_tensor([[2.0, 3.0]])).y + 1e-4 * normal(1, 30, 1, seed=3)
    found = simulate_estimated(cell, u, y, torch.ones_like(y))
    expected = u.new_tensor([[2.0, 0.8 * 2.0]])
    # Noise of 1e-4 over an output gain of about 1: a few of it in either state. (Without noise the
    # likelihoods compared are logarithms of rounding errors.)
    assert_close(found.x[:, 0], expected, rtol=0, atol=2e-3)


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("shown", [1.0, 1e-12])
def test_estimated_initial_state_that_the_output_hardly_shows_stays(shown: float, unit: float):
    """Nothing moves the states, so that nothing else is known about them; whatever the weight."""
    cell, u = random_cell(1, 1, 2, 0, 0), torch.zeros(1, 30, 1, dtype=torch.float64)
    with torch.no_grad():
        cell.A.copy_(torch.diag(torch.tensor([0.5, 0.4])))
        cell.Cy.copy_(torch.tensor([[shown, 1e-12]]))
    y = shown * simulate(cell, u, u.new_tensor([[2.0, 0.0]])).x[:, :-1, :1]
    y = y + 1e-4 * normal(1, 30, 1, seed=3)
    found = simulate_estimated(cell, u, y, torch.full_like(y, unit)).x[0, 0]
    # Noise of 1e-4 over an output gain of 1; the other state moves 1e-12 times as far as this one.
    assert_close(found[0], u.new_tensor(2.0 if shown == 1.0 else 0.0), rtol=0, atol=1e-3)
    assert abs(float(found[1])) < 1e-9


def test_estimated_initial_state_of_a_system_left_alone_is_that_of_least_squares():
    """The input moves the states a hundredth as far as they are at the start."""
    cell, u = random_cell(1, 1, 2, radius=0.9), 0.01 * normal(1, 60, 1)
    x0 = u.new_tensor([[3.0, -2.0]])
    clean = simulate(cell, u, x0).y
    found = simulate_estimated(cell, u, clean + 1e-3 * normal(1, 60, 1, seed=3), torch.ones_like(u))
    assert_close(found.x[:, 0], x0, rtol=0, atol=0.02)


def test_estimated_initial_state_is_not_fitted_to_noise_by_fewer_outputs_than_states():
    """Least squares meets three outputs with four states, whatever they are."""
    cell, u, x0 = random_cell(1, 1, 4, radius=0.95), normal(40, 60, 1), normal(40, 4, seed=1)
    made = simulate(cell, u, x0).y
    weight = torch.zeros_like(made)
    weight[:, :3] = 1.0
    noisy = made + 0.5 * normal(40, 60, 1, seed=2)
    found = simulate_estimated(cell, u, noisy, weight)
    rest = simulate(cell, u, torch.zeros_like(x0))
    errors = [(y - made)[:, 3:].square().mean().sqrt() for y in (found.y, rest.y)]
    assert errors[0] < errors[1]


def test_estimated_initial_state_of_a_diverging_model_is_not_finite():
    cell, u = random_cell(1, 1, 2, 0, 0, radius=3.0), normal(1, 2000, 1)
    y = torch.zeros_like(u)
    assert not simulate_estimated(cell, u, y, torch.ones_like(y)).finite


def test_states_whose_squares_overflow_tell_nothing_of_the_initial_state():
    cell, u = random_cell(1, 1, 2, 0, 0, radius=3.0), normal(1, 600, 1)
    x = simulate(cell, u, None).x
    assert torch.isfinite(x).all()
    assert not torch.isfinite(x.square()).all()
    assert torch.isfinite(estimated_start(cell, u, torch.zeros_like(u), torch.ones_like(u))).all()


def test_no_initial_state_is_taken_from_which_the_model_runs_away_and_not_from_rest():
    """x+ = 1.2 x - 0.5 tanh x + u is unstable beyond |x| = 2.47, where noise puts the state."""
    network = Network(1, 1, 1, dtype=torch.float64)
    cell = LFRCell(1, 1, 1, 1, 1, network, dtype=torch.float64, random=False)
    with torch.no_grad():
        for name, value in {"A": 1.2, "Bu": 1.0, "Bw": -0.5, "Cz": 1.0, "Cy": 1.0}.items():
            getattr(cell, name).fill_(value)
        for parameter, value in zip(network.parameters(), (1.0, 0.0, 1.0, 0.0), strict=True):
            parameter.fill_(value)
        cell.state_covariance.fill_(4.0)
    u, y = torch.zeros(2, 200, 1, dtype=torch.float64), torch.zeros(2, 200, 1, dtype=torch.float64)
    y[0, :3], y[1, :3] = 2.6, simulate(cell, u[:1, :3], torch.full((1, 1), 2.2).double()).y[0]
    weight = torch.zeros_like(y)
    weight[:, :3] = 1.0
    found = simulate_estimated(cell, u, y, weight)
    assert found.x[0, 0].item() == 0.0
    assert found.x[1, 0].item() == pytest.approx(2.2)  # comes to rest
    whole = simulate_estimated(cell, u[:, :3], y[:, :3], weight[:, :3])
    assert whole.x[0, 0].item() > 2.4  # of samples that all count


def test_estimated_initial_state_of_one_record_does_not_hold_up_the_others():
    """The first is at rest already: nothing improves there."""
    cell, u, x0 = random_cell(2, 2, 3, 2, 2, 4), normal(4, 60, 2), normal(4, 3, seed=1)
    x0[0] = 0.0
    made = simulate(cell, u, x0)
    found = simulate_estimated(cell, u, made.y, torch.ones_like(made.y))
    assert_close(found.x[:, 0], x0, rtol=0, atol=1e-8)


def test_estimated_initial_state_that_has_faded_before_the_first_sample_that_counts_stays():
    cell, u = random_cell(1, 1, 2, 0, 0, radius=0.3), normal(1, 100, 1)
    y = simulate(cell, u, normal(1, 2)).y + 0.1 * normal(1, 100, 1, seed=3)
    weight = torch.ones_like(y)
    weight[:, :90] = 0.0
    assert torch.equal(simulate_estimated(cell, u, y, weight).x[:, 0], u.new_zeros(1, 2))


def test_estimated_initial_state_whose_response_overflows_stays():
    """The unstable state is not driven, but would be moved by its start."""
    cell, u = random_cell(1, 1, 2, 0, 0), normal(1, 2000, 1)
    with torch.no_grad():
        cell.A.copy_(torch.diag(torch.tensor([0.5, 2.0])))
        cell.Bu[1] = 0.0
    y = simulate(cell, u, u.new_zeros(1, 2)).y + 0.1
    found = simulate_estimated(cell, u, y, torch.ones_like(y))
    assert torch.equal(found.x[:, 0], u.new_zeros(1, 2))


@given(
    poles=st.sampled_from(POLES),
    sizes=st.tuples(st.integers(1, 2), st.integers(1, 2), st.integers(1, 3)),
    T=st.sampled_from([1, 2, 3, 20]),
    driven=st.sampled_from([0.0, 1.0]),
    shown=st.sampled_from([0.0, 1.0, 1.0]),
    unit=st.sampled_from([1e-6, 1.0, 1e6]),
    counted=st.sampled_from([0.0, 0.5, 1.0]),
    seed=st.integers(0, 1000),
)
@settings(max_examples=30)
def test_estimated_initial_state_fits_as_well_as_rest(
    poles: str,
    sizes: tuple[int, int, int],
    T: int,
    driven: float,
    shown: float,
    unit: float,
    counted: float,
    seed: int,
):
    """Of one sample as of many, of poles of all kinds, and where nothing is driven or shown."""
    (nu, ny, nx), rng = sizes, np.random.default_rng(seed)
    cell, u = random_cell(nu, ny, nx, 0, 0, seed=seed), driven * normal(1, T, nu, seed=seed)
    with torch.no_grad():
        cell.A.copy_(torch.as_tensor(special_poles(poles, nx, rng)))
        cell.Cy.mul_(shown)
    y = simulate(cell, u, normal(1, nx, seed=seed)).y + 0.1 * normal(1, T, ny, seed=seed + 1)
    weight = unit * torch.as_tensor((rng.random((1, T, ny)) < counted) * 1.0)

    def cost(y_hat: torch.Tensor) -> float:
        return float((weight * (y_hat - y)).square().sum())

    rest = cost(simulate(cell, u, u.new_zeros(1, nx)).y)
    for way in (estimated_start, start_from_beginning):
        found = simulate(cell, u, way(cell, u, y, weight))
        assert found.finite
        assert cost(found.y) <= (1.0 + 1e-6) * rest  # rounding
