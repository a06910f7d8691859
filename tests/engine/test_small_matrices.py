"""Decompositions of small matrices: against LAPACK, and where rank is missing."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lfrtorch.engine.small_matrices import reflect, svd

pytestmark = pytest.mark.numeric


def matrix(m: int, n: int, rank: int, scale: float, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    left, right = rng.standard_normal((m, rank)), rng.standard_normal((rank, n))
    return left @ right * np.logspace(0.0, scale, n)


@given(
    sizes=st.sampled_from([(1, 1), (3, 3), (7, 2), (20, 6)]),
    missing=st.integers(0, 2),
    scale=st.sampled_from([0.0, -6.0, 6.0]),
    seed=st.integers(0, 1000),
)
def test_singular_values_and_vectors(sizes: tuple[int, int], missing: int, scale: float, seed: int):
    m, n = sizes
    M = matrix(m, n, max(0, n - missing), scale, seed)
    U, s, V = svd(M)
    norm = float(np.linalg.norm(M))
    # Each rotation rounds: a few times eps, relative to the largest singular value.
    np.testing.assert_allclose(U * s @ V.T, M, rtol=0, atol=1e-13 * norm)
    np.testing.assert_allclose(np.sort(s)[::-1], np.linalg.svd(M)[1], rtol=0, atol=1e-13 * norm)
    np.testing.assert_allclose(V.T @ V, np.eye(n), rtol=0, atol=1e-13)
    seen = U[:, s > 1e-10 * s.max(initial=0.0)]
    np.testing.assert_allclose(seen.T @ seen, np.eye(seen.shape[1]), rtol=0, atol=1e-5)


@given(rows=st.integers(1, 5), more=st.integers(0, 30), seed=st.integers(0, 1000))
def test_reflections_keep_products_and_leave_a_triangle(rows: int, more: int, seed: int):
    M = matrix(rows + 2, rows + more, rows, 0.0, seed)
    found = M.copy()
    reflect(found, rows)
    np.testing.assert_allclose(found @ found.T, M @ M.T, rtol=0, atol=1e-12 * np.sum(M**2))
    assert not np.triu(found[:rows], 1).any()
