"""Running factors and damped systems against the plain formulas."""

import math

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from reference import MATRICES, normal, special_matrix
from torch import Tensor
from torch.testing import assert_close

from lfrtorch.least_squares.linear_systems import (
    KRYLOV,
    WIDE,
    CholeskySystem,
    GramAccumulator,
    QRAccumulator,
    ReducedSystem,
    SVDSystem,
)

pytestmark = pytest.mark.numeric


def squares(factor: QRAccumulator | GramAccumulator) -> Tensor:
    return factor.R.mT @ factor.R if isinstance(factor, QRAccumulator) else factor.G


@pytest.mark.parametrize("kind", [QRAccumulator, GramAccumulator])
@pytest.mark.parametrize("threads", [1, 3])
def test_blocks_are_one_piece(kind, threads: int, monkeypatch):
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    rows, factor = normal(300, 7), kind()
    for block in rows.split([1, 3, 40, 200, 56]):
        factor.fold(block)
    assert_close(squares(factor), rows.mT @ rows, rtol=1e-12, atol=1e-11)


@pytest.mark.usefixtures("fast")
@pytest.mark.parametrize("threads", [1, 3])
def test_blocks_of_many_columns(threads: int, monkeypatch):
    """In panels, and in pieces where a block is tall; more columns than a panel count divides."""
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    n = WIDE + 3
    rows, factor = normal(20 * n, n), GramAccumulator()
    for block in rows.split([n, 2, 18 * n, n - 2]):
        factor.fold(block)
    assert_close(factor.G, rows.mT @ rows, rtol=1e-11, atol=1e-9)
    assert torch.equal(factor.G, factor.G.mT)


def test_many_small_blocks_do_not_pile_up():
    rows, factor = normal(500, 3), QRAccumulator()
    for block in rows.split(5):
        factor.fold(block)
        assert sum(map(len, factor._parts)) <= 16 * 3 + 3
    assert_close(squares(factor), rows.mT @ rows, rtol=1e-12, atol=1e-11)


@pytest.mark.parametrize("kind", [QRAccumulator, GramAccumulator])
def test_absorbed_rows_have_their_columns_tied_and_placed(kind):
    """Of six columns three depend on the first two, and the last one stays."""
    rows, others, tie = normal(50, 4), normal(60, 6, seed=1), normal(3, 2, seed=2)
    total, other = kind(), kind()
    total.fold(rows)
    other.fold(others)
    place = torch.tensor([2, 0, 3])
    total.absorb(other, place, 4, tie)
    wide = normal(60, 4) * 0
    wide[:, [2, 0]] = others[:, :2] + others[:, 2:5] @ tie
    wide[:, 3] = others[:, 5]
    whole = torch.cat([rows, wide])
    assert_close(squares(total), whole.mT @ whole, rtol=1e-11, atol=1e-10)


@pytest.mark.parametrize("damping", [1e-6, 1.0, 1e6])
def test_systems_are_the_normal_equations(damping: float):
    J, gradient = normal(20, 6), normal(6, seed=1)
    G = J.mT @ J
    expected = -torch.linalg.solve(G + damping * torch.eye(6), gradient)
    for system in (SVDSystem(J, 1e-12), CholeskySystem(G, 6)):
        assert system.rank == 6
        assert system.scale == pytest.approx(float(torch.linalg.eigvalsh(G)[-1]), rel=1e-12)
        assert_close(system.solve(gradient, damping), expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("ridge", [0.0, 0.3])
def test_reduced_system_is_that_of_all_columns(ridge: float):
    """Four columns of which seven are combinations; a gradient that J sees, or any with a ridge."""
    own, expand = normal(20, 4), torch.cat([torch.eye(4).double(), normal(4, 3, seed=1)], dim=1)
    J = own @ expand
    G = J.mT @ J + ridge * torch.eye(7, dtype=J.dtype)
    gradient = normal(7, seed=2) if ridge else J.mT @ normal(20, seed=2)
    system = ReducedSystem(own.mT @ own, expand, ridge)
    assert system.rank == 4
    assert system.scale == pytest.approx(float(torch.linalg.eigvalsh(G)[-1]), rel=1e-12)
    for damping in (1e-3, 1.0, 1e6):
        expected = -torch.linalg.solve(G + damping * torch.eye(7), gradient)
        assert_close(system.solve(gradient, damping), expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
def test_orthogonal_system_leaves_out_what_is_truncated(unit: float):
    R = unit * torch.diag(torch.tensor([1.0, 1e-3, 1e-13], dtype=torch.float64))
    system = SVDSystem(R, 1e-12)
    assert system.rank == 2
    gradient = unit**2 * torch.ones(3, dtype=torch.float64)
    expected = torch.tensor([-1.0, -1e6, 0.0], dtype=torch.float64)
    assert_close(system.solve(gradient, 1e-30), expected, rtol=1e-5, atol=0)


def test_normal_system_that_rounding_made_indefinite_gives_nan():
    G = torch.diag(torch.tensor([1.0, -1e-8], dtype=torch.float64))
    assert torch.isnan(CholeskySystem(G, 2).solve(torch.ones(2).double(), 1e-9)).all()


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_entries_that_are_not_finite_have_no_scale(bad: float):
    G = torch.eye(3, dtype=torch.float64)
    G[0, 1] = bad
    assert math.isnan(CholeskySystem(G, 3).scale)
    assert math.isnan(SVDSystem(G, 1e-12).scale)


def test_singular_values_whose_squares_overflow_have_an_infinite_scale():
    assert SVDSystem(torch.tensor([[1e200]], dtype=torch.float64), 1e-12).scale == math.inf


@pytest.mark.parametrize("rows", [4, 6, 20])
def test_inverse_is_the_pseudo_inverse(rows: int):
    """Of JᵀJ, with directions that J does not see and with a column of zeros."""
    J = normal(rows, 6)
    J[:, 2] = 0.0
    J[:, 5] = J[:, 0] - J[:, 1]
    G, inverse = J.mT @ J, SVDSystem(J, 1e-12).inverse
    # eps times |G| = 70 times its condition 90: 1e-12.
    for product in (G @ inverse, inverse @ G):
        assert_close(product, product.mT, rtol=0, atol=1e-11)
    assert_close(G @ inverse @ G, G, rtol=0, atol=1e-11)
    assert_close(inverse @ G @ inverse, inverse, rtol=1e-11, atol=1e-11)
    assert_close(inverse, torch.linalg.pinv(G, rtol=1e-12), rtol=1e-10, atol=1e-10)
    assert torch.equal(inverse[2], torch.zeros(6, dtype=torch.float64))


@pytest.mark.parametrize("spread", [1.0, 1e-6])
def test_the_largest_eigenvalue_of_many_parameters(spread: float):
    # That of a matrix with one that stands out, and with neighbours of one size.
    generator = torch.Generator().manual_seed(0)
    J = torch.randn(KRYLOV + 50, KRYLOV + 20, generator=generator, dtype=torch.float64)
    J[:, 0] *= 1.0 + 10.0 * spread
    G = J.mT @ J
    expected = float(torch.linalg.eigvalsh(G)[-1])
    assert CholeskySystem(G, len(G)).scale == pytest.approx(expected, rel=1e-9)
    assert CholeskySystem(torch.zeros_like(G), 0).scale == 0.0


@given(
    rows=st.lists(st.sampled_from([0, 1, 2, 7, 90]), min_size=1, max_size=4),
    columns=st.integers(1, 7),
    kind=st.sampled_from(MATRICES),
    unit=st.floats(-12.0, 12.0),
    damping=st.sampled_from([1e-6, 1.0, 1e3]),
    seed=st.integers(0, 1000),
)
@example(rows=[0], columns=3, kind="normal", unit=0.0, damping=1.0, seed=0)  # had no singular value
@settings(max_examples=60)
def test_steps_of_any_rows_are_those_of_dense_least_squares(
    rows: list[int], columns: int, kind: str, unit: float, damping: float, seed: int
):
    """In blocks of any height, of no rank or little, and in any unit."""
    rng = np.random.default_rng(seed)
    J = 10.0**unit * special_matrix(kind, sum(rows), columns, rng)
    r = rng.normal(size=len(J))
    R, G, gradient = QRAccumulator(), GramAccumulator(), torch.as_tensor(J.T @ r)
    for block in torch.as_tensor(J).split(rows):
        R.fold(block)
        G.fold(block)
    systems = SVDSystem(R.R, 1e-12), CholeskySystem(G.G, columns)
    size = float(np.linalg.norm(J, 2)) if J.any() else 0.0
    damping *= max(size**2, 1e-300)
    whole = np.vstack([J, math.sqrt(damping) * np.eye(columns)])
    expected = np.linalg.lstsq(whole, np.concatenate([-r, np.zeros(columns)]), rcond=None)[0]
    # What is truncated of the gradient |J| |r|, and in JᵀJ eps of its square, over the damping.
    atol = 2e-12 * (1.0 + size**2 / damping) * size * float(np.linalg.norm(r)) / damping
    for system in systems:
        assert system.scale == pytest.approx(size**2, rel=1e-12)
        step = system.solve(gradient, damping).numpy()
        np.testing.assert_allclose(step, expected, rtol=0, atol=atol)


def test_squares_beyond_single_precision_have_no_scale_and_give_no_warning():
    G = GramAccumulator()
    G.fold(torch.full((3, 2), 1e20))
    assert not math.isfinite(CholeskySystem(G.G, 2).scale)


def test_a_matrix_on_which_the_fast_factorisation_ends_is_factorised_by_the_sure_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    J = torch.randn(9, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    expected = SVDSystem(J, 1e-12)

    def ends(*_: object, **__: object) -> None:
        raise torch.linalg.LinAlgError("the algorithm did not converge")  # pyright: ignore[reportPrivateImportUsage]

    monkeypatch.setattr(torch.linalg, "svd", ends)
    found = SVDSystem(J, 1e-12)
    torch.testing.assert_close(found.inverse, expected.inverse)
