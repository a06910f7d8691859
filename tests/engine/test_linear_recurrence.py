"""Both ways of the linear recurrence agree with the plain loop."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from reference import linear_loop, normal
from torch import Tensor
from torch.testing import assert_close
from torch.utils._python_dispatch import TorchDispatchMode

from lfrtorch.engine.linear_recurrence import linear_recurrence, scan

pytestmark = pytest.mark.numeric

LENGTHS = st.integers(1, 40)  # squares, primes, and one step among them
SIZES = st.integers(1, 4)


def problem(R: int, T: int, n: int, m: int, dtype: torch.dtype = torch.float64):
    F = normal(R, T, n, n, seed=1, dtype=dtype)
    F = 0.9 * F / torch.linalg.matrix_norm(F, 2, keepdim=True)
    return F, normal(R, T, n, m, seed=2, dtype=dtype), normal(R, n, m, seed=3, dtype=dtype)


def assert_same(s: Tensor, expected: Tensor, eps: float):
    # Each state is a sum of products along a contraction: a few eps of the largest term.
    assert_close(s, expected, rtol=0, atol=eps * float(1 + expected.abs().max()))


@given(R=st.integers(1, 3), T=LENGTHS, n=SIZES, m=SIZES)
@settings(max_examples=40)
def test_compiled_and_scan_agree_with_the_loop(R: int, T: int, n: int, m: int):
    F, g, s0 = problem(R, T, n, m)
    expected = linear_loop(F, g, s0)
    assert expected.shape == (R, T + 1, n, m)
    assert_same(linear_recurrence(F, g, s0), expected, 1e-12)
    assert_same(scan(F, g, s0), expected, 1e-12)


def test_loop_is_the_recurrence():
    F = torch.tensor([[[[2.0]], [[3.0]]]])
    g = torch.tensor([[[[1.0]], [[5.0]]]])
    assert linear_loop(F, g, torch.tensor([[[7.0]]])).flatten().tolist() == [7.0, 15.0, 50.0]


class Products(TorchDispatchMode):
    """Counts the products of matrices."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.count += "mm" in str(func)
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize("T", [1, 900, 930])
def test_scan_takes_3_root_of_T_products_at_most(T: int):
    F, g, s0 = problem(2, T, 3, 2)
    with Products() as products:
        s = scan(F, g, s0)
    assert_same(s, linear_loop(F, g, s0), 1e-12)
    assert 0 < products.count <= 3 * T**0.5


@pytest.mark.parametrize("way", [linear_recurrence, scan])
def test_single_precision_stays_single(way):
    F, g, s0 = problem(2, 30, 3, 2, torch.float32)
    s = way(F, g, s0)
    assert s.dtype == torch.float32
    assert_same(s, linear_loop(F, g, s0), 1e-5)


@pytest.mark.parametrize("way", [linear_recurrence, scan])
@pytest.mark.parametrize("shape", [(2, 5, 0, 3), (2, 5, 3, 0)])
def test_no_states_or_no_columns(way, shape):
    F, g, s0 = torch.zeros(2, 5, shape[2], shape[2]), torch.zeros(shape), torch.zeros(2, *shape[2:])
    assert way(F, g, s0).shape == (2, 6, *shape[2:])


@pytest.mark.parametrize("way", [linear_recurrence, scan])
def test_views_are_read_as_they_stand(way):
    F, g, s0 = problem(2, 12, 3, 3)
    F, g, s0 = F.mT.flip(1), g.mT, s0.mT  # what the adjoint passes
    assert_same(way(F, g, s0), linear_loop(F, g, s0), 1e-12)


@pytest.mark.usefixtures("fast")
def test_faded_states_are_zero_and_never_denormal():
    """Again and again: after the start, and after what drives them once more."""
    F = torch.full((2, 2600, 1, 1), 0.5, dtype=torch.float64)
    g, s0 = torch.zeros_like(F), torch.ones(2, 1, 1, dtype=torch.float64)
    g[:, 1300] = 1.0
    s = linear_recurrence(F, g, s0)
    assert_close(s, linear_loop(F, g, s0), rtol=0, atol=1e-30)
    size = s.abs()
    assert not ((size > 0) & (size < torch.finfo(s.dtype).tiny)).any()
    assert not s[:, -1].any()


def test_divergence_gives_infinite_states():
    F = torch.full((1, 2000, 1, 1), 2.0, dtype=torch.float64)
    s = linear_recurrence(F, torch.zeros_like(F), torch.ones(1, 1, 1, dtype=torch.float64))
    assert torch.isinf(s[0, -1]).all()
