"""Refinement of a linear model by Levenberg-Marquardt, and its result."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from lfrtorch._support.types import Array
from lfrtorch.least_squares.levenberg_marquardt import LevenbergMarquardt
from lfrtorch.least_squares.search import Search

Matrices = tuple[Array, Array, Array, Array]
"""A, B, C, D."""

TOLERANCE = 1e-9
"""A relative decrease of the cost below this ends the search."""

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


def refining(problem: Any, theta: Tensor, tolerance: float = TOLERANCE) -> Search:
    """Levenberg-Marquardt from one initial model, which can be interrupted and continued.

    Geodesic acceleration halves the iterations: 60 to 80 instead of 150 and more for order 12 at
    the five levels of the parallel Wiener-Hammerstein system.
    """
    search = Search(problem, LevenbergMarquardt(max_iter=sys.maxsize, tolerance=tolerance))
    search.begin(theta)
    return search
