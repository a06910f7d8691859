"""The search that refines a linear model, and what comes out of it."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Any, Self

from torch import Tensor

from lfrtorch._types import Array
from lfrtorch.least_squares.levenberg_marquardt import LevenbergMarquardt

Matrices = tuple[Array, Array, Array, Array]
"""A, B, C, D."""

TOLERANCE = 1e-9
"""Relative decrease of the cost that counts as none."""

EXHAUSTED = "maximum number of iterations"
"""Why a search ended that nothing else ended."""

TRUNCATION = 1e-12
"""Relative singular value that a covariance leaves out as gauge."""


@dataclass(frozen=True)
class Refined:
    """A refined system in normalised units.

    Args:
        A, B, C, D: system matrices.
        covariance: of their entries, each by rows, one after another; of a start none.
        rmse: root mean squared error at the end.
        iterations: of the search.
        reason: why it ended.
        constant: output (ny,) at rest, where it was a parameter.
        K: innovation gain, where it was modelled.
        innovation_covariance: of the innovations, where they were modelled.
    """

    A: Array
    B: Array
    C: Array
    D: Array
    covariance: Array | None
    rmse: float
    iterations: int
    reason: str
    constant: Array | None = None
    K: Array | None = None
    innovation_covariance: Array | None = None

    @property
    def matrices(self) -> Matrices:
        """A, B, C, D."""
        return self.A, self.B, self.C, self.D


class Search:
    """Levenberg-Marquardt from one start, in as many instalments as wanted.

    Geodesic acceleration halves the iterations: 60 to 80 instead of 150 and more for order 12 at
    the five levels of the parallel Wiener-Hammerstein system.

    Args:
        problem: what is minimised.
        theta: start (P,).
    """

    def __init__(self, problem: Any, theta: Tensor) -> None:
        self.problem = problem
        self._optimiser = LevenbergMarquardt(max_iter=sys.maxsize, tolerance=TOLERANCE)
        self.state = self._optimiser.init(problem, theta)

    def advance(self, max_iter: int) -> Self:
        """Go on until the cost no longer falls, or to the iteration ``max_iter``."""
        while not self.state.reason and self.state.iteration < max_iter:
            self.state = self._optimiser.step(self.problem, self.state)
        return self

    @property
    def reason(self) -> str:
        """Why it ended where it stands."""
        return self.state.reason or EXHAUSTED
