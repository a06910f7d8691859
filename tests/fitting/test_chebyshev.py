"""Chebyshev polynomials of several variables against numpy's of one, and their slope."""

import numpy as np
import pytest
from numpy.polynomial import chebyshev as oracle

from lfrtorch.fitting.chebyshev import REACH, chebyshev, chebyshev_slope

pytestmark = pytest.mark.numeric


@pytest.mark.parametrize("degree", [1, 2, 5])
def test_one_variable(degree: int):
    z = np.linspace(-4, 4, 20)
    np.testing.assert_allclose(
        chebyshev(z[:, None], degree), oracle.chebvander(z / REACH, degree), rtol=1e-12, atol=1e-12
    )


def test_total_degree():
    z = np.random.default_rng(0).normal(size=(100, 3))
    phi = chebyshev(z, 3)
    assert phi.shape == (100, 20)  # 6! / (3! 3!)
    for monomial in (z[:, 0] * z[:, 1] * z[:, 2], z[:, 2] ** 3, np.ones(100)):
        beta = np.linalg.lstsq(phi, monomial, rcond=None)[0]
        np.testing.assert_allclose(phi @ beta, monomial, atol=1e-10)
    beyond = z[:, 0] ** 2 * z[:, 1] ** 2
    assert np.abs(phi @ np.linalg.lstsq(phi, beyond, rcond=None)[0] - beyond).max() > 0.1


@pytest.mark.parametrize(("nz", "degree"), [(1, 1), (1, 4), (3, 3)])
def test_slope(nz: int, degree: int):
    z, h = np.random.default_rng(0).normal(size=(2, 5, nz)), 1e-5
    slope = chebyshev_slope(z, degree)
    for i, step in enumerate(h * np.eye(nz)):
        expected = (chebyshev(z + step, degree) - chebyshev(z - step, degree)) / (2 * h)
        np.testing.assert_allclose(slope[..., i], expected, atol=1e-8)  # h² and eps / h
