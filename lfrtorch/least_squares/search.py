"""A search for the minimum of a problem: the only caller of the optimisers.

The state of a search is a plain value. Whoever keeps it can continue the search later.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Self

from torch import Tensor

from lfrtorch._support.reasons import Reason

STRIDE = 4
"""Number of iterations over which ``advance`` measures the decrease of the cost."""


class Search:
    """A problem and the optimiser that searches for its minimum.

    Args:
        problem: problem to minimise.
        optimiser: ``LevenbergMarquardt``, ``Adam``, or another object with ``init`` and ``step``.
        state: state of the search. Default: ``begin`` sets it.
    """

    def __init__(self, problem: Any, optimiser: Any, state: Any = None) -> None:
        self.problem, self.optimiser, self.state = problem, optimiser, state

    def begin(self, theta: Tensor, point: Any = None) -> Any:
        """The state at θ; ``point`` is the evaluation there, if it is known."""
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
        """Iterate up to ``until``, or until the cost no longer falls.

        ``check`` is called before each iteration, and may raise. The search also ends if STRIDE
        iterations lower the cost by less than the fraction ``settled``.
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
        """Why the search ended."""
        return self.state.reason or Reason.ALL_ITERATIONS
