"""Values and slopes that a network cannot leave."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from reference import normal
from torch.func import jacrev, vmap

from lfrtorch._support.types import Array
from lfrtorch.maps.activations import ACTIVATIONS
from lfrtorch.maps.enclosure import Interval, everywhere
from lfrtorch.maps.network import Network

pytestmark = pytest.mark.numeric


def network(nz: int, nw: int, activation: str, *, seed: int = 0) -> Network:
    static = Network(nz, nw, 6, activation, dtype=torch.float64)
    with torch.no_grad():
        for i, p in enumerate(static.parameters()):
            p.copy_(2.0 * normal(*p.shape, seed=10 * seed + i))
    return static


def samples(static: Network, box: Interval) -> tuple[Array, Array, Array]:
    """z in the box, its corners among them, with w and J."""
    part = np.random.default_rng(0).random((4000, len(box.low)))
    part[:100] = part[:100].round()
    z = torch.as_tensor(box.low + part * (box.high - box.low))
    with torch.no_grad():
        return z.numpy(), static(z).numpy(), vmap(jacrev(static))(z).numpy()


def holds(found: Interval, values: Array) -> bool:
    return bool(((values >= found.low) & (values <= found.high)).all())


@settings(max_examples=25)
@given(
    nz=st.integers(1, 4),
    nw=st.integers(1, 2),
    activation=st.sampled_from(sorted(ACTIVATIONS)),
    seed=st.integers(0, 100),
)
def test_no_value_or_slope_leaves_what_was_found(nz, nw, activation, seed):
    static = network(nz, nw, activation, seed=seed)
    low = normal(nz, seed=seed).numpy()
    box = Interval(low, low + np.abs(normal(nz, seed=seed + 1).numpy()))
    z, w, J = samples(static, box)
    found, anywhere = static.enclosure(box), static.enclosure(everywhere(nz))
    for each in (found, anywhere):
        assert holds(each.w, w)
        assert holds(each.J, J)
    K = normal(nw, nz, seed=seed + 2).numpy()
    assert holds(static.enclosure(box, K=K).w, w - z @ K.T)


@pytest.mark.parametrize("activation", sorted(ACTIVATIONS))
def test_one_input_is_bounded_closely(activation: str):
    static, box = network(1, 2, activation), Interval(np.array([-1.0]), np.array([2.0]))
    _, w, J = samples(static, box)
    found = static.enclosure(box)
    for interval, values in ((found.w, w), (found.J, J)):
        assert (2 * interval.radius <= 1.02 * np.ptp(values, axis=0) + 1e-9).all()


def test_a_point_is_a_box():
    static, z = network(2, 1, "tanh"), np.array([0.3, -0.2])
    found = static.enclosure(Interval(z, z))
    w = static(torch.as_tensor(z)).detach().numpy()
    assert found.w.middle == pytest.approx(w, rel=1e-9)
    assert found.w.radius == pytest.approx(0.0, abs=1e-9)


def test_what_else_is_known_of_the_neurons_leaves_cells_out():
    static = network(2, 1, "tanh")
    box = Interval(np.full(2, -1.0), np.full(2, 1.0))
    z, w, _ = samples(static, box)
    found = static.enclosure(box, Interval(np.full(6, -0.5), np.full(6, 0.5)))
    inside = (np.abs(z @ static.Wz.detach().numpy().T) <= 0.5).all(axis=1)
    assert inside.sum() > 10
    assert holds(found.w, w[inside])
    assert float(found.w.radius[0]) < 0.5 * float(static.enclosure(box).w.radius[0])
