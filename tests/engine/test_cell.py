"""One step of the model."""

import pytest
import reference
import torch
from reference import normal, random_cell
from torch.nn import Module
from torch.testing import assert_close

from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.lfr import LFR
from lfrtorch.maps.network import Network
from lfrtorch.maps.polynomial import Polynomial

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
    cell = LFRCell(2, 3, 4, 2, 1, Network(2, 1, 3), random=False)
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
    cell = LFRCell(1, 1, 1, dtype=torch.float64, random=False)
    assert {p.dtype for p in cell.parameters()} == {torch.float64}
    assert "nu=1, ny=1, nx=1, nz=0, nw=0" in repr(cell)


@pytest.mark.parametrize(
    ("static", "name"), [(Network(3, 1, 2), "static.Wz"), (Polynomial(1, 1, 2), "static.C")]
)
def test_a_static_map_of_other_sizes_is_refused(static: Module, name: str):
    with pytest.raises(ValueError, match=rf"{name} has the shape .* nz=2 and nw=1 it must be"):
        LFRCell(1, 1, 3, 2, 1, static)


@pytest.mark.parametrize(("u", "x"), [((5, 8), (5, 4)), ((5, 2), (5, 1))])
def test_a_step_refuses_signals_of_other_shapes(u: tuple[int, ...], x: tuple[int, ...]):
    with pytest.raises(ValueError, match=r"has the shape .*; give \("):
        random_cell(2, 3, 4, 2, 1, 3)(normal(*u), normal(*x))


def test_a_new_cell_is_a_random_stable_model_that_trains():
    torch.manual_seed(0)
    cells = [LFRCell(2, 1, 6, 2, 2, Network(2, 2, 5), dtype=torch.float64) for _ in range(2)]
    assert not torch.equal(cells[0].A, cells[1].A)
    cell = cells[0].double()
    assert cell.A.dtype == torch.float64
    torch.testing.assert_close(
        torch.linalg.eigvals(cell.A).abs(), torch.full((6,), 0.9, dtype=torch.float64)
    )
    lfr, u = LFR(cell), torch.randn(1, 5000, 2, dtype=torch.float64)
    with torch.no_grad():
        signals = lfr.trajectory(u)
        assert 0.5 < signals.x.std() < 2.0
    # From the first step on there is a gradient for every weight that acts.
    loss = (lfr(u) - torch.randn(1, 5000, 1, dtype=torch.float64)).square().mean()
    loss.backward()
    for name in ("A", "Bu", "Bw", "Cz", "Dzu", "Cy", "Dyu", "Dyw"):
        gradient = cell.get_parameter(name).grad
        assert gradient is not None
        assert gradient.abs().max() > 0, name
    before = cell.A.detach().clone()
    cell.reset_parameters()
    assert not torch.equal(before, cell.A)
    assert not any(p.any() for p in LFRCell(1, 1, 2, random=False).parameters())
