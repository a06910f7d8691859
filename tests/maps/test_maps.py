"""The one-hidden-layer map and the polynomial."""

from itertools import product
from math import comb, prod

import numpy as np
import pytest
import torch
from reference import SIGMA, normal
from torch.func import functional_call, jacrev, vmap
from torch.testing import assert_close

from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.simulation import simulate
from lfrtorch.maps.activations import ACTIVATIONS
from lfrtorch.maps.network import Network
from lfrtorch.maps.polynomial import Polynomial

pytestmark = pytest.mark.numeric

# --- the network ----------------------------------------------------------------------------


@pytest.mark.parametrize("activation", sorted(ACTIVATIONS))
def test_network_is_its_equation(activation: str):
    network = Network(2, 3, 4, activation, dtype=torch.float64)
    with torch.no_grad():
        network.bw.copy_(normal(3))
    z = normal(5, 7, 2)
    w = network(z)
    assert w.shape == (5, 7, 3)
    for index in ((0, 0), (4, 6)):
        hidden = SIGMA[activation](network.Wz @ z[index] + network.bz)
        assert_close(w[index], network.Ww @ hidden + network.bw, rtol=1e-13, atol=1e-14)


def test_draw_is_that_of_the_paper():
    network = Network(20, 20, 100)
    network.reset_parameters(torch.Generator().manual_seed(0))
    for weight in (network.Wz, network.bz, network.Ww):
        values = weight.detach()
        assert -1 <= values.min() < -0.9
        assert 0.9 < values.max() <= 1
        # Variance of U(-1, 1), within 4 σ of its estimate.
        assert abs(float(values.var()) - 1 / 3) < 4 * (4 / 45 / values.numel()) ** 0.5
    assert not network.bw.any()


def test_draw_follows_its_generator():
    a, b, c = (Network(2, 2, 3) for _ in range(3))
    for network, seed in ((a, 1), (b, 1), (c, 2)):
        network.reset_parameters(torch.Generator().manual_seed(seed))
    for mine, same, other in zip(a.parameters(), b.parameters(), c.parameters(), strict=True):
        assert torch.equal(mine, same)
        assert not torch.equal(mine, other) or mine is a.bw


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_softplus_far_from_its_corner(dtype: torch.dtype):
    """Neither overflow above nor zeros below, in torch and in machine code."""
    static = Network(1, 1, 1, "softplus", dtype=dtype)
    cell = LFRCell(1, 1, 1, 1, 1, static, dtype=dtype, random=False)
    with torch.no_grad():
        for weight in (cell.Dzu, cell.Dyw, static.Wz, static.Ww):
            weight.fill_(1.0)
        static.bz.zero_()
    points = [-1e4, -30.0, -1.0, 0.0, 1.0, 30.0, 1e4]
    both = np.array([points, np.logaddexp(0.0, points)])
    v, expected = torch.as_tensor(both, dtype=dtype).unsqueeze(-1)
    y = simulate(cell, v.unsqueeze(0), v.new_zeros(1, 1)).y[0]
    for found in (static(v), y):  # machine code has exp(-700) for what is less
        assert_close(found, expected, rtol=4 * torch.finfo(dtype).eps, atol=1e-300)


def test_unknown_activation():
    with pytest.raises(ValueError, match="activation is 'swish'; use one of rbf, relu, sigmoid, s"):
        Network(1, 1, 1, "swish")


def test_sizes_are_printed():
    assert repr(Network(2, 1, 3, "rbf")) == "Network(nz=2, nw=1, nn=3, activation='rbf')"


# --- polynomial -----------------------------------------------------------------------------


def monomials(z: tuple[float, ...], degree: int) -> list[float]:
    """Every one, by its exponents."""
    exponents = [e for e in product(range(degree + 1), repeat=len(z)) if sum(e) <= degree]
    return [prod(z_j**e_j for z_j, e_j in zip(z, e, strict=True)) for e in exponents]


@pytest.mark.parametrize("degree", [1, 2, 3, 5])
@pytest.mark.parametrize("nz", [1, 2, 3])
def test_polynomial_has_every_monomial_once(nz: int, degree: int):
    polynomial = Polynomial(nz, comb(nz + degree, degree), degree, dtype=torch.float64)
    with torch.no_grad():
        polynomial.C.copy_(torch.eye(len(polynomial.C)))
    z = (2.0, 3.0, 5.0)[:nz]  # primes: no two monomials are equal
    values = polynomial(torch.tensor(z, dtype=torch.float64)).tolist()
    assert sorted(values) == sorted(monomials(z, degree))
    assert values[: nz + 1] == [1.0, *z]


def test_polynomial_of_one_variable_is_that_of_horner():
    polynomial = Polynomial(1, 2, 3, dtype=torch.float64)
    with torch.no_grad():
        polynomial.C.copy_(normal(2, 4))
    z = normal(5, 7, 1)
    w = polynomial(z)
    assert w.shape == (5, 7, 2)
    for i, (c0, c1, c2, c3) in enumerate(polynomial.C):
        expected = c0 + z[..., 0] * (c1 + z[..., 0] * (c2 + z[..., 0] * c3))
        assert_close(w[..., i], expected, rtol=1e-13, atol=1e-13)


def test_slopes_of_a_polynomial_by_torch_func():
    polynomial = Polynomial(2, 1, 2, dtype=torch.float64)
    with torch.no_grad():
        polynomial.C.copy_(normal(1, 6))
    c = polynomial.C[0].detach()  # 1, z1, z2, z1², z1 z2, z2²
    z = torch.cat([normal(4, 2), torch.zeros(1, 2, dtype=torch.float64)])

    def w(z_k, C):
        return functional_call(polynomial, {"C": C}, (z_k,))

    by_z, by_c = vmap(jacrev(w, argnums=(0, 1)), in_dims=(0, None))(z, polynomial.C.detach())
    z1, z2 = z.unbind(-1)
    slopes = torch.stack([c[1] + 2 * c[3] * z1 + c[4] * z2, c[2] + c[4] * z1 + 2 * c[5] * z2], -1)
    assert_close(by_z[:, 0], slopes, rtol=1e-13, atol=1e-13)
    m = torch.stack([torch.ones_like(z1), z1, z2, z1**2, z1 * z2, z2**2], -1)
    assert_close(by_c[:, 0, 0], m, rtol=1e-13, atol=1e-13)


def test_a_polynomial_has_one_parameter_and_stores_nothing_else():
    polynomial = Polynomial(2, 3, 4)
    assert [name for name, _ in polynomial.named_parameters()] == ["C"]
    assert list(polynomial.state_dict()) == ["C"]
    assert polynomial.C.shape == (3, 15)
    assert polynomial.double()(normal(2)).dtype == torch.float64


def test_draw_of_a_polynomial():
    drawn = [Polynomial(3, 50, 4) for _ in range(2)]
    for polynomial in drawn:
        polynomial.reset_parameters(torch.Generator().manual_seed(0))
    C = drawn[0].C.detach()
    assert torch.equal(C, drawn[1].C)
    assert not C[:, 0].any()
    assert C[:, 1:].abs().max() * C.shape[1] == pytest.approx(1, abs=0.01)
    assert drawn[0](torch.rand(1000, 3) * 2 - 1).abs().max() <= 1


@pytest.mark.parametrize("degree", [0, -1, 1.5, True])
def test_degree_that_is_none(degree):
    with pytest.raises(ValueError, match=f"degree is {degree}; give a whole number of at least 1"):
        Polynomial(1, 1, degree)


def test_sizes_of_a_polynomial_are_printed():
    assert repr(Polynomial(2, 1, 3)) == "Polynomial(nz=2, nw=1, degree=3)"
