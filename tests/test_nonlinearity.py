"""The one-hidden-layer map."""

import pytest
import torch
from reference import SIGMA, normal
from torch.testing import assert_close

from lfrtorch.nonlinearity import ACTIVATIONS, Network


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
    assert torch.equal(a.Wz, b.Wz)
    assert not torch.equal(a.Wz, c.Wz)


def test_unknown_activation():
    with pytest.raises(ValueError, match="activation is 'swish'; use one of rbf, relu, sigmoid, t"):
        Network(1, 1, 1, "swish")


def test_sizes_are_printed():
    assert repr(Network(2, 1, 3, "rbf")) == "Network(nz=2, nw=1, nn=3, activation='rbf')"
