"""The initial state of a record, estimated from its output.

An output tells the initial state until the last sample with a weight, and no longer than until the
transition Φ(k) = ∂x(k)/∂x(0) has faded. Later samples cost nothing here but, before a fit, one
simulation from rest.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lfrtorch._support.threads import to_float64
from lfrtorch._support.types import Array, Booleans
from lfrtorch.engine.linearised import linearise
from lfrtorch.engine.sensitivity import Linearisation
from lfrtorch.engine.simulation import Numbers, Trajectory, simulate, simulate_near
from lfrtorch.engine.weights import Weights

ITERATIONS, _HALVINGS, _TOLERANCE = 20, 6, 1e-8
"""Most Gauss-Newton steps, trials in a step, and the relative decrease that ends the search."""

_SEEN = 1e-9
"""A direction of the initial state is estimated if it moves the weighted output by this much."""

_FADED = 1e-12
"""Part of an initial state that the output cannot tell: far below ``_SEEN``."""

PASSES, _FLAT = 8, 1e-4
"""Passes that estimate the prior's weight, and its least variance relative to the largest."""

_ODD = 1e-3
"""Least part of the cost that the prior adds if it makes a difference."""

_FAR = 0.1
"""Ratio of squared errors at which a state that the training data have not seen is believed. On
50 samples of measurements it is 0.2 or more where the state is wrong for the rest of the record."""

_FAR_BETTER = 0.25
"""Ratio of squared errors below which the state from a record's beginning is refined."""

_AWAY = 100.0
"""Growth of xᵀ P⁻¹ x, after the samples that tell the state, that means a runaway."""

_BEGINNING = 8
"""Least number of outputs in a beginning, for each state."""


@torch.no_grad()
def start_from_beginning(
    model: Numbers,
    u: Float[Tensor, "R T nu"],
    y: Float[Tensor, "R T ny"],
    weight: Float[Tensor, "R T ny"],
) -> Float[Tensor, "R nx"]:
    """``estimated_start``, or the state that a half, a quarter, ... of each record tells.

    The error of a long oscillation has many minima, one for each phase, and that of its beginning
    has few. A beginning's state is refined on the whole record, and taken if the squared error is
    far less.
    """

    W = model.weights()

    def squares(trajectory: Trajectory) -> Tensor:
        return (weight * (trajectory.y - y)).square().sum(dim=(1, 2)).nan_to_num(math.inf)

    best, T = simulate(W, u, estimated_start(W, u, y, weight)), u.shape[1] // 2
    while T * W.ny >= _BEGINNING * W.nx:
        begun = estimated_start(W, u[:, :T], y[:, :T], weight[:, :T])
        found = simulate_near(W, u, begun, best)
        better = squares(found) < _FAR_BETTER * squares(best)
        if better.any():
            found = _fitted_start(W, u, y, weight, found)
            pairs = zip(found, best, strict=True)
            best = Trajectory(*(torch.where(better[:, None, None], a, b) for a, b in pairs))
        T //= 2
    return best.x[:, 0]


@torch.no_grad()
def measured_start(
    model: Numbers, u: Float[Tensor, "R nu"], y: Float[Tensor, "R ny"]
) -> Float[Tensor, "R nx"]:
    """The state nearest to rest whose output is the measured one, or nearest to it."""
    W = model.weights()
    x = u.new_zeros(len(u), W.nx)
    for _ in range(ITERATIONS):
        z, w = W.internal(u, x)
        error = y - (x @ W.Cy.mT + u @ W.Dyu.mT + w @ W.Dyw.mT)
        H = linearise(W, z.unsqueeze(1)).H.squeeze(1)
        if not torch.isfinite(H).all():
            break
        step = (torch.linalg.pinv(H, rtol=_SEEN) @ error.unsqueeze(-1)).squeeze(-1)
        x = x + step
        if not (step.abs() > _TOLERANCE * (1.0 + x.abs())).any():
            break
    return x


@torch.no_grad()
def estimated_start(
    model: Numbers,
    u: Float[Tensor, "R T nu"],
    y: Float[Tensor, "R T ny"],
    weight: Float[Tensor, "R T ny"],
    near: Float[Tensor, "R nx"] | None = None,
) -> Float[Tensor, "R nx"]:
    """The most probable initial state, given the output and the factors of its errors.

    Least squares alone follows the noise if samples are few and states many, and the model's
    errors, which are as slow as its states. So a normal prior adds x0ᵀ P⁻¹ x0 to the squared errors
    over their variance, see ``state_moments``; PASSES estimate that variance. The state of least
    squares is taken if it is far better, as a system may begin far from where the training data
    have been, or if the prior makes no difference, as with far more samples than states. From a
    state after which the model runs away, though it does not from rest, the simulation begins at
    rest instead. ``near`` is the state of a model close to this one: the search begins there, if
    its errors are less than those from rest.
    """
    W = model.weights()
    R, nx = len(u), W.nx
    counted = (weight != 0).sum(dim=(1, 2))
    # Prior: P = axes diag(moments) axesᵀ, so that |white x0|² = x0ᵀ P⁻¹ x0.
    moments, axes = torch.linalg.eigh(state_moments(W, u))
    known = moments[:, -1] > 0
    moments = torch.where(known[:, None], moments.clamp_min(_FLAT * moments[:, -1:]), 1.0)
    white = torch.where(known[:, None, None], axes.mT / moments.sqrt().unsqueeze(-1), 0.0)
    # Nothing after the last sample with a weight tells the state.
    last = int(weight.count_nonzero(dim=(0, 2)).nonzero().max()) + 1 if counted.any() else 1
    whole, u, y, weight = u, u[:, :last].contiguous(), y[:, :last], weight[:, :last]
    rest = simulate(W, u, u.new_zeros(R, nx))

    def squares(found: Trajectory) -> Tensor:
        return (weight * (found.y - y)).square().sum(dim=(1, 2))

    first, settled = rest, False
    if near is not None:
        there = simulate(W, u, near)
        closer = squares(there) < squares(rest)  # False for NaN
        settled = bool(closer.all())
        pairs = zip(there, rest, strict=True)
        first = Trajectory(*(torch.where(closer[:, None, None], a, b) for a, b in pairs))
    free = _fitted_start(W, u, y, weight, first)
    stayed = ~free.x[:, 0].any(dim=1)  # Gauss-Newton may fail on many states
    odd = (white @ free.x[:, 0].unsqueeze(-1)).square().sum(dim=(1, 2))
    if not (known & (stayed | (odd > _ODD * counted))).any():
        return _staying(W, whole, free.x, white)
    variance = squares(rest).nan_to_num(0.0, 0.0) / counted.clamp_min(1)
    spread = axes * moments.sqrt().unsqueeze(-2)
    prior = _Prior(*map(to_float64, (white, spread, variance, counted)))
    probable = _fitted_start(W, u, y, weight, first, prior, settled=settled)
    lost = ~torch.isfinite(squares(probable))
    better = ~known | lost | ((squares(free) < _FAR * squares(probable)) & (counted > 2 * nx))
    found = torch.where(better[:, None, None], free.x, probable.x)
    return _staying(W, whole, found, white)


def _staying(
    W: Weights,
    u: Float[Tensor, "R T nu"],
    x: Float[Tensor, "R S nx"],
    white: Float[Tensor, "R nx nx"],
) -> Float[Tensor, "R nx"]:
    """The first of the states x, or 0 if the model runs away after them and not from 0."""

    def farthest(states: Tensor) -> Tensor:
        return (states @ white.mT).square().sum(dim=2).amax(dim=1).nan_to_num(math.inf)

    near, x0 = farthest(x), x[:, 0]
    if u.shape[1] < x.shape[1]:
        return x0
    there = farthest(simulate(W, u, x0).x)
    away = there > _AWAY * near
    if away.any():
        away &= there > _AWAY * farthest(simulate(W, u, torch.zeros_like(x0)).x)
    return torch.where(away.unsqueeze(1), 0.0, x0)


def state_moments(model: Numbers, u: Float[Tensor, "R T nu"]) -> Float[Tensor, "R nx nx"]:
    """E x xᵀ, about 0, that initial states have before an output is known.

    It is the covariance of the states over the training data. Before a fit, when that is 1, it is
    the second moment of the states that the input excites from rest: 0 if the model diverges.
    """
    W = model.weights()
    P = W.state_covariance
    if not torch.equal(P, torch.eye(W.nx).to(P)):
        return P.expand(len(u), -1, -1)
    x = simulate(W, u, u.new_zeros(len(u), W.nx)).x
    lost = ~torch.isfinite(x).all(dim=(1, 2))
    x = torch.where(lost[:, None, None], 0.0, x)
    return x.mT @ x / x.shape[1]


class _Prior(NamedTuple):
    """v |white x0|² beside the squared errors: v is their variance, and is found with x0."""

    white: Float[Array, "R nx nx"]
    spread: Float[Array, "R nx nx"]  # its inverse
    variance: Float[Array, " R"]  # at rest: the largest
    counted: Float[Array, " R"]  # errors

    def weight(
        self,
        passes: int,
        rows: Float[Array, "R n nx"],
        errors: Float[Array, "R n 1"],
        x0: Float[Array, "R nx 1"],
    ) -> Float[Array, " R"]:
        """v after so many passes, each with the states that the linear model has at the last v."""
        variance = self.variance
        if passes == 1:
            return variance
        U, S, _ = np.linalg.svd(rows @ self.spread, full_matrices=False)
        errors = errors - rows @ x0
        along = (U.swapaxes(1, 2) @ errors)[..., 0]
        beside = np.maximum((errors**2).sum(axis=(1, 2)) - (along**2).sum(axis=1), 0.0)
        squares, counted = S**2, np.maximum(self.counted, 1)
        for _ in range(passes - 1):
            v = variance[:, None]
            left = np.divide(along * v, squares + v, out=np.zeros_like(along), where=v > 0)
            variance = ((left**2).sum(axis=1) + beside) / counted
        return variance


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
    """Trajectory from the initial state that minimises |weight (y_hat - y)|², and the prior.

    Gauss-Newton from ``best``; a step that does not lower the cost is quartered. The prior's weight
    comes down from its largest in the first steps, unless the search begins ``settled``.
    """
    # Matrices of some ten numbers are numpy's, which is quicker to call than torch.
    x0, v = to_float64(best.x[:, 0])[..., None], np.zeros(len(u))
    seen = _SEEN * float(weight.abs().amax())
    tolerance = max(_TOLERANCE, torch.finfo(u.dtype).eps)
    errors = weight * (best.y - y)

    def penalty(x0: Array) -> Array:
        return np.zeros(len(x0)) if prior is None else v * ((prior.white @ x0) ** 2).sum((1, 2))

    for k in range(ITERATIONS):
        rows, left = _factor(W, u, weight, errors, best)
        passes = PASSES if prior is None or settled else min(2**k, PASSES)
        usable: Booleans = np.asarray(np.isfinite(rows).all(axis=(1, 2)))
        if not usable.all():
            rows, left = (np.where(usable[:, None, None], part, 0.0) for part in (rows, left))
        if prior is not None:
            v = prior.weight(passes, rows, left, x0)
            scaled = prior.white * np.sqrt(v)[:, None, None]
            rows = np.concatenate([rows, scaled], axis=1)
            left = np.concatenate([left, scaled @ x0], axis=1)
        cost = before = _squares(errors) + penalty(x0)
        # A state that the output does not show stays where it is.
        U, S, Vh = np.linalg.svd(rows, full_matrices=False)
        told = np.maximum(seen, _SEEN * S[:, :1]) < S
        inverse = np.divide(1.0, S, out=np.zeros_like(S), where=told)[..., None]
        step = -(Vh.swapaxes(1, 2) @ (inverse * (U.swapaxes(1, 2) @ left)))
        # A step that should hardly lower the cost is not worth a trial.
        promised = ((rows @ step) ** 2).sum(axis=(1, 2))
        waiting = usable & np.isfinite(cost) & (promised > tolerance * cost)
        if passes == PASSES and not waiting.any():
            break
        for _ in range(_HALVINGS):
            if not waiting.any():
                break
            trial = simulate_near(W, u, torch.from_numpy((x0 + step)[..., 0]).to(u), best)
            trial_errors = weight * (trial.y - y)
            trial_cost = _squares(trial_errors) + penalty(x0 + step)
            better = waiting & (trial_cost < cost)  # False for NaN
            x0 = np.where(better[:, None, None], x0 + step, x0)
            cost = np.where(better, trial_cost, cost)
            best = _chosen(better, trial, best)
            errors = trial_errors if better.all() else weight * (best.y - y)
            waiting &= ~better
            step = step / 4
        if passes == PASSES and not (cost < (1.0 - tolerance) * before).any():
            break
    return best


def _squares(errors: Float[Tensor, "R T ny"]) -> Float[Array, " R"]:
    """The sum of squares of each record."""
    return to_float64(errors.square().sum(dim=(1, 2)))


def _chosen(better: Booleans, trial: Trajectory, best: Trajectory) -> Trajectory:
    """The trial for records where it is better."""
    if better.all() or not better.any():
        return trial if better.all() else best
    taken = torch.from_numpy(better).to(best.x.device)[:, None, None]
    return Trajectory(*(torch.where(taken, t, b) for t, b in zip(trial, best, strict=True)))


def _factor(
    W: Weights,
    u: Float[Tensor, "R T nu"],
    weight: Float[Tensor, "R T ny"],
    errors: Float[Tensor, "R T ny"],
    at: Trajectory,
) -> tuple[Float[Array, "R n nx"], Float[Array, "R n 1"]]:
    """R of the QR of [derivative by x0 | errors], weighted; NaN if it is not finite."""
    none, found = torch.zeros(0, dtype=torch.int64), []
    for block in Linearisation(W, u, at).rows(none, initial_state=True, faded=_FADED):
        records, time = block.records, block.time
        rows = weight[records, time].unsqueeze(-1) * block.rows
        part = torch.cat([rows, errors[records, time].unsqueeze(-1)], dim=-1).flatten(1, 2)
        stacked = to_float64(part)
        if time.start:
            stacked = np.concatenate([found.pop(), stacked], axis=1)
        finite: Booleans = np.asarray(np.isfinite(stacked).all(axis=(1, 2)))
        # LAPACK may not end on NaN.
        stacked = stacked if finite.all() else np.where(finite[:, None, None], stacked, 0.0)
        folded: Array = np.asarray(np.linalg.qr(stacked, mode="r"))
        folded[~finite] = np.nan
        found.append(folded)
    # Records of few samples have factors of fewer rows.
    whole = np.concatenate(found)
    return whole[..., :-1], whole[..., -1:]
