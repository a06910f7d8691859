"""Recurrences without F(k) are those with it, in machine code and in torch."""

from collections.abc import Callable
from functools import partial
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch.testing import assert_close

from lfrtorch.engine import feedback_recurrence
from lfrtorch.engine.feedback_recurrence import states, transition
from lfrtorch.engine.linearised import linearise_at

pytestmark = pytest.mark.numeric


@pytest.fixture(params=["compiled", "torch"], autouse=True)
def way(request: pytest.FixtureRequest, fast: Callable[[bool], None]):
    """On the CPU, and as on any other device."""
    fast(request.param == "compiled")


def weights(nx: int, nz: int, nw: int, dtype: torch.dtype) -> Any:
    """Random matrices of a stable model."""
    generator = torch.Generator().manual_seed(nx + nz)
    sizes = {"A": (nx, nx), "Bw": (nx, nw), "Cz": (nz, nx), "Cy": (1, nx), "Dyw": (1, nw)}
    found = {
        name: torch.randn(*size, generator=generator, dtype=dtype) for name, size in sizes.items()
    }
    found["A"] *= 0.5 / nx**0.5
    return SimpleNamespace(**found, nx=nx)


@pytest.mark.parametrize(("nx", "nz", "nw"), [(1, 1, 1), (5, 2, 3), (9, 4, 2)])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_they_are_the_recurrences_of_the_products(nx: int, nz: int, nw: int, dtype: torch.dtype):
    R, T = 2, 300
    generator = torch.Generator().manual_seed(0)
    W = weights(nx, nz, nw, dtype)
    J = 0.3 * torch.randn(R, T, nw, nz, generator=generator, dtype=dtype)
    J /= W.Bw.norm() * W.Cz.norm()
    g = torch.randn(R, T, nx, generator=generator, dtype=dtype)
    s0 = torch.randn(R, nx, generator=generator, dtype=dtype)
    F = linearise_at(W, J).F
    ahead, back, Phi = [s0], [s0], torch.eye(nx, dtype=dtype).expand(R, nx, nx)
    for k in range(T):
        ahead.append((F[:, k] @ ahead[-1].unsqueeze(-1)).squeeze(-1) + g[:, k])
        last = T - 1 - k
        back.append((F[:, last].mT @ back[-1].unsqueeze(-1)).squeeze(-1) + g[:, last])
        Phi = F[:, k] @ Phi if k < 21 else Phi
    assert_near = partial(assert_close, rtol=1e-9, atol=1e-9)
    if dtype == torch.float32:
        assert_near = partial(assert_close, rtol=1e-3, atol=1e-3)
    assert_near(states(W, J, g, s0), torch.stack(ahead, 1))
    assert_near(states(W, J, g, s0, backwards=True), torch.stack(back[::-1], 1))
    eye = torch.eye(nx, dtype=dtype).expand(R, nx, nx)
    assert_near(transition(W, J[:, :21], eye), Phi)
    # In two parts it is the same.
    half = transition(W, J[:, :9], eye)
    assert_near(transition(W, J[:, 9:21], half), Phi)
    assert_close(eye, torch.eye(nx, dtype=dtype).expand(R, nx, nx))  # it stays as it is


def test_what_has_faded_is_zero_and_what_overflows_is_not_finite():
    W = weights(3, 1, 1, torch.float64)
    eye = torch.eye(3, dtype=torch.float64).unsqueeze(0)
    none = torch.zeros(1, 4000, 1, 1, dtype=torch.float64)
    assert transition(W, none, eye).abs().max() < 1e-30
    growing: Any = SimpleNamespace(**vars(W) | {"A": 10.0 * eye[0]})
    assert not torch.isfinite(transition(growing, none, eye)).all()
    assert (
        feedback_recurrence.states(W, none, torch.zeros(1, 4000, 3).double(), eye[:, 0])[0, -1]
        .abs()
        .max()
        < 1e-30
    )
