"""Jacobians of the static map at every sample against autograd, one sample at a time."""

import pytest
import torch
from reference import normal
from torch import Tensor, nn
from torch.func import functional_call
from torch.testing import assert_close

from lfrtorch.maps.activations import ACTIVATIONS
from lfrtorch.maps.linearised import LinearisedMap, TorchMap, linearise_map
from lfrtorch.maps.network import Network
from lfrtorch.maps.polynomial import Polynomial
from lfrtorch.maps.static_map import as_map

pytestmark = [pytest.mark.numeric, pytest.mark.usefixtures("fast")]

R, T, nz, nw = 2, 5, 2, 3


class Bend(nn.Module):
    """A user's map with parameters of two shapes, one of them scalar."""

    def __init__(self) -> None:
        super().__init__()
        self.gain, self.W = nn.Parameter(torch.tensor(0.7)), nn.Parameter(torch.ones(nw, nz))
        self.double()

    def forward(self, z: Tensor) -> Tensor:
        return self.gain * torch.sin(z @ self.W.mT) ** 2


class Cube(nn.Module):
    """A map without parameters."""

    def forward(self, z: Tensor) -> Tensor:
        return z**3


def network(activation: str) -> Network:
    static = Network(nz, nw, 4, activation, dtype=torch.float64)
    for p, weight in zip(static.parameters(), weights_of(static).values(), strict=True):
        p.data = weight
    return static


def weights_of(static: nn.Module, seed: int = 1) -> dict[str, Tensor]:
    named = enumerate(static.named_parameters())
    return {name: normal(p.numel(), seed=seed + i).reshape(p.shape) for i, (name, p) in named}


def expected_slopes(static: nn.Module, weights: dict[str, Tensor], z: Tensor):
    """J and by_weight of one sample z (nz,)."""
    leaves = {name: p.clone().requires_grad_() for name, p in weights.items()}
    z = z.clone().requires_grad_()
    J, by_weight = [], []
    for w_q in functional_call(static, leaves, (z,)):
        dz, *dp = torch.autograd.grad(w_q, (z, *leaves.values()), retain_graph=True)
        J.append(dz)
        by_weight.append(torch.cat([torch.zeros(0), *(d.flatten() for d in dp)]))
    return torch.stack(J), torch.stack(by_weight)


def linearised(static: nn.Module | None, z: Tensor, weights: dict[str, Tensor], nw: int):
    """The map in machine code, if it has any, and by torch."""
    own = as_map(static, z.shape[-1], nw)
    phi = torch.cat([z.new_zeros(0), *(w.flatten() for w in weights.values())])
    return linearise_map(own, z, phi, own.code), TorchMap(own, z, phi)


def check(static: nn.Module, weights: dict[str, Tensor], z: Tensor, nw: int = nw):
    for found in linearised(static, z, weights, nw):
        _check(found, static, weights, z)


def _check(found: LinearisedMap, static: nn.Module, weights: dict[str, Tensor], z: Tensor):
    by_weight = found.by_weight()
    for r in range(R):
        for k in range(T):
            J, by = expected_slopes(static, weights, z[r, k])
            assert_close(found.J[r, k], J, rtol=1e-12, atol=1e-14)
            assert_close(by_weight[r, k], by.double(), rtol=1e-12, atol=1e-14)
    direction, d_w = normal(by_weight.shape[-1], seed=8), normal(*by_weight.shape[:3], seed=9)
    assert_close(found.tangent(direction), by_weight @ direction, rtol=1e-12, atol=1e-12)
    expected = (by_weight * d_w.unsqueeze(-1)).sum(dim=(1, 2))
    assert_close(found.adjoint(d_w), expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("activation", sorted(ACTIVATIONS))
def test_network(activation: str):
    static, z = network(activation), normal(R, T, nz)
    weights = weights_of(static)
    check(static, weights, z, nw)


@pytest.mark.parametrize("degree", [1, 2, 3, 5])
@pytest.mark.parametrize("nz", [1, 2, 3])
@pytest.mark.parametrize("nw", [1, 3])
def test_polynomial(nz: int, nw: int, degree: int):
    static, z = Polynomial(nz, nw, degree, dtype=torch.float64), normal(R, T, nz)
    weights = weights_of(static)
    check(static, weights, z, nw)


def test_own_module():
    static, z = Bend(), normal(R, T, nz)
    weights = weights_of(static)
    check(static, weights, z, nw)


def test_map_without_parameters():
    z = normal(R, T, nz)
    for found in linearised(Cube(), z, {}, nz):
        assert_close(found.J, torch.diag_embed(3 * z**2), rtol=1e-14, atol=0)
        assert found.by_weight().shape == (R, T, nz, 0)
        assert found.adjoint(z).shape == (R, 0)
        assert torch.equal(found.tangent(z.new_zeros(0)), torch.zeros_like(z))


def test_no_map():
    for found in linearised(None, normal(R, T, 0), {}, 0):
        assert found.J.shape == (R, T, 0, 0)
        assert found.by_weight().shape == (R, T, 0, 0)
