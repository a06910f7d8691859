"""One step of the model."""

import pytest
import reference
import torch
from reference import normal, random_cell
from torch.nn import Module
from torch.testing import assert_close

from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.nonlinearity import Network, Polynomial

pytestmark = pytest.mark.numeric


def test_step_is_the_equations():
    cell = random_cell(2, 3, 4, 2, 1, 3)
    u, x = normal(5, 2), normal(5, 4, seed=1)
    y, x_next = cell(u, x)
    z, w = cell.internal(u, x)
    for r in range(5):
        expected = reference.nl_lfr(cell, reference.weights(cell), u[r : r + 1], x[r])
        for mine, other in ((x_next, expected.x[1]), (z, expected.z[0]), (w, expected.w[0])):
            assert_close(mine[r], other, rtol=1e-13, atol=1e-13)
        assert_close(y[r], expected.y[0], rtol=1e-13, atol=1e-13)


def test_matrices_start_at_zero():
    cell = LFRCell(2, 3, 4, 2, 1, Network(2, 1, 3))
    shapes = {name: tuple(p.shape) for name, p in cell.named_parameters(recurse=False)}
    assert shapes == {
        "A": (4, 4), "Bu": (4, 2), "Bw": (4, 1), "Cz": (2, 4), "Dzu": (2, 2),
        "Cy": (3, 4), "Dyu": (3, 2), "Dyw": (3, 1),
    }  # fmt: skip
    assert not any(p.any() for p in cell.parameters(recurse=False))


@pytest.mark.parametrize(
    ("nz", "nw", "static"),
    [(1, 1, None), (0, 0, Network(1, 1, 1)), (0, 1, Network(1, 1, 1)), (1, 0, Network(1, 1, 1))],
)
def test_sizes_that_do_not_fit_the_static_map(nz: int, nw: int, static):
    with pytest.raises(ValueError, match=f"nz={nz}, nw={nw} with static="):
        LFRCell(1, 1, 1, nz, nw, static)


def test_dtype_is_followed():
    cell = LFRCell(1, 1, 1, dtype=torch.float64)
    assert {p.dtype for p in cell.parameters()} == {torch.float64}
    assert "nu=1, ny=1, nx=1, nz=0, nw=0" in repr(cell)


@pytest.mark.parametrize(
    ("static", "name"), [(Network(3, 1, 2), "static.Wz"), (Polynomial(1, 1, 2), "static.C")]
)
def test_a_static_map_of_other_sizes_is_refused(static: Module, name: str):
    with pytest.raises(ValueError, match=rf"{name} has the shape .* nz=2 and nw=1 it is"):
        LFRCell(1, 1, 3, 2, 1, static)


@pytest.mark.parametrize(("u", "x"), [((5, 8), (5, 4)), ((5, 2), (5, 1))])
def test_a_step_refuses_signals_of_other_shapes(u: tuple[int, ...], x: tuple[int, ...]):
    with pytest.raises(ValueError, match=r"has the shape .*; give \("):
        random_cell(2, 3, 4, 2, 1, 3)(normal(*u), normal(*x))
