"""A search of the minimum of a problem: the only caller of the optimisers.

Its state is a value, so that to go on is to have kept it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Self

from torch import Tensor

from lfrtorch._support.reasons import Reason

STRIDE = 4
"""Iterations over which a search is seen to have settled."""


class Search:
    """A problem and the optimiser that searches its minimum.

    Args:
        problem: problem to minimise.
        optimiser: ``LevenbergMarquardt``, ``Adam``, or another with ``init`` and ``step``.
        state: where it stands. Default: ``begin`` says.
    """

    def __init__(self, problem: Any, optimiser: Any, state: Any = None) -> None:
        self.problem, self.optimiser, self.state = problem, optimiser, state

    def begin(self, theta: Tensor, point: Any = None) -> Any:
        """The state at θ, and what was found there if it is known."""
        self.state = self.optimiser.init(self.problem, theta, point)
        return self.state

    def step(self) -> Any:
        """The state after one iteration."""
        self.state = self.optimiser.step(self.problem, self.state)
        return self.state

    def advance(
        self,
        until: int,
        settled: float = 0.0,
        check: Callable[[], None] = lambda: None,
    ) -> Self:
        """Go on to an iteration, or until the cost no longer falls; ``check`` may raise before one.

        It has ``settled``, too, if STRIDE iterations lower it by less than that part.
        """
        costs = [self.state.cost]
        while not self.state.reason and self.state.iteration < until:
            check()
            costs.append(self.step().cost)
            if settled and len(costs) > STRIDE and costs[-1] > (1.0 - settled) * costs[-1 - STRIDE]:
                break
        return self

    @property
    def reason(self) -> str:
        """Why it ended."""
        return self.state.reason or Reason.ALL_ITERATIONS
