"""The initial state of a record, estimated from its output.

An output tells the initial state until the last sample with a weight, and no longer than until the
transition Φ(k) = ∂x(k)/∂x(0) has faded. Later samples cost nothing here but, before a fit, one
simulation from rest.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.linear_recurrence import linear_recurrence
from lfrtorch.engine.linearised import linearise
from lfrtorch.engine.simulation import Trajectory, simulate, simulate_near

ITERATIONS, _HALVINGS, _TOLERANCE = 20, 6, 1e-8
"""Most Gauss-Newton steps, trials in a step, and the relative decrease that ends the search."""

_SEEN = 1e-9
"""A direction of the initial state is estimated if it moves the weighted output by this much."""

_FADED = 1e-12
"""Part of an initial state that the output cannot tell: far below ``_SEEN``."""

BLOCK = 1 << 11
"""Samples, of all records together, whose rows are folded into the triangular factor at once."""

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
    cell: LFRCell,
    u: Float[Tensor, "R T nu"],
    y: Float[Tensor, "R T ny"],
    weight: Float[Tensor, "R T ny"],
) -> Float[Tensor, "R nx"]:
    """``estimated_start``, or the state that a half, a quarter, ... of each record tells.

    The error of a long oscillation has many minima, one for each phase, and that of its beginning
    has few. A beginning's state is refined on the whole record, and taken if the squared error is
    far less.
    """

    def squares(trajectory: Trajectory) -> Tensor:
        return (weight * (trajectory.y - y)).square().sum(dim=(1, 2)).nan_to_num(math.inf)

    best, T = simulate(cell, u, estimated_start(cell, u, y, weight)), u.shape[1] // 2
    while T * cell.ny >= _BEGINNING * cell.nx:
        begun = estimated_start(cell, u[:, :T], y[:, :T], weight[:, :T])
        found = simulate_near(cell, u, begun, best)
        better = squares(found) < _FAR_BETTER * squares(best)
        if better.any():
            found = _fitted_start(cell, u, y, weight, found)
            pairs = zip(found, best, strict=True)
            best = Trajectory(*(torch.where(better[:, None, None], a, b) for a, b in pairs))
        T //= 2
    return best.x[:, 0]


@torch.no_grad()
def measured_start(
    cell: LFRCell, u: Float[Tensor, "R nu"], y: Float[Tensor, "R ny"]
) -> Float[Tensor, "R nx"]:
    """The state nearest to rest whose output is the measured one, or nearest to it."""
    x = u.new_zeros(len(u), cell.nx)
    for _ in range(ITERATIONS):
        z, w = cell.internal(u, x)
        error = y - (x @ cell.Cy.mT + u @ cell.Dyu.mT + w @ cell.Dyw.mT)
        H = linearise(cell, z.unsqueeze(1)).H.squeeze(1)
        if not torch.isfinite(H).all():
            break
        step = (torch.linalg.pinv(H, rtol=_SEEN) @ error.unsqueeze(-1)).squeeze(-1)
        x = x + step
        if not (step.abs() > _TOLERANCE * (1.0 + x.abs())).any():
            break
    return x


@torch.no_grad()
def estimated_start(
    cell: LFRCell,
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
    R, nx = len(u), cell.nx
    counted = (weight != 0).sum(dim=(1, 2))
    # Prior: P = axes diag(moments) axesᵀ, so that |white x0|² = x0ᵀ P⁻¹ x0.
    moments, axes = torch.linalg.eigh(state_moments(cell, u))
    known = moments[:, -1] > 0
    moments = torch.where(known[:, None], moments.clamp_min(_FLAT * moments[:, -1:]), 1.0)
    white = torch.where(known[:, None, None], axes.mT / moments.sqrt().unsqueeze(-1), 0.0)
    # Nothing after the last sample with a weight tells the state.
    last = int(weight.count_nonzero(dim=(0, 2)).nonzero().max()) + 1 if counted.any() else 1
    whole, u, y, weight = u, u[:, :last], y[:, :last], weight[:, :last]
    rest = simulate(cell, u, u.new_zeros(R, nx))

    def squares(found: Trajectory) -> Tensor:
        return (weight * (found.y - y)).square().sum(dim=(1, 2))

    first, settled = rest, False
    if near is not None:
        there = simulate(cell, u, near)
        closer = squares(there) < squares(rest)  # False for NaN
        settled = bool(closer.all())
        pairs = zip(there, rest, strict=True)
        first = Trajectory(*(torch.where(closer[:, None, None], a, b) for a, b in pairs))
    free = _fitted_start(cell, u, y, weight, first)
    stayed = ~free.x[:, 0].any(dim=1)  # Gauss-Newton may fail on many states
    odd = (white @ free.x[:, 0].unsqueeze(-1)).square().sum(dim=(1, 2))
    if not (known & (stayed | (odd > _ODD * counted))).any():
        return _staying(cell, whole, free.x, white)
    variance = squares(rest).nan_to_num(0.0, 0.0) / counted.clamp_min(1)
    prior = _Prior(white, axes * moments.sqrt().unsqueeze(-2), variance, counted)
    probable = _fitted_start(cell, u, y, weight, first, prior, settled=settled)
    lost = ~torch.isfinite(squares(probable))
    better = ~known | lost | ((squares(free) < _FAR * squares(probable)) & (counted > 2 * nx))
    found = torch.where(better[:, None, None], free.x, probable.x)
    return _staying(cell, whole, found, white)


def _staying(
    cell: LFRCell,
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
    there = farthest(simulate(cell, u, x0).x)
    away = there > _AWAY * near
    if away.any():
        away &= there > _AWAY * farthest(simulate(cell, u, torch.zeros_like(x0)).x)
    return torch.where(away.unsqueeze(1), 0.0, x0)


def state_moments(cell: LFRCell, u: Float[Tensor, "R T nu"]) -> Float[Tensor, "R nx nx"]:
    """E x xᵀ, about 0, that initial states have before an output is known.

    It is the covariance of the states over the training data. Before a fit, when that is 1, it is
    the second moment of the states that the input excites from rest: 0 if the model diverges.
    """
    P = cell.state_covariance
    if not torch.equal(P, torch.eye(cell.nx).to(P)):
        return P.expand(len(u), -1, -1)
    x = simulate(cell, u, u.new_zeros(len(u), cell.nx)).x
    lost = ~torch.isfinite(x).all(dim=(1, 2))
    x = torch.where(lost[:, None, None], 0.0, x)
    return x.mT @ x / x.shape[1]


class _Prior(NamedTuple):
    """v |white x0|² beside the squared errors: v is their variance, and is found with x0."""

    white: Float[Tensor, "R nx nx"]
    spread: Float[Tensor, "R nx nx"]  # its inverse
    variance: Float[Tensor, " R"]  # at rest: the largest
    counted: Float[Tensor, " R"]  # errors

    def weight(
        self,
        passes: int,
        rows: Float[Tensor, "R n nx"],
        errors: Float[Tensor, "R n 1"],
        x0: Float[Tensor, "R nx"],
    ) -> Float[Tensor, " R"]:
        """v after so many passes, each with the states that the linear model has at the last v."""
        variance = self.variance
        if passes == 1:
            return variance
        U, S, _ = torch.linalg.svd(rows @ self.spread, full_matrices=False)
        errors = errors - rows @ x0.unsqueeze(-1)
        along = (U.mT @ errors).squeeze(-1)
        beside = (errors.square().sum(dim=(1, 2)) - along.square().sum(dim=1)).clamp_min(0.0)
        for _ in range(passes - 1):
            v = variance.unsqueeze(1)
            left = torch.where(v > 0, along * v / (S.square() + v), 0.0)
            variance = (left.square().sum(dim=1) + beside) / self.counted.clamp_min(1)
        return variance


def _fitted_start(
    cell: LFRCell,
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
    x0, v = best.x[:, 0].clone(), u.new_zeros(len(u))
    white = u.new_zeros(len(u), 0, cell.nx) if prior is None else prior.white
    seen = _SEEN * weight.abs().amax()
    tolerance = max(_TOLERANCE, torch.finfo(u.dtype).eps)

    def squares(trajectory: Trajectory, x0: Tensor) -> Tensor:
        errors = (weight * (trajectory.y - y)).square().sum(dim=(1, 2))
        return errors + v * (white @ x0.unsqueeze(-1)).square().sum(dim=(1, 2))

    for k in range(ITERATIONS):
        rows, errors = _factor(cell, weight, weight * (best.y - y), best)
        passes = PASSES if prior is None or settled else min(2**k, PASSES)
        usable = torch.isfinite(rows).all(dim=(1, 2))
        rows, errors = (torch.where(usable[:, None, None], t, 0.0) for t in (rows, errors))
        if prior is not None:
            v = prior.weight(passes, rows, errors, x0)
            scaled = white * v.sqrt()[:, None, None]
            rows = torch.cat([rows, scaled], dim=1)
            errors = torch.cat([errors, scaled @ x0.unsqueeze(-1)], dim=1)
        cost = before = squares(best, x0)
        # A state that the output does not show stays where it is.
        step = -(torch.linalg.pinv(rows, atol=seen, rtol=_SEEN) @ errors).squeeze(-1)
        # A step that should hardly lower the cost is not worth a trial.
        promised = (rows @ step.unsqueeze(-1)).square().sum(dim=(1, 2))
        waiting = usable & torch.isfinite(cost) & (promised > tolerance * cost)
        if passes == PASSES and not waiting.any():
            break
        for _ in range(_HALVINGS):
            if not waiting.any():
                break
            trial = simulate_near(cell, u, x0 + step, best)
            trial_cost = squares(trial, x0 + step)
            better = waiting & (trial_cost < cost)  # False for NaN
            x0 = torch.where(better[:, None], x0 + step, x0)
            cost = torch.where(better, trial_cost, cost)
            pairs = zip(trial, best, strict=True)
            best = Trajectory(*(torch.where(better[:, None, None], t, b) for t, b in pairs))
            waiting &= ~better
            step = step / 4
        if passes == PASSES and not (cost < (1.0 - tolerance) * before).any():
            break
    return best


def _factor(
    cell: LFRCell,
    weight: Float[Tensor, "R T ny"],
    errors: Float[Tensor, "R T ny"],
    at: Trajectory,
) -> tuple[Float[Tensor, "R n nx"], Float[Tensor, "R n 1"]]:
    """R of the QR of [derivative by x0 | errors], weighted.

    dy(k)/dx0 = H(k) Φ(k) with Φ(k+1) = F(k) Φ(k), Φ(0) = I.
    """
    R, T, _ = weight.shape
    Phi = torch.eye(cell.nx).to(weight).expand(R, -1, -1)
    folded = Phi.new_zeros(R, 0, cell.nx + 1)
    length = max(1, BLOCK // R)
    for k in range(0, T, length):
        block = slice(k, k + length)
        F, H = linearise(cell, at.z[:, block])
        Phis = linear_recurrence(F, torch.zeros_like(F), Phi)
        rows = weight[:, block].unsqueeze(-1) * (H @ Phis[:, :-1])
        both = torch.cat([rows.flatten(1, 2), errors[:, block].flatten(1).unsqueeze(-1)], dim=2)
        stacked = torch.cat([folded, both], dim=1)
        lost = ~torch.isfinite(stacked).all(dim=2).all(dim=1)
        # LAPACK may not end on NaN.
        folded = torch.linalg.qr(torch.where(lost[:, None, None], 0.0, stacked), mode="r").R
        folded[lost] = torch.nan
        Phi = Phis[:, -1]
        if Phi.abs().amax() < _FADED:
            break
    return folded[..., :-1], folded[..., -1:]
