"""The numbers in an activation's row belong together; exports check its texts."""

import numpy as np
import pytest
import torch
from numpy.typing import ArrayLike
from reference import SIGMA

from lfrtorch._support.types import Array
from lfrtorch.maps.activations import ACTIVATIONS

pytestmark = pytest.mark.numeric


def test_every_activation_has_an_equation_and_machine_code_of_its_own():
    assert list(ACTIVATIONS) == list(SIGMA)
    assert [sigma.code for sigma in ACTIVATIONS.values()] == list(range(len(SIGMA)))


@pytest.mark.parametrize("activation", SIGMA)
def test_bounds_are_those_of_many_points(activation: str):
    sigma, v = ACTIVATIONS[activation], np.linspace(-40.0, 40.0, 80_001)
    slopes = sigma.slopes(v)
    assert sigma.slope_bounds == pytest.approx((slopes.min(), slopes.max()), abs=1e-6)
    assert sigma.bounded == (np.abs(sigma.values(v)).max() <= 1.0)
    at = torch.as_tensor(v).requires_grad_()
    SIGMA[activation](at).sum().backward()
    assert at.grad is not None
    np.testing.assert_allclose(slopes, at.grad.numpy(), atol=1e-12)


@pytest.mark.parametrize("activation", SIGMA)
def test_mean_slopes_are_exact_and_become_the_slope(activation: str):
    v = np.linspace(-6.0, 6.0, 41)[:, None]
    far = np.array([-40.0, -3.0, -1.0, -0.4, 0.5, 1.0, 2.0, 40.0])
    sigma = SIGMA[activation]

    def mean_slope(v: Array, d: ArrayLike) -> Array:
        return ACTIVATIONS[activation].mean_slope(*np.broadcast_arrays(v, np.asarray(d)))

    value = sigma(torch.as_tensor(v + far)) - sigma(torch.as_tensor(v))
    np.testing.assert_allclose(mean_slope(v, far) * far, value, rtol=1e-12, atol=1e-13)
    at = torch.as_tensor(v, dtype=torch.float64).requires_grad_()
    sigma(at).sum().backward()
    assert at.grad is not None
    smooth = np.abs(v) > 1e-3 if activation == "relu" else np.full(v.shape, True)
    for near in (0.0, 1e-15, -1e-9):
        found = mean_slope(v, near)
        np.testing.assert_allclose(found[smooth], at.grad.numpy()[smooth], atol=3e-9)
    low, high = ACTIVATIONS[activation].slope_bounds
    slopes = mean_slope(v, np.linspace(-50.0, 50.0, 301))
    assert low - 1e-12 <= slopes.min()
    assert slopes.max() <= high + 1e-12
