"""Race of several starts to the best minimum of a linear model's error.

Subspace methods give several first estimates of A and C, and least squares the B and D of each.
Levenberg-Marquardt refines the estimates that fit best by a few steps, then the best of these to
the end, as a single search may end in a poor minimum.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array
from lfrtorch.least_squares.search import Search
from lfrtorch.linear.balancing import balancing
from lfrtorch.linear.refinement import Matrices, Refined
from lfrtorch.linear.response_fit import ResponseFit
from lfrtorch.linear.signal_fit import SignalFit
from lfrtorch.linear.subspace import SubspaceEstimate

FIRST_STEPS = 8
"""Iterations after which the searches are compared."""

_SAME = 1.0 + 2e-6
"""Two searches are in the same minimum if the ratio of their costs is at most this."""

ALIKE = 1.001
"""Candidates whose costs differ by a factor below this count as one."""


Problem = ResponseFit | SignalFit


class Candidate(NamedTuple):
    """Subspace estimate with the best B and D, and its cost."""

    cost: float
    estimate: SubspaceEstimate
    matrices: Matrices


def candidates(problem: Problem, nx: int, more: Sequence[SubspaceEstimate] = ()) -> list[Candidate]:
    """Return the candidates of finite cost, those of ``more`` included, the best one first."""
    found = []
    for estimate in (*problem.subspace_estimates(nx), *more):
        cost, matrices = problem.with_input_matrices(estimate.A, estimate.C)
        if np.isfinite(cost):
            found.append(Candidate(cost, estimate, matrices))
    if not found:
        raise no_start(nx)
    return sorted(found, key=lambda each: each.cost)


def no_start(nx: int) -> InputError:
    """Say that no candidate has a finite cost."""
    return InputError(
        f"no stable linear model of order {nx} could be started from these data; "
        "try a lower nx or a longer record."
    )


def best_minimum(
    problem: Problem, tried: list[Candidate], max_iter: int
) -> tuple[SubspaceEstimate, Refined]:
    """Search from the candidates; after a few steps the best few go on, and the best is taken.

    If initial states are estimated, the most probable minimum is taken. The minimum of least cost
    may use a mode for drift: on the cascaded tanks' record, a pole of 0.999996.
    """
    field: list[Candidate] = []
    last, nx = 0.0, len(tried[0].estimate.A)
    many = problem.many(nx)
    for candidate in tried[: problem.most_candidates(nx)]:
        hopeless = field and candidate.cost >= 10.0 * tried[0].cost
        if candidate.cost > (1.03 if many else ALIKE) * last and not hopeless:
            field.append(candidate)
            last = candidate.cost
    searches: list[tuple[SubspaceEstimate, Search]] = []
    if max_iter <= FIRST_STEPS:
        field = field[:1]
    for _, estimate, matrices in field[:4] if many else field:
        search = search_from(problem, matrices)
        searches.append((estimate, search.advance(min(FIRST_STEPS, max_iter))))
        costs = [search.state.cost for _, search in searches]
        if len(costs) >= 3 and max(costs[-3:]) <= _SAME * min(costs):
            break  # the last three are all in the best minimum: the others would be, too
    searches.sort(key=lambda each: each[1].state.cost)
    apart = distinct([search.state.cost for _, search in searches], _SAME)
    finalists = [searches[i] for i in apart] or searches
    finalists = finalists[: 3 if many else 6]
    for _, search in finalists:
        search.advance(max_iter, 1e-3 if many else 0.0)
    if many:
        finalists = [min(finalists, key=lambda each: each[1].state.cost)]
        finalists[0][1].advance(max_iter)
    estimate, search = min(finalists, key=lambda each: problem.improbability(each[1]))
    return estimate, problem.refined(search)


def distinct(costs: Sequence[float], ratio: float) -> list[int]:
    """Return the places of the rising costs that are above ``ratio`` times the one before."""
    pairs = zip(costs, [0.0, *costs], strict=False)
    return [i for i, (cost, before) in enumerate(pairs) if cost > ratio * before]


def search_from(problem: Problem, matrices: Matrices) -> Search:
    """Begin a search in balanced coordinates, with states of unit standard deviation."""
    A, B, C, D = matrices
    try:
        T, inverse = transformation(problem, matrices)
        return problem.search((T @ A @ inverse, T @ B, C @ inverse, D))
    except ValueError:  # the data hardly move some states: their scaling is a rounding error
        return problem.search(matrices)


def transformation(problem: Problem, matrices: Matrices) -> tuple[Array, Array]:
    """Return T and T⁻¹ to balanced coordinates with states of unit standard deviation."""
    A, B, C, D = matrices
    T, inverse = balancing(A, B, C)
    std = problem.state_deviation((T @ A @ inverse, T @ B, C @ inverse, D))
    std = np.where(std > 0, std, 1.0)
    return T / std[:, None], inverse * std
