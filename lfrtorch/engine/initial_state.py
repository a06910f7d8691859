"""The initial state of a record, estimated from its output.

The output depends on the initial state until the transition Φ(k) = ∂x(k)/∂x(0) has decayed, and it
counts up to the last sample with a weight. Later samples are not simulated, except once from rest
before a fit. The search is in ``start_kernel``. A model whose map has no machine code takes the
same steps in torch, for all records at once.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from lfrtorch._support.threads import spread_loop, to_float64
from lfrtorch._support.types import Array, Booleans, Integers
from lfrtorch.engine.linearised import linearise
from lfrtorch.engine.sensitivity import Linearisation
from lfrtorch.engine.simulation import Numbers, Trajectory, simulate, simulate_near
from lfrtorch.engine.start_kernel import (
    FADED,
    HALVINGS,
    ITERATIONS,
    PASSES,
    SEEN,
    TOLERANCE,
    fit_starts,
    step_of,
)
from lfrtorch.engine.weights import Weights

_FLAT = 1e-4
"""Smallest variance of the prior relative to the largest."""

_ODD = 1e-3
"""The prior counts as making no difference if it adds less than this part of the cost."""

_FAR = 0.1
"""Ratio of squared errors below which a state far from the training data is accepted. Over 50
measured samples the ratio of a few states is at least 0.2 if the state is wrong for the rest of
the record; of 15 states of a mean it is below 0.1, so that a beginning of that size must count."""

_FAR_BETTER = 0.25
"""Ratio of squared errors below which the state from a record's beginning is refined."""

_AWAY = 100.0
"""Growth of xᵀ P⁻¹ x, after the samples that determine the state, that counts as divergence."""

_BEGINNING = 8
"""Smallest number of outputs in a beginning, for each state."""


@torch.no_grad()
@np.errstate(over="ignore", invalid="ignore")
def start_from_beginning(
    model: Numbers,
    u: Float[Tensor, "R T nu"],
    y: Float[Tensor, "R T ny"],
    weight: Float[Tensor, "R T ny"],
) -> Float[Tensor, "R nx"]:
    """Initial state by ``estimated_start``, or from the first half, quarter, ... of each record.

    The error over a long oscillation has many minima, one for each phase; the error over its
    beginning has few. The state from a beginning is refined on the whole record, and kept if it
    makes the squared error far smaller.
    """
    W = model.weights()
    best, T = simulate(W, u, estimated_start(W, u, y, weight)), u.shape[1] // 2
    while T * W.ny >= _BEGINNING * W.nx:
        begun = estimated_start(W, u[:, :T], y[:, :T], weight[:, :T])
        found = simulate_near(W, u, begun, best)
        least, squares = _squares(weight, best, y), _squares(weight, found, y)
        better = np.asarray(squares < _FAR_BETTER * np.nan_to_num(least, nan=np.inf))
        if better.any():
            best = _chosen(better, _fitted_start(W, u, y, weight, found), best)
        T //= 2
    return best.x[:, 0]


@torch.no_grad()
def measured_start(
    model: Numbers, u: Float[Tensor, "R nu"], y: Float[Tensor, "R ny"]
) -> Float[Tensor, "R nx"]:
    """State nearest to rest whose output equals, or is nearest to, the measured output."""
    W = model.weights()
    x = u.new_zeros(len(u), W.nx)
    for _ in range(ITERATIONS):
        z, w = W.internal(u, x)
        error = y - (x @ W.Cy.mT + u @ W.Dyu.mT + w @ W.Dyw.mT)
        H = linearise(W, z.unsqueeze(1)).H.squeeze(1)
        if not torch.isfinite(H).all():
            break
        step = (torch.linalg.pinv(H, rtol=SEEN) @ error.unsqueeze(-1)).squeeze(-1)
        x = x + step
        if not (step.abs() > TOLERANCE * (1.0 + x.abs())).any():
            break
    return x


@torch.no_grad()
@np.errstate(over="ignore", invalid="ignore")
def estimated_start(
    model: Numbers,
    u: Float[Tensor, "R T nu"],
    y: Float[Tensor, "R T ny"],
    weight: Float[Tensor, "R T ny"],
    near: Float[Tensor, "R nx"] | None = None,
) -> Float[Tensor, "R nx"]:
    """The most probable initial state, given the output and the factors of its errors.

    Least squares alone fits noise and slow model errors if samples are few and states are many. So
    a normal prior adds x0ᵀ P⁻¹ x0 (``state_moments``) to the squared errors over their variance,
    which several passes estimate (``PASSES``). The least squares state is kept in two cases: if it
    is far better over at least 8 outputs for each state, as a system may begin far from the
    training data; or if the prior makes no difference, as with far more samples than states. A
    state from which the model diverges is replaced by rest, if the model does not diverge from
    rest. ``near`` is the initial state of a similar model: the search begins there if its errors
    are smaller than those from rest.
    """
    W = model.weights()
    nx, factors = W.nx, to_float64(weight)
    counted = np.count_nonzero(factors, axis=(1, 2))
    # Prior: P = axes diag(moments) axesᵀ, so that |white x0|² = x0ᵀ P⁻¹ x0.
    moments, axes = np.linalg.eigh(state_moments(W, u))
    known: Booleans = np.asarray(moments[:, -1] > 0.0)
    moments = np.where(known[:, None], np.maximum(moments, _FLAT * moments[:, -1:]), 1.0)
    deviations = np.sqrt(moments)[:, None]
    white = np.ascontiguousarray((axes / deviations).swapaxes(1, 2)) * known[:, None, None]
    # Samples after the last sample with a weight are left out.
    last = 1 + int(np.flatnonzero(factors.any(axis=(0, 2))).max(initial=0))
    whole, u, y, weight = u, u[:, :last].contiguous(), y[:, :last], weight[:, :last]
    rest = simulate(W, u, None)
    at_rest = _squares(weight, rest, y)
    first, settled = rest, False
    if near is not None:
        there = simulate(W, u, near)
        closer: Booleans = np.asarray(_squares(weight, there, y) < at_rest)  # False for NaN
        settled = bool(closer.all())
        first = _chosen(closer, there, rest)
    free = _fitted_start(W, u, y, weight, first)
    x0 = to_float64(free.x[:, 0])
    stayed = ~x0.any(axis=1)  # Gauss-Newton may fail if there are many states
    odd = ((white @ x0[..., None]) ** 2).sum(axis=(1, 2)) > _ODD * counted
    found = free
    if (known & (stayed | odd)).any():
        variance = np.nan_to_num(at_rest, nan=0.0, posinf=0.0) / np.maximum(counted, 1)
        prior = _Prior(white, axes * deviations, variance, counted)
        probable = _fitted_start(W, u, y, weight, first, prior, settled=settled)
        squares = _squares(weight, probable, y)
        far = (_squares(weight, free, y) < _FAR * squares) & (counted >= _BEGINNING * nx)
        found = _chosen(~known | ~np.isfinite(squares) | far, free, probable)
    return found.x[:, 0] if last == len(whole[0]) else _staying(W, whole, found.x, white)


def _staying(
    W: Weights,
    u: Float[Tensor, "R T nu"],
    x: Float[Tensor, "R S nx"],
    white: Float[Array, "R nx nx"],
) -> Float[Tensor, "R nx"]:
    """First of the states x; 0 if the model diverges after these states, but not from 0."""

    def farthest(states: Tensor) -> Array:
        sizes = ((to_float64(states) @ white.swapaxes(1, 2)) ** 2).sum(axis=2).max(axis=1)
        return np.nan_to_num(sizes, nan=np.inf, posinf=np.inf)

    near, x0 = _AWAY * farthest(x), x[:, 0]
    away: Booleans = np.asarray(farthest(simulate(W, u, x0).x) > near)
    if away.any():
        away &= ~(farthest(simulate(W, u, None).x) > near)
    return torch.where(torch.from_numpy(away).to(x0.device)[:, None], 0.0, x0)


@np.errstate(over="ignore", invalid="ignore")
def state_moments(model: Numbers, u: Float[Tensor, "R T nu"]) -> Float[Array, "R nx nx"]:
    """Prior second moment E x xᵀ, about 0, of initial states.

    After a fit it is the covariance of the states over the training data. Before a fit, when
    ``state_covariance`` is the identity, it is the second moment of the states that the input
    excites from rest, or 0 if the model diverges.
    """
    W = model.weights()
    P = to_float64(W.state_covariance)
    if not np.array_equal(P, np.eye(W.nx)):
        return np.broadcast_to(P, (len(u), W.nx, W.nx))
    x = to_float64(simulate(W, u, None).x)
    moments = x.swapaxes(1, 2) @ x / x.shape[1]
    kept: Booleans = np.asarray(np.isfinite(moments).all(axis=(1, 2)))  # squares may overflow, too
    return np.where(kept[:, None, None], moments, 0.0)


class _Prior(NamedTuple):
    """Prior term v |white x0|² beside the squared errors; their variance v is estimated with x0."""

    white: Float[Array, "R nx nx"]
    spread: Float[Array, "R nx nx"]  # inverse of ``white``
    variance: Float[Array, " R"]  # upper limit of v, from the errors of a start at rest
    counted: Int[Integers, " R"]  # number of errors


def _fitted_start(
    W: Weights,
    u: Float[Tensor, "R T nu"],
    y: Float[Tensor, "R T ny"],
    weight: Float[Tensor, "R T ny"],
    best: Trajectory,
    prior: _Prior | None = None,
    *,
    settled: bool = False,
) -> Trajectory:
    """Trajectory from the initial state that minimises |weight (y_hat - y)|² plus the prior.

    Gauss-Newton from ``best``; a step that does not lower the cost is quartered. The weight of the
    prior falls from its largest value in the first steps, unless the search begins ``settled``.
    """
    if prior is None:
        none = np.zeros((len(u), W.nx, W.nx))
        prior = _Prior(none, none, np.zeros(len(u)), np.zeros(len(u), np.int64))
        passes = 0
    else:
        passes = PASSES if settled else 1
    if not W.layout.compiled:
        return _fitted_by_torch(W, u, y, weight, best, prior, passes)
    found = [to_float64(signal).copy() for signal in best]
    given = [to_float64(signal) for signal in (u, y, weight)]
    spread_loop(fit_starts, len(u), *W.arguments, *given, *prior, passes, *found)
    return Trajectory(*(torch.from_numpy(signal).to(u) for signal in found))


def _fitted_by_torch(
    W: Weights,
    u: Float[Tensor, "R T nu"],
    y: Float[Tensor, "R T ny"],
    weight: Float[Tensor, "R T ny"],
    best: Trajectory,
    prior: _Prior,
    passes: int,
) -> Trajectory:
    """The search of ``fit_starts``, for all records at once."""
    x0, v = to_float64(best.x[:, 0]).copy(), np.zeros(len(u))
    seen = SEEN * to_float64(weight.abs().amax(dim=(1, 2)))
    tolerance = max(TOLERANCE, torch.finfo(u.dtype).eps)
    squares = _squares(weight, best, y)

    def costs(x0: Array, squares: Array) -> Array:
        return squares + v * ((prior.white @ x0[..., None]) ** 2).sum(axis=(1, 2))

    for _ in range(ITERATIONS):
        L, usable = _factor(W, u, weight, weight * (best.y - y), best)
        step, promised = np.zeros_like(x0), np.zeros(len(u))
        for r in np.flatnonzero(usable & np.isfinite(squares)):
            white, spread, variance, counted = (part[r] for part in prior)
            step[r], promised[r], v[r] = step_of(
                L[r], squares[r], x0[r], white, spread, variance, counted, passes, seen[r]
            )
        cost = before = costs(x0, squares)
        # A step with too small a predicted decrease of the cost is not tried.
        waiting = promised > tolerance * cost  # False for NaN
        for _ in range(HALVINGS):
            if not waiting.any():
                break
            trial = simulate(W, u, torch.from_numpy(x0 + step).to(u), guess=best.x)
            reached = _squares(weight, trial, y)
            better = waiting & (costs(x0 + step, reached) < cost)  # False for NaN
            x0 = np.where(better[:, None], x0 + step, x0)
            squares = np.where(better, reached, squares)
            cost = np.where(better, costs(x0, squares), cost)
            best = _chosen(better, trial, best)
            waiting, step = waiting & ~better, step / 4.0
        if passes in (0, PASSES) and not (cost < (1.0 - tolerance) * before).any():
            break
        passes = min(2 * passes, PASSES)
    return best


def _squares(
    weight: Float[Tensor, "R T ny"], found: Trajectory, y: Float[Tensor, "R T ny"]
) -> Float[Array, " R"]:
    """The weighted sum of squared errors of each record."""
    errors = to_float64(weight) * (to_float64(found.y) - to_float64(y))
    return np.einsum("rti,rti->r", errors, errors)


def _chosen(which: Booleans, these: Trajectory, others: Trajectory) -> Trajectory:
    """Combine trajectories: some records from one set, the rest from another."""
    if which.all() or not which.any():
        return these if which.all() else others
    mask = torch.from_numpy(which).to(these.x.device)[:, None, None]
    return Trajectory(*(torch.where(mask, *pair) for pair in zip(these, others, strict=True)))


def _factor(
    W: Weights,
    u: Float[Tensor, "R T nu"],
    weight: Float[Tensor, "R T ny"],
    errors: Float[Tensor, "R T ny"],
    at: Trajectory,
) -> tuple[Float[Array, "R n n"], Booleans]:
    """Factor L of L Lᵀ = Mᵀ M, with weighted M = [∂y/∂x0 | errors], and if M is finite."""
    none, found = torch.zeros(0, dtype=torch.int64), u.new_zeros(len(u), W.nx + 1, W.nx + 1)
    for block in Linearisation(W, u, at).rows(none, initial_state=True, faded=FADED):
        rows = weight[:, block.time].unsqueeze(-1) * block.rows
        part = torch.cat([rows, errors[:, block.time].unsqueeze(-1)], dim=-1).flatten(1, 2)
        stacked = torch.cat([found, part], dim=1)
        finite = torch.isfinite(stacked).all(dim=2).all(dim=1)[:, None, None]
        # LAPACK may never return if an entry is NaN.
        R = torch.linalg.qr(torch.where(finite, stacked, 0.0), mode="r").R
        found = torch.where(finite, R, torch.nan)
    L = to_float64(found.mT)
    return L, np.asarray(np.isfinite(L).all(axis=(1, 2)))
