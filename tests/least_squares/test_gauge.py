"""Columns that are left out are exactly those combinations of the others."""

from typing import Any, NamedTuple

import numpy as np
import pytest
import scipy
import torch
from hypothesis import given, settings
from reference import SIZES, normal, random_cell
from torch.testing import assert_close

from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.gauge_directions import free_directions, gauge_directions
from lfrtorch.engine.held import held_parameters, structure
from lfrtorch.engine.sensitivity import Linearisation, output_jacobian
from lfrtorch.engine.simulation import simulate, steady_state
from lfrtorch.least_squares import gauge
from lfrtorch.maps.network import Network
from lfrtorch.maps.polynomial import Polynomial

pytestmark = pytest.mark.numeric


class Reduced(NamedTuple):
    """Columns that are kept, and what gives all."""

    kept: torch.Tensor
    expand: torch.Tensor


def reduction(*given: Any, **named: Any) -> Reduced:
    kept, expand = gauge.reduction(*given, **named)
    return Reduced(kept, torch.eye(len(kept)).double() if expand is None else expand)


def none(cell: LFRCell) -> torch.Tensor:
    return cell.A.new_zeros(0, cell.nx)


def check(cell: LFRCell, left_out: int, R: int = 2):
    u = normal(R, 12, cell.nu)
    kept, expand = reduction(cell, none(cell))
    P = sum(p.numel() for p in cell.parameters() if p.requires_grad)
    assert (len(kept), expand.shape) == (P - left_out, (P - left_out, P))
    for whole in (
        output_jacobian(Linearisation(cell, u, simulate(cell, u, u.new_zeros(R, cell.nx)))),
        output_jacobian(Linearisation(cell, u, steady_state(cell, u), periodic=True)),
    ):
        J = whole[..., :P]
        assert_close(J[..., kept] @ expand, J, rtol=0, atol=1e-8 * float(J.abs().max()))


@given(sizes=SIZES)
@settings(max_examples=15)
def test_expanded_columns_are_the_jacobian(sizes: dict[str, Any]):
    cell = random_cell(**sizes, radius=0.5)
    kept, expand = reduction(cell, none(cell))
    u = normal(2, 12, cell.nu)
    J = output_jacobian(Linearisation(cell, u, steady_state(cell, u), periodic=True))
    assert_close(J[..., kept] @ expand, J, rtol=0, atol=1e-8 * float(J.abs().max()))


def test_all_gauge_directions_of_a_network_are_left_out():
    check(random_cell(1, 1, 3, 2, 1, 5, radius=0.5), 3**2 + 2**2 + 1)
    check(random_cell(2, 2, 4, 2, 2, 5, radius=0.5), 4**2 + 2**2 + 2**2)


def test_a_map_that_absorbs_no_coordinates_has_those_of_the_state_only():
    cell = random_cell(1, 1, 2, 2, 1, static=Polynomial(2, 1, 2), radius=0.3, feedback=0.01)
    check(cell, 2**2)
    check(random_cell(1, 2, 3, 0, 0, radius=0.5), 3**2)


def test_start_of_the_paper_keeps_what_it_cannot_leave_out():
    """With Bw = Dyw = 0 the coordinates of w are seen in the static map alone."""
    cell = random_cell(1, 1, 2, 1, 1, 3, radius=0.5)
    with torch.no_grad():
        cell.Bw.zero_()
        cell.Dyw.zero_()
    check(cell, 2**2 + 1)


@pytest.mark.parametrize(
    ("frozen", "left_out"),
    [(["A"], 2 + 4 + 1), (["Cz", "Dzu"], 2 + 1), (["Bu"], 2 + 4 + 1), (["A", "Bu", "Bw", "Cy"], 4)],
)
def test_directions_that_move_a_frozen_parameter_are_none(frozen: list[str], left_out: int):
    """Those that commute with A are polynomials of it: nx of them; Bu fixed takes nx of nx², and
    with Cz fixed the coordinates of x and z go together, of which Dzu takes nz more.
    """
    cell = random_cell(1, 1, 2, 2, 1, 4, radius=0.5)
    for name in frozen:
        cell.get_parameter(name).requires_grad_(False)
    check(cell, left_out)


def test_coordinates_of_given_start_states_are_not_free():
    cell = random_cell(1, 1, 3, 2, 1, 5)
    free, held = reduction(cell, none(cell)), reduction(cell, none(cell), coordinates=False)
    assert len(held.kept) == len(free.kept) + 3**2


def test_start_states_that_are_parameters_stay():
    cell = random_cell(1, 1, 2, 1, 1, 3, radius=0.5)
    x0, u = normal(2, 2, seed=4), normal(2, 12, 1)
    kept, expand = reduction(cell, x0)
    P = sum(p.numel() for p in cell.parameters())
    assert kept[-4:].tolist() == [P, P + 1, P + 2, P + 3]
    rows = output_jacobian(Linearisation(cell, u, simulate(cell, u, x0)))
    J = rows.new_zeros(*rows.shape[:3], P + 4)
    J[..., :P] = rows[..., :P]
    J[0, ..., P : P + 2], J[1, ..., P + 2 :] = rows[0, ..., P:], rows[1, ..., P:]
    assert_close(J[..., kept] @ expand, J, rtol=0, atol=1e-9 * float(J.abs().max()))


def test_weights_that_are_not_finite_leave_nothing_out():
    cell = random_cell()
    with torch.no_grad():
        cell.A[0, 0] = torch.inf
    kept, expand = reduction(cell, none(cell))
    assert torch.equal(expand, torch.eye(len(kept)).double())
    fixed = entries(cell, "Bu")
    kept, expand = reduction(cell, none(cell), fixed=fixed)
    assert not expand[:, fixed].any()
    assert len(kept) == int((~fixed).sum())


@pytest.mark.parametrize(
    ("frozen", "sizes"),
    [
        (["A", "Bu", "Bw", "Cz", "Dzu", "Cy"], {"nz": 6, "nw": 2}),
        (["A", "Bu", "Bw", "Cz", "Dzu", "Dyw"], {"nz": 2, "nw": 6}),
    ],
)
def test_rounding_errors_of_frozen_directions_leave_nothing_out(frozen, sizes):
    cell = random_cell(1, 1, 3, **sizes, nn=10, radius=0.5)
    for name in frozen:
        cell.get_parameter(name).requires_grad_(False)
    assert reduction(cell, none(cell)).expand.abs().max() < 1e3


def test_a_class_of_one_s_own_that_begins_with_a_network_keeps_its_coordinates():
    class More(Network):
        def forward(self, z: torch.Tensor) -> torch.Tensor:
            return super().forward(z) + 0.5 * torch.sin(z[..., :1])

    check(random_cell(1, 1, 2, 2, 1, static=More(2, 1, 3), radius=0.3, feedback=0.05), 2**2)


@pytest.mark.parametrize("seed", [1, 5])
def test_reduction_of_before_is_kept_if_it_still_does(seed: int):
    """Another choice of columns than that of these weights alone, and as exact."""
    other, cell = (random_cell(1, 1, 2, 2, 1, 4, radius=0.5, seed=s) for s in (0, seed))
    before = reduction(other, none(other))
    assert before.kept.tolist() != reduction(cell, none(cell)).kept.tolist()
    kept, expand = reduction(cell, none(cell), before=before)
    assert torch.equal(kept, before.kept)
    u = normal(2, 12, 1)
    J = output_jacobian(Linearisation(cell, u, simulate(cell, u, u.new_zeros(2, 2))))
    J = J[..., : expand.shape[1]]
    # The expansion multiplies rounding errors by less than 1 / DEPENDENT.
    assert_close(J[..., kept] @ expand, J, rtol=0, atol=1e-8 * float(J.abs().max()))


@pytest.mark.parametrize("faded", [0.0, 1e-6])
def test_reduction_of_before_is_given_up_if_it_blows_up(faded: float):
    """y = Cy Bu times what A makes of u: the column left out is that of the larger factor."""
    cell = random_cell(1, 1, 1, 0, 0)
    with torch.no_grad():
        cell.Bu.fill_(1.0)
        cell.Cy.fill_(0.1)
    before = reduction(cell, none(cell))
    assert before.kept.tolist() == [0, 2, 3]  # of A, Bu, Cy, Dyu
    with torch.no_grad():
        cell.Bu.fill_(faded)
    kept, expand = reduction(cell, none(cell), before=before)
    assert kept.tolist() == [0, 1, 3]
    assert_close(expand[:, 2], expand.new_tensor([0.0, faded / 0.1, 0.0]), rtol=1e-12, atol=0)


# --- fixed entries ----------------------------------------------------------------------------


def check_fixed(cell: LFRCell, fixed: torch.Tensor, left_out: int):
    """Columns of zeros at the fixed entries, the plain ones elsewhere; so many are not computed."""
    u = normal(2, 12, cell.nu)
    J = output_jacobian(Linearisation(cell, u, steady_state(cell, u), periodic=True))
    kept, expand = reduction(cell, none(cell), fixed=fixed)
    assert len(kept) == J.shape[-1] - int(fixed.sum()) - left_out
    assert not fixed[kept].any()
    found = J[..., kept] @ expand
    assert torch.equal(expand[:, fixed], torch.zeros_like(expand[:, fixed]))
    # The expansion multiplies by 1 / DEPENDENT at most, the steady state is known to 1e-10.
    assert_close(found[..., ~fixed], J[..., ~fixed], rtol=0, atol=1e-8 * float(J.abs().max()))


def entries(cell: LFRCell, *names: str) -> torch.Tensor:
    """Which free entries belong to those parameters."""
    free = [(name, p) for name, p in cell.named_parameters() if p.requires_grad]
    return torch.cat([torch.full((p.numel(),), name in names) for name, p in free])


@pytest.mark.parametrize(
    ("names", "left_out"),
    [((), 4 + 4 + 1), (("A",), 2 + 4 + 1), (("Cz", "Dzu"), 2 + 1), (("A", "Bu", "Bw", "Cy"), 4)],
)
def test_fixed_parameters_are_frozen_ones(names: tuple[str, ...], left_out: int):
    """As many directions as where the whole parameter has no gradient."""
    cell = random_cell(1, 1, 2, 2, 1, 4, radius=0.5)
    check_fixed(cell, entries(cell, *names), left_out)


def test_single_entries_hold_the_directions_that_move_them():
    """Of the diagonal of A they move nx - 1 entries freely: the trace stays as it is."""
    cell = random_cell(1, 1, 3, 0, 0, radius=0.5)
    fixed = entries(cell)
    fixed[[0, 4, 8]] = True
    check_fixed(cell, fixed, 9 - 2)


def test_fixed_entries_beside_a_frozen_parameter_and_start_states():
    """`fixed` numbers the free parameters alone, and start states stay free behind them."""
    cell = random_cell(1, 1, 2, 1, 1, 3, radius=0.5)
    cell.Bu.requires_grad_(False)
    fixed = entries(cell, "Cy")
    x0, u = normal(2, 2, seed=4), normal(2, 12, 1)
    kept, expand = reduction(cell, x0, fixed=fixed)
    P = len(fixed)
    assert expand.shape[1] == P + 4
    assert kept[-4:].tolist() == [P, P + 1, P + 2, P + 3]
    rows = output_jacobian(Linearisation(cell, u, simulate(cell, u, x0)))
    J = rows.new_zeros(*rows.shape[:3], P + 4)
    J[..., :P] = rows[..., :P]
    J[0, ..., P : P + 2], J[1, ..., P + 2 :] = rows[0, ..., P:], rows[1, ..., P:]
    J[..., :P][..., fixed] = 0.0
    assert_close(J[..., kept] @ expand, J, rtol=0, atol=1e-9 * float(J.abs().max()))


def test_fixed_entries_of_a_model_without_gauge_directions():
    """Its start states are given, and no static map absorbs coordinates."""
    cell = random_cell(1, 1, 2, 0, 0, radius=0.5)
    fixed = entries(cell, "Bu")
    kept, expand = reduction(cell, none(cell), coordinates=False, fixed=fixed)
    assert kept.tolist() == torch.nonzero(~fixed).flatten().tolist()
    assert torch.equal(expand, torch.eye(len(fixed)).double()[~fixed])


def test_reduction_of_before_does_not_bring_fixed_entries_back():
    cell = random_cell(1, 1, 2, 1, 1, 3, radius=0.5)
    before = reduction(cell, none(cell))
    fixed = entries(cell, "A")
    _, expand = reduction(cell, none(cell), before=before, fixed=fixed)
    assert not expand[:, fixed].any()


# --- the directions themselves --------------------------------------------------------------------


@pytest.mark.parametrize("sizes", [(1, 1, 2, 1, 1, 3), (2, 1, 3, 2, 1, 4), (1, 2, 2, 1, 2, 3)])
def test_no_output_changes_along_a_gauge_direction(sizes: tuple[int, ...]):
    """Start states go along; there are as many as entries of the coordinates of x, z and w."""
    cell = random_cell(*sizes, radius=0.5)
    nu, _, nx, nz, nw, _ = sizes
    u, x0 = normal(2, 15, nu), normal(2, nx, seed=1)
    linearisation = Linearisation(cell, u, simulate(cell, u, x0), every=True)
    G = torch.as_tensor(gauge_directions(cell.weights(), x0))
    P = linearisation.parameters
    assert G.shape == (P + 2 * nx, nx**2 + nz**2 + nw**2)
    assert torch.linalg.matrix_rank(G) == G.shape[1]
    by_all = output_jacobian(linearisation)
    J = by_all.new_zeros(*by_all.shape[:3], P + 2 * nx)
    J[..., :P] = by_all[..., :P]
    J[0, ..., P : P + nx], J[1, ..., P + nx :] = by_all[0, ..., P:], by_all[1, ..., P:]
    assert (J @ G).abs().max() < 1e-11 * J.abs().max() * G.abs().max()


KINDS = ("free", "wiener", "hammerstein", "wiener_hammerstein", "parallel")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("nx", "branches", "nn"), [(4, 1, 5), (4, 2, 6), (5, 2, 4)])
def test_free_directions_move_nothing_that_is_held(kind: str, nx: int, branches: int, nn: int):
    cell = random_cell(1, 1, nx, branches, branches, nn, radius=0.5)
    cell.hold(structure(cell, kind))
    held = held_parameters(cell).numpy()
    G = gauge_directions(cell.weights(), none(cell))
    N = scipy.linalg.null_space(G[held]) if held.any() else np.eye(G.shape[1])
    assert free_directions(cell) == N.shape[1]
    with torch.no_grad():  # a start, where more directions move nothing
        assert isinstance(cell.static, Network)
        cell.static.zero_output()
        cell.Bw.zero_()
    assert free_directions(cell) == N.shape[1]
    assert not cell.Bw.any()
    assert not cell.static.Ww.any()


def test_directions_that_move_the_same_entry_count_once():
    """T Bu of the four T with one entry 1: two pairs that are parallel."""
    cell = random_cell(1, 1, 2, 1, 1, 3)
    cell.hold({"Bu": (torch.tensor(True), cell.Bu.detach())})
    assert free_directions(cell) == 2**2 + 1 + 1 - 2
