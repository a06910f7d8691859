"""When a search ends: at an iteration, at a reason, or when its cost no longer falls."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import pytest

from lfrtorch._support.reasons import Reason
from lfrtorch.least_squares.search import STRIDE, Search


@dataclass(frozen=True)
class State:
    cost: float
    iteration: int = 0
    reason: str = ""


@dataclass
class Falling:
    """An optimiser that lowers the cost by a part in each iteration, and ends at one of them."""

    part: float
    end: int = 1000

    def init(self, problem: Any, theta: Any, point: Any) -> State:
        return State(cost=problem(theta, point))

    def step(self, problem: Any, state: State) -> State:
        after = state.iteration + 1
        reason = "converged" if after == self.end else ""
        return State((1.0 - self.part) * state.cost, after, reason)


def searched(optimiser: Falling) -> Search:
    search = Search(lambda theta, point: theta + point, optimiser)
    assert search.begin(1.0, 2.0) is search.state  # pyright: ignore[reportArgumentType]
    assert search.state == State(3.0)
    return search


def test_it_goes_on_to_an_iteration_and_no_further():
    search, checks = searched(Falling(0.1)), []
    assert search.advance(7, check=lambda: checks.append(search.state.iteration)) is search
    assert search.state.iteration == 7
    assert checks == list(range(7))
    assert search.reason == Reason.ALL_ITERATIONS
    assert search.advance(7).state.iteration == 7
    assert search.advance(9).state.iteration == 9


def test_it_ends_at_a_reason():
    search = searched(Falling(0.1, end=3)).advance(20)
    assert (search.state.iteration, search.reason) == (3, "converged")
    assert search.advance(30).state.iteration == 3


@pytest.mark.parametrize(("part", "ends"), [(0.01, STRIDE), (0.02, 20)])
def test_it_has_settled_if_the_cost_hardly_falls(part: float, ends: int):
    """By 4 and by 8 % in four iterations, where 5 % are asked."""
    assert searched(Falling(part)).advance(20, settled=0.05).state.iteration == ends
    assert searched(Falling(part)).advance(20).state.iteration == 20


def test_what_a_check_raises_leaves_the_state():
    search = searched(Falling(0.1)).advance(3)

    def check() -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        search.advance(9, check=check)
    assert search.state.iteration == 3
