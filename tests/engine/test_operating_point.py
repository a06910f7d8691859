"""Rest under a constant input, and the linearisation there."""

import pytest
import torch
from reference import normal, random_cell
from torch.func import jacrev
from torch.testing import assert_close

from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.operating_point import equilibrium, linearised_at
from lfrtorch.maps.polynomial import Polynomial

pytestmark = pytest.mark.numeric


def feedback(degree: int, **coefficients: float) -> LFRCell:
    """x+ = a x + u + p(x), y = x; p by the names of its coefficients c0, c1, ..."""
    cell = LFRCell(1, 1, 1, 1, 1, Polynomial(1, 1, degree), random=False).double()
    assert isinstance(cell.static, Polynomial)
    with torch.no_grad():
        for one in (cell.Bu, cell.Bw, cell.Cz, cell.Cy):
            one.fill_(1.0)
        cell.A.fill_(coefficients.pop("a"))
        cell.static.C.zero_()
        for name, value in coefficients.items():
            cell.static.C[0, int(name[1:])] = value
    return cell


def test_rest_is_where_a_long_simulation_ends():
    cell = random_cell(nu=2, nx=4, nz=2, nw=2)
    u = 3.0 * normal(2)
    x = u.new_zeros(4)
    for _ in range(400):
        x = cell(u, x)[1].detach()
    found = equilibrium(cell, u)
    assert found is not None
    assert_close(found, x, rtol=0, atol=1e-9)


def test_an_unstable_rest_is_found_and_one_that_is_none_is_not():
    """x = 2 x + u - x³ / 8 has its rest at 0 for u = 0, and stays nowhere near it."""
    found = equilibrium(feedback(3, a=2.0, c3=-0.125), normal(1) * 0)
    assert found is not None
    assert found.item() == 0.0
    nowhere = feedback(2, a=1.0, c0=1.0, c2=1.0)  # x+ - x = 1 + x²
    assert equilibrium(nowhere, normal(1) * 0) is None


def test_an_integrator_rests_where_its_input_stands_still():
    cell = feedback(3, a=1.0)
    assert equilibrium(cell, torch.zeros(1, dtype=torch.float64)) is not None
    assert equilibrium(cell, torch.ones(1, dtype=torch.float64)) is None


@pytest.mark.parametrize("static", [None, Polynomial(2, 2, 3), torch.nn.Linear(2, 2).double()])
def test_linearisation_is_the_derivative_of_a_step(static: torch.nn.Module | None):
    cell = random_cell(nu=2, ny=3, nx=4, nz=2, nw=2, static=static)
    u, x = normal(2), normal(4, seed=1)
    found = linearised_at(cell, u, x)
    C, A = jacrev(lambda x: cell(u, x))(x)
    D, B = jacrev(lambda u: cell(u, x))(u)
    for given, expected in zip(found, (A, B, C, D), strict=True):
        assert_close(torch.as_tensor(given), expected.detach(), rtol=0, atol=1e-12)
