"""The fast Jacobian against jacfwd through the plain loop, and its rank."""

from collections.abc import Iterator
from typing import Any

import pytest
import reference
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from reference import SIZES, normal, polynomial_cell, random_cell
from torch import Tensor, nn
from torch.testing import assert_close

from lfrtorch._support.threads import SLOW_PATHS
from lfrtorch.engine import sensitivity
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.sensitivity import Linearisation, output_jacobian
from lfrtorch.engine.simulation import simulate, steady_state
from lfrtorch.maps.activations import ACTIVATIONS

pytestmark = pytest.mark.numeric

# Sums of at most some hundred products along a contraction, in double precision: 1e-13 or so.
TOLERANCE = 1e-9


@pytest.fixture(scope="module", autouse=True, params=["small", "large"])
def kernel(request: pytest.FixtureRequest) -> Iterator[None]:
    """Every model is a small or a large one: with the rows sample by sample, or block by block."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(sensitivity, "MANY_STATES", 99 if request.param == "small" else 1)
        yield


class Cubic(nn.Module):
    """w = c z³ + d z, a user's map whose parameters have two shapes."""

    def __init__(self, nz: int, nw: int):
        super().__init__()
        self.c = nn.Parameter(torch.zeros(nw, nz))
        self.d = nn.Parameter(torch.zeros(()))

    def forward(self, z: Tensor) -> Tensor:
        return z.tanh() ** 3 @ self.c.mT + self.d * z.sum(-1, keepdim=True).tanh()


class Square(nn.Module):
    """A map without parameters."""

    def forward(self, z: Tensor) -> Tensor:
        return z.tanh() ** 2


def assert_jacobian(J: Tensor, expected: Tensor, tolerance: float = TOLERANCE):
    assert_close(
        J, expected, rtol=tolerance, atol=tolerance * float(expected.detach().abs().amax())
    )


def periodic(cell: LFRCell, u: Tensor) -> Linearisation:
    return Linearisation(cell, u, steady_state(cell, u), periodic=True)


def assert_all(linearisation: Linearisation, expected: Tensor):
    """Rows, product with a direction and product with output errors are those of one matrix."""
    P = linearisation.parameters
    assert_jacobian(output_jacobian(linearisation)[..., :P], expected)
    if not P:
        return
    direction = normal(P, seed=5)
    assert_jacobian(linearisation.tangent(direction), expected @ direction)
    e = normal(*expected.shape[:3], seed=6)
    adjoint = (expected * e.unsqueeze(-1)).sum(dim=(1, 2))
    assert_jacobian(linearisation.adjoint(e).theta, adjoint)


def check_zero_start(cell: LFRCell, R: int = 2, T: int = 15):
    u, x0 = normal(R, T, cell.nu), normal(R, cell.nx, seed=1)
    assert_all(
        Linearisation(cell, u, simulate(cell, u, x0)), reference.output_jacobian(cell, u, x0)
    )


def check_periodic(cell: LFRCell, R: int = 2, T: int = 5, periods: int = 12):
    """Slopes within 0.6: the start is forgotten to 0.6^60 = 5e-14, its derivative to 60 times."""
    u = normal(R, T, cell.nu)
    zero = u.new_zeros(R, cell.nx)
    assert_all(periodic(cell, u), reference.output_jacobian(cell, u, zero, periods))


# --- against the oracle ---------------------------------------------------------------------


@given(sizes=SIZES, R=st.integers(1, 3), T=st.integers(1, 30))
@settings(max_examples=20)
def test_from_a_given_state(sizes: dict[str, Any], R: int, T: int):
    check_zero_start(random_cell(**sizes), R, T)


@given(sizes=SIZES, R=st.integers(1, 2))
@settings(max_examples=12)
def test_in_periodic_steady_state(sizes: dict[str, Any], R: int):
    check_periodic(random_cell(**sizes, radius=0.5), R)


@pytest.mark.parametrize("activation", sorted(ACTIVATIONS))
def test_every_activation(activation: str):
    check_zero_start(random_cell(2, 2, 2, 2, 2, 3, activation=activation))


def test_more_states_than_fit_into_a_tile_of_the_kernel():
    """Of 4 by 4: a second one in both directions, and a part of a third."""
    check_zero_start(random_cell(1, 2, 9, 1, 2, 2, radius=0.5))


@pytest.mark.parametrize("check", [check_zero_start, check_periodic])
def test_linear_cell(check):
    check(random_cell(2, 2, 3, 0, 0, radius=0.5))


@pytest.mark.parametrize("check", [check_zero_start, check_periodic])
def test_own_module_as_static_map(check):
    check(random_cell(1, 2, 2, 2, 2, static=Cubic(2, 2), radius=0.3, feedback=0.05))


@pytest.mark.parametrize(("nz", "nw", "degree"), [(1, 1, 5), (1, 2, 1), (2, 1, 3), (3, 2, 2)])
@pytest.mark.parametrize("check", [check_zero_start, check_periodic])
def test_polynomial(check, nz: int, nw: int, degree: int):
    check(polynomial_cell(nz, nw, degree, radius=0.3))


@pytest.mark.parametrize("check", [check_zero_start, check_periodic])
def test_static_map_without_parameters(check):
    check(random_cell(1, 2, 2, 2, 2, static=Square(), radius=0.3, feedback=0.05))


@pytest.mark.parametrize(
    "frozen",
    [["A"], ["Bw", "Dyw"], ["Cz", "static.Wz"], ["static.bz", "static.bw"], ["Bu", "Cy", "Dyu"]],
)
@pytest.mark.parametrize("check", [check_zero_start, check_periodic])
def test_frozen_parameters_get_no_column(check, frozen: list[str]):
    cell = random_cell(2, 1, 2, 2, 2, 2, radius=0.5)
    for name in frozen:
        cell.get_parameter(name).requires_grad_(False)
    check(cell)


def test_all_parameters_frozen():
    cell = random_cell().requires_grad_(False)
    u = normal(1, 5, 1)
    assert output_jacobian(periodic(cell, u)).shape[-1] == 0


# --- the two ways ---------------------------------------------------------------------------


def rows_and_end(linearisation: Linearisation, kept: Tensor) -> list[Tensor]:
    R, T = linearisation.u.shape[:2]
    ny, nx = linearisation.trajectory.y.shape[2], linearisation.state.shape[1]
    whole = linearisation.state.new_full((R, T, ny, len(kept) + nx), torch.nan)
    end = linearisation.state.new_full((R, nx, len(kept) + nx), torch.nan)
    for block in linearisation.rows(kept, initial_state=True):
        whole[block.records, block.time] = block.rows
        end[block.records] = block.end
    return [whole, end]


@given(sizes=SIZES, R=st.integers(1, 3), T=st.integers(1, 30), block=st.integers(1, 40))
@settings(max_examples=25)
def test_compiled_is_generic_in_whatever_blocks_and_columns(
    sizes: dict[str, Any], R: int, T: int, block: int
):
    cell = random_cell(**sizes)
    u = normal(R, T, cell.nu)
    trajectory = simulate(cell, u, normal(R, cell.nx, seed=1))
    P = Linearisation(cell, u, trajectory).parameters
    kept = torch.arange(P)[torch.rand(P, generator=torch.Generator().manual_seed(T)) < 0.7]
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setenv(SLOW_PATHS, "1")
        expected = rows_and_end(Linearisation(cell, u, trajectory), kept)
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setenv(SLOW_PATHS, "")
        monkeypatch.setattr(sensitivity, "BLOCK", block)
        monkeypatch.setattr(sensitivity, "PASS", block)
        monkeypatch.setattr(sensitivity, "KEPT", block)
        blocked = Linearisation(cell, u, trajectory)
        for mine, other in zip(rows_and_end(blocked, kept), expected, strict=True):
            assert_jacobian(mine, other)


@pytest.mark.parametrize("start_is_periodic", [False, True])
@pytest.mark.parametrize("static", ["network", "own"])
def test_products_in_blocks_are_those_in_one_piece(
    static: str, start_is_periodic: bool, monkeypatch
):
    own = Cubic(2, 2) if static == "own" else None
    cell = random_cell(2, 2, 3, 2, 2, 3, static=own, radius=0.5, feedback=0.05)
    u, e, direction = normal(2, 50, 2), normal(2, 50, 2, seed=1), normal(200, seed=2)

    def products() -> list[Tensor]:
        if start_is_periodic:
            linearisation = periodic(cell, u)
        else:
            linearisation = Linearisation(cell, u, simulate(cell, u, normal(2, 3, seed=3)))
        d_y = linearisation.tangent(direction[: linearisation.parameters])
        return [d_y, *linearisation.adjoint(e)]

    whole = products()
    monkeypatch.setattr(sensitivity, "PASS", 14)
    monkeypatch.setattr(sensitivity, "KEPT", 14)
    for mine, other in zip(products(), whole, strict=True):
        assert_close(mine, other, rtol=1e-11, atol=1e-11)


def test_output_errors_are_passed_back_to_the_input_and_the_start():
    cell = random_cell(2, 2, 3, 2, 2, 3)
    u, x0 = normal(2, 20, 2).requires_grad_(), normal(2, 3, seed=1).requires_grad_()
    e = normal(2, 20, 2, seed=2)
    W = reference.weights(cell)
    y = torch.stack([reference.nl_lfr(cell, W, *pair).y for pair in zip(u, x0, strict=True)])
    expected = torch.autograd.grad((y * e).sum(), (u, x0))
    with torch.no_grad():
        found = Linearisation(cell, u, simulate(cell, u, x0)).adjoint(e)
    assert_jacobian(found.u, expected[0])
    assert_jacobian(found.x0, expected[1])


@pytest.mark.parametrize("threads", [1, 2, 7, 100])
def test_columns_are_shared_among_any_number_of_threads(threads: int, monkeypatch):
    cell = random_cell(2, 2, 3, 2, 2, 3)
    u = normal(2, 20, 2)
    linearisation = Linearisation(cell, u, simulate(cell, u, normal(2, 3, seed=1)))
    everything = torch.arange(linearisation.parameters)
    expected = rows_and_end(linearisation, everything)
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    for mine, other in zip(rows_and_end(linearisation, everything), expected, strict=True):
        assert_jacobian(mine, other)


@pytest.mark.usefixtures("fast")
@pytest.mark.parametrize("own", [False, True])
def test_faded_sensitivities_are_zero_and_never_denormal(own: bool):
    """dy(k)/dBu of a unit pulse is a^(k - 1): each power is exact. Driven again, it fades again."""
    static = Cubic(1, 1) if own else None  # which torch computes, and which has no effect
    cell = LFRCell(1, 1, 1, int(own), int(own), static, dtype=torch.float64, random=False)
    with torch.no_grad():
        for p, value in ((cell.A, 0.5), (cell.Bu, 1.0), (cell.Cy, 1.0), (cell.Dyu, 0.0)):
            p.fill_(value)
    u = torch.zeros(2, 2600, 1, dtype=torch.float64)
    u[:, [0, 1300]] = 1.0
    k = torch.arange(2600, dtype=torch.float64)
    since = torch.stack([k - 1, k - 1301])
    expected = torch.where(since >= 0, 0.5**since, 0.0).sum(0)
    J = output_jacobian(Linearisation(cell, u, simulate(cell, u, u.new_zeros(2, 1))))
    by_Bu = J[:, :, 0, 1]  # of A, Bu, ...
    assert_close(by_Bu, expected.expand(2, -1), rtol=0, atol=1e-30)
    assert not ((by_Bu > 0) & (by_Bu < torch.finfo(u.dtype).tiny)).any()
    assert not by_Bu[:, -1].any()


# Compiled for single precision, a kernel takes ten seconds.
@pytest.mark.parametrize(
    "kernel", ["small", pytest.param("large", marks=pytest.mark.slow)], indirect=True
)
def test_single_precision(kernel: None):
    double, single = random_cell(2, 1, 3), random_cell(2, 1, 3, dtype=torch.float32)
    u = normal(2, 50, 2)
    expected = output_jacobian(periodic(double, u))
    J = output_jacobian(periodic(single, u.float()))
    assert J.dtype == torch.float32
    # eps 1.2e-7 amplified by 1 / (1 - 0.9) in the states, and once more in their derivatives.
    assert_jacobian(J.double(), expected, 5e-5)


# --- rank -----------------------------------------------------------------------------------


def vanishing(J: Tensor) -> int:
    """Number of singular values below 1e-12 of the largest, columns at unit norm."""
    J = J.flatten(0, -2)
    s = torch.linalg.svdvals(J / J.norm(dim=0))
    return int((s < 1e-12 * s[0]).sum())


@pytest.mark.parametrize(
    ("nu", "ny", "nx", "nz", "nw", "nn"),
    [
        (1, 1, 2, 1, 1, 3),
        (1, 1, 3, 2, 1, 5),
        (1, 1, 3, 1, 2, 4),
        (2, 1, 2, 2, 2, 3),
        (1, 2, 3, 2, 2, 4),
        (1, 1, 4, 2, 3, 5),
    ],
)
def test_rank_leaves_out_the_gauge_directions(nu, ny, nx, nz, nw, nn):
    cell = random_cell(nu, ny, nx, nz, nw, nn)
    u = normal(2, 400, nu)
    gauge = nx**2 + nz**2 + nw**2
    from_zero = Linearisation(cell, u, simulate(cell, u, u.new_zeros(2, nx)))
    assert vanishing(output_jacobian(from_zero)[..., : from_zero.parameters]) == gauge
    # A constant w can hide in the origin of the state where the start state is free to move.
    assert vanishing(output_jacobian(periodic(cell, u))) == gauge + max(0, nw - ny)


def test_linear_rank_leaves_out_the_state_coordinates():
    cell = random_cell(2, 2, 3, 0, 0)
    u = normal(1, 300, 2)
    assert vanishing(output_jacobian(periodic(cell, u))) == 3**2
