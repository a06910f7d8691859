"""Refinement of a linear model by Levenberg-Marquardt, and its result."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Any, Self

from torch import Tensor

from lfrtorch._support.reasons import Reason
from lfrtorch._support.types import Array
from lfrtorch.least_squares.levenberg_marquardt import LevenbergMarquardt

Matrices = tuple[Array, Array, Array, Array]
"""A, B, C, D."""

TOLERANCE = 1e-9
"""A relative decrease of the cost below this ends the search."""

STRIDE = 4
"""Iterations over which a search is seen to have settled."""

TRUNCATION = 1e-12
"""Relative singular value below which a direction of θ counts as gauge, which has no covariance."""


@dataclass(frozen=True)
class Refined:
    """Refined system in normalised units."""

    A: Array
    B: Array
    C: Array
    D: Array
    covariance: Array | None  # of A, B, C, D, row by row; ``None`` before the first iteration
    rmse: float
    iterations: int
    reason: str
    constant: Array | None = None  # of the output at rest, if it is a parameter
    K: Array | None = None
    innovation_covariance: Array | None = None

    @property
    def matrices(self) -> Matrices:
        """A, B, C, D."""
        return self.A, self.B, self.C, self.D


class Search:
    """Levenberg-Marquardt from one initial model, which can be interrupted and continued.

    Geodesic acceleration halves the iterations: 60 to 80 instead of 150 and more for order 12 at
    the five levels of the parallel Wiener-Hammerstein system.
    """

    def __init__(self, problem: Any, theta: Tensor, tolerance: float = TOLERANCE) -> None:
        self.problem = problem
        self._optimiser = LevenbergMarquardt(max_iter=sys.maxsize, tolerance=tolerance)
        self.state = self._optimiser.init(problem, theta)

    def advance(self, max_iter: int, settled: float = 0.0) -> Self:
        """Go on to the iteration ``max_iter``, or until the cost no longer falls.

        It has ``settled``, too, if STRIDE iterations lower it by less than that part.
        """
        costs = [self.state.cost]
        while not self.state.reason and self.state.iteration < max_iter:
            self.state = self._optimiser.step(self.problem, self.state)
            costs.append(self.state.cost)
            if settled and len(costs) > STRIDE and costs[-1] > (1.0 - settled) * costs[-1 - STRIDE]:
                break
        return self

    @property
    def reason(self) -> str:
        """Why it ended."""
        return self.state.reason or Reason.ALL_ITERATIONS
