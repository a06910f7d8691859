"""Bounds of single parameters: which there are, points put back, and steps that end at them."""

from __future__ import annotations

import pytest
import torch
from reference import normal, random_cell
from torch import Tensor
from torch.testing import assert_close

import lfrtorch
from lfrtorch.engine.cell import LFRCell
from lfrtorch.least_squares.box import Box, bounds_of
from lfrtorch.least_squares.guarantee import guarantee_of
from lfrtorch.least_squares.linear_systems import CholeskySystem
from lfrtorch.least_squares.stable_states import Stable

pytestmark = pytest.mark.numeric

INF = float("inf")


class Bounded(lfrtorch.StaticMap):
    """w = a z + b z³ + c, of which some have bounds."""

    def __init__(self, *bounds: list[float]) -> None:
        super().__init__(nz=1, nw=1)
        self.c = torch.nn.Parameter(torch.zeros(1))
        self.ab = torch.nn.Parameter(torch.ones(2))
        self._bounds = torch.tensor(bounds, dtype=torch.float64)

    def equations(self, z, phi):
        return [phi[1] * z[0] + phi[2] * z[0] ** 3 + phi[0]]

    @property
    def weight_bounds(self) -> Tensor:
        return self._bounds


def bounded_cell() -> LFRCell:
    static = Bounded([-1.0, INF], [0.0, 2.0], [-INF, 3.0])
    return random_cell(1, 1, 2, static=static, radius=0.3, feedback=0.01)


def test_bounds_are_those_of_the_free_weights_of_the_map():
    cell = bounded_cell()
    of_map = [[-1.0, INF], [0.0, 2.0], [-INF, 3.0]]
    assert bounds_of(cell)[-3:].tolist() == of_map
    assert bounds_of(cell)[:-3].tolist() == [[-INF, INF]] * (4 + 4 * 2 + 3)  # A; Bu, ...; Dzu, ...
    cell.get_parameter("static.c").requires_grad_(False)
    cell.A.requires_grad_(False)
    assert bounds_of(cell)[-2:].tolist() == of_map[1:]
    assert len(bounds_of(cell)) == 4 * 2 + 3 + 2


def test_a_point_beyond_goes_to_the_nearest_within():
    box = Box(torch.tensor([[0.0, 1.0], [-INF, 2.0], [-3.0, INF], [-INF, INF]]))
    theta = torch.tensor([-0.5, 5.0, -4.0, 9.0, 7.0, -8.0])
    assert box.admissible(theta).tolist() == [0.0, 2.0, -3.0, 9.0, 7.0, -8.0]
    inside = torch.tensor([0.5, 1.0, 4.0, -9.0, 7.0, -8.0])
    assert torch.equal(box.admissible(inside), inside)


def stepped(theta: list[float], free: list[float]) -> tuple[Tensor, Tensor, Tensor]:
    """A step from θ where it is ``free`` without bounds; and H and g of g δ + δ H δ / 2."""
    bounds = torch.tensor([[0.0, 1.0], [-INF, 2.0], [-INF, INF]], dtype=torch.float64)
    J, damping, wanted = normal(9, 4), 0.3, torch.tensor(free, dtype=torch.float64)
    H = J.mT @ J + damping * torch.eye(4).double()
    gradient = -H @ wanted
    system = CholeskySystem(J.mT @ J, 4)
    at = torch.tensor(theta, dtype=torch.float64)
    own = Box(bounds).bounded(at, system)
    assert (own.size, own.rank, own.scale) == (system.size, system.rank, system.scale)
    return own.solve(gradient, damping), H, gradient


def test_a_step_within_its_bounds_is_that_of_the_system():
    step, *_ = stepped([0.4, 0.0, 0.0, 0.0], [0.5, 1.9, 30.0, -30.0])
    assert_close(step, step.new_tensor([0.5, 1.9, 30.0, -30.0]), rtol=1e-9, atol=0)


@pytest.mark.parametrize(
    ("theta", "free", "ends"),
    [
        ([0.9, 0.0, 0.0, 0.0], [0.5, 0.3, 1.0, 2.0], {0: 0.1}),  # at the upper one
        ([0.2, 0.0, 0.0, 0.0], [-0.5, 0.3, 1.0, 2.0], {0: -0.2}),  # at the lower one
        ([0.2, 1.5, 0.0, 0.0], [0.1, 0.9, 1.0, 2.0], {1: 0.5}),
        ([0.9, 1.5, 0.0, 0.0], [0.5, 0.9, 1.0, 2.0], {0: 0.1, 1: 0.5}),
        ([1.2, 0.0, 0.0, 0.0], [0.5, 0.3, 1.0, 2.0], {0: 0.0}),  # beyond already: no further
    ],
)
def test_a_step_beyond_ends_there_and_is_the_best_of_those(theta, free, ends: dict[int, float]):
    """The others are the minimum of the quadratic with these entries at their ends."""
    step, H, gradient = stepped(theta, free)
    at, rest = list(ends), [i for i in range(4) if i not in ends]
    expected = torch.zeros(4, dtype=torch.float64)
    expected[at] = torch.tensor(list(ends.values()), dtype=torch.float64)
    right = -gradient[rest] - H[rest][:, at] @ expected[at]
    expected[rest] = torch.linalg.solve(H[rest][:, rest], right)
    multiplier = -(gradient + H @ expected)[at]
    assert (multiplier.sign() == torch.tensor(free)[at].sign()).all()  # or another set is active
    assert_close(step, expected, rtol=0, atol=1e-9)


def test_a_guarantee_is_made_if_something_could_break_it():
    plain, bounded = random_cell(1, 1, 2), bounded_cell()
    assert guarantee_of(None, 100, plain) is None
    assert isinstance(guarantee_of(None, 100, bounded), Box)
    assert isinstance(guarantee_of("stable", 100, plain), Stable)
    assert isinstance(guarantee_of("stable", 100, bounded), Stable)
    plain.hold({"A": (torch.eye(2).bool(), torch.tensor(0.1))})
    assert isinstance(guarantee_of("stable", 100, plain), Stable)
    plain.hold({"A": (torch.tensor(True), plain.A.detach())})
    assert guarantee_of("stable", 100, plain) is None
    frozen = random_cell(1, 1, 2)
    frozen.A.requires_grad_(False)
    assert guarantee_of("stable", 100, frozen) is None
