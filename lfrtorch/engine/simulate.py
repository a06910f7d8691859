"""Trajectories of the cell over time: from a given state, and the periodic steady state."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from numba import njit
from torch import Tensor

from lfrtorch._threads import spread
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.linearised import monodromy, slopes, spectral_radius
from lfrtorch.engine.newton import newton
from lfrtorch.engine.nonlinearity import is_network
from lfrtorch.engine.recurrence import has_kernels, linear_recurrence, to_numpy

PERIODIC_TOLERANCE = 1e-10
"""Largest |x(T) - x(0)| relative to 1 + max |x| that counts as periodic (states have unit rms)."""

PERIODIC_ROUNDING = 100.0
"""The same in multiples of the rounding error, for dtypes that cannot reach the tolerance."""

MET_ROUNDING = 4.0
"""Distance of two states, in rounding errors, at which their trajectories are taken as one."""

SETTLING_PERIODS = 3
"""Periods simulated forward before Newton's method takes over; a well damped model needs one."""

START_ITERATIONS, START_HALVINGS, START_TOLERANCE = 20, 6, 1e-10
"""Gauss-Newton steps on a start state, trials a step, and the relative gain that ends them."""

START_SEEN = 1e-9
"""Least that a start state moves the weighted outputs to be told from them."""

START_PASSES, START_FLAT = 8, 1e-4
"""Passes with a prior on a start state, and its least variance relative to the largest."""

START_ODD = 1e-3
"""Part of the cost that a prior on the start state adds at least where it makes a difference."""

MAX_PERIODS = 30
"""Passes over the record after which the periodic steady state is given up."""


class Trajectory(NamedTuple):
    """Signals of a simulation.

    Shape:
        x: (R, T + 1, nx), z: (R, T, nz), w: (R, T, nw), y: (R, T, ny), normalised units.
    """

    x: Tensor
    z: Tensor
    w: Tensor
    y: Tensor

    @property
    def finite(self) -> bool:
        """Whether nothing diverged."""
        return bool(torch.isfinite(self.y).all() and torch.isfinite(self.x[:, -1]).all())


@torch.no_grad()
def simulate(cell: LFRCell, u: Tensor, x0: Tensor, *, guess: Tensor | None = None) -> Trajectory:
    """Trajectory from the state ``x0``. A model that diverges gives infinite or NaN samples.

    On the CPU a linear model and a ``Network`` are simulated in machine code; any other map, and
    any other device, by Newton's method over all of time and, where that fails, step by step.

    Args:
        cell: the model. Its weights may have a leading axis of length R: one model a record.
        u: input.
        x0: start state.
        guess: states of a nearby trajectory, for Newton's method.

    Shape:
        u: (R, T, nu), x0: (R, nx), guess: (R, T + 1, nx).
    """
    if is_compiled(cell, u):
        return _compiled(cell, u, x0, None)
    x = newton(cell, u, x0, guess=guess)
    return _with_loop_where_lost(cell, u, x0, x)


def signals(cell: LFRCell, u: Tensor, x: Tensor) -> Trajectory:
    """The trajectory of given states x (R, T + 1, nx)."""
    z, w = cell.internal(u, x[:, :-1])
    return Trajectory(x, z, w, x[:, :-1] @ cell.Cy.mT + u @ cell.Dyu.mT + w @ cell.Dyw.mT)


@torch.no_grad()
def steady_state(cell: LFRCell, u: Tensor, guess: Tensor | None = None) -> Trajectory:
    """Trajectory with x(T) = x(0): the response to the periodic repetition of ``u``.

    In machine code the record is passed until its end state meets its start state; where that
    takes more than a few passes, Newton's method on x(T) - x(0) takes over. Elsewhere Newton's
    method over all of time closes the period, too, and passes follow where it fails. A periodic
    solution that is not stable, so that no simulation would settle to it, counts as diverged (its
    record has NaN samples), unless the search starts right on it.

    Shape:
        u: (R, T, nu), one or more whole periods; guess: (R, nx), start of the search, or
        (R, T + 1, nx), states of a nearby solution.
    """
    x0 = u.new_zeros(len(u), cell.nx) if guess is None else guess
    compiled = is_compiled(cell, u)
    if not compiled:
        states = x0 if x0.ndim == 3 else None
        x = newton(cell, u, x0[:, 0] if x0.ndim == 3 else x0, guess=states, periodic=True)
        if torch.isfinite(x).all():
            return signals(cell, u, x)
    x0 = x0[:, 0] if x0.ndim == 3 else x0
    identity = torch.eye(cell.nx, dtype=u.dtype, device=u.device)
    tolerance = max(PERIODIC_TOLERANCE, PERIODIC_ROUNDING * torch.finfo(u.dtype).eps)
    trajectory = simulate(cell, u, x0)
    lost = torch.zeros(len(u), dtype=torch.bool, device=u.device)  # diverged, or unstable
    settled, size = lost, u.new_ones(len(u))
    for passes in range(MAX_PERIODS + 1):
        end = trajectory.x[:, -1].clone()
        if passes == 0:
            size = 1.0 + trajectory.x.abs().amax(dim=(1, 2))  # of states that hardly change
        lost |= ~torch.isfinite(end).all(dim=1)
        settled = (end - x0).abs().amax(dim=1) <= tolerance * size
        if (settled | lost).all() or passes == MAX_PERIODS:
            break
        if passes < SETTLING_PERIODS:
            closer = end
        else:
            transition = monodromy(cell, trajectory.z)
            lost |= ~settled & ~(spectral_radius(transition) < 1.0)  # False for NaN
            gap = (end - x0).unsqueeze(-1)
            closer = x0 + torch.linalg.solve_ex(identity - transition, gap).result.squeeze(-1)
        x0 = torch.where((settled | lost).unsqueeze(1), x0, closer)
        if compiled:
            trajectory = _compiled(cell, u, x0, trajectory)
        else:
            trajectory = simulate(cell, u, x0, guess=trajectory.x)
    failed = (lost | ~settled)[:, None, None]
    if not failed.any():
        return trajectory
    return Trajectory(*(torch.where(failed, torch.nan, signal) for signal in trajectory))


@torch.no_grad()
def estimated_start(cell: LFRCell, u: Tensor, y: Tensor, weight: Tensor) -> Trajectory:
    """Trajectory from the most probable start state, given the output.

    The start state of least squares follows the noise where there are few samples and many states.
    The other one considered has x0ᵀ P⁻¹ x0 added to the squares of the output's errors over their
    variance, found in START_PASSES; P is the second moment of the states that the input leads to
    from rest. It is taken unless the first one is more probable under a prior of heavy tails, as
    where a system at work is left alone. Where the model is exact, or there are far more samples
    than states, they are the same.

    Shape:
        u: (R, T, nu), y: (R, T, ny), weight: (R, T, ny), factors of the errors.
    """
    R, nx = len(u), cell.nx
    counted = (weight != 0).sum(dim=(1, 2))
    rest = simulate(cell, u, u.new_zeros(R, nx))
    x = rest.x.nan_to_num(0.0, 0.0, 0.0)
    moments, axes = torch.linalg.eigh(x.mT @ x / x.shape[1])
    moments = moments.clamp_min(START_FLAT * moments[:, -1:])
    known = torch.isfinite(rest.x).all(dim=(1, 2)) & (moments > 0).all(dim=1)
    white = torch.where(known[:, None, None], axes.mT / moments.sqrt().unsqueeze(-1), 0.0)

    def variance(found: Trajectory) -> Tensor:
        errors = (weight * (found.y - y)).square().sum(dim=(1, 2))
        return errors / (counted - nx).clamp_min(1)

    def odd(found: Trajectory) -> Tensor:
        return (white @ found.x[:, 0].unsqueeze(-1)).square().sum(dim=(1, 2))

    def improbability(found: Trajectory) -> Tensor:
        return counted * variance(found).log() + nx * (odd(found) / nx).log1p()

    squares = _fitted_start(cell, u, y, weight, u.new_zeros(R, nx, nx), rest)
    stayed = ~squares.x[:, 0].any(dim=1)  # Gauss-Newton may fail on many states
    if not (known & (stayed | (odd(squares) > START_ODD * counted))).any():
        return squares
    probable = rest
    for _ in range(START_PASSES):
        prior = white * variance(probable).nan_to_num(0.0, 0.0).sqrt()[:, None, None]
        probable = _fitted_start(cell, u, y, weight, prior, probable)
    least = improbability(squares).nan_to_num(math.inf)
    better = known & (improbability(probable).nan_to_num(math.inf) < least)
    pairs = zip(probable, squares, strict=True)
    return Trajectory(*(torch.where(better[:, None, None], a, b) for a, b in pairs))


def _fitted_start(
    cell: LFRCell, u: Tensor, y: Tensor, weight: Tensor, prior: Tensor, best: Trajectory
) -> Trajectory:
    """Trajectory of the start state that minimises |weight (y_hat - y)|² + |prior x0|².

    Shape:
        prior: (R, nx, nx).
    """

    def squares(trajectory: Trajectory, x0: Tensor) -> Tensor:
        errors = (weight * (trajectory.y - y)).square().sum(dim=(1, 2))
        return errors + (prior @ x0.unsqueeze(-1)).square().sum(dim=(1, 2))

    x0 = best.x[:, 0].clone()
    cost = squares(best, x0)
    for _ in range(START_ITERATIONS):
        F, H = slopes(cell, best.z)
        identity = torch.eye(cell.nx).to(x0).expand_as(F[:, 0])
        free = H @ linear_recurrence(F, torch.zeros_like(F), identity)[:, :-1]
        rows = torch.cat([(weight.unsqueeze(-1) * free).flatten(1, 2), prior], dim=1)
        errors = (weight * (best.y - y)).flatten(1).unsqueeze(-1)
        errors = torch.cat([errors, prior @ x0.unsqueeze(-1)], dim=1)
        usable = torch.isfinite(rows).all(dim=(1, 2)) & torch.isfinite(cost)
        rows, errors = (torch.where(usable[:, None, None], t, 0.0) for t in (rows, errors))
        # A state that the output does not show stays where it is.
        seen = START_SEEN * weight.abs().amax()
        step = -(torch.linalg.pinv(rows, atol=seen, rtol=START_SEEN) @ errors).squeeze(-1)
        before = cost
        waiting = usable.clone()
        for _ in range(START_HALVINGS):
            trial = simulate(cell, u, x0 + step)
            trial_cost = squares(trial, x0 + step)
            better = waiting & (trial_cost < cost)  # False for NaN
            x0 = torch.where(better[:, None], x0 + step, x0)
            cost = torch.where(better, trial_cost, cost)
            pairs = zip(trial, best, strict=True)
            best = Trajectory(*(torch.where(better[:, None, None], t, b) for t, b in pairs))
            waiting &= ~better
            if not waiting.any():
                break
            step = step / 4
        if not (cost < (1.0 - START_TOLERANCE) * before).any():
            break
    return best


def is_compiled(cell: LFRCell, u: Tensor) -> bool:
    """Whether the cell is simulated in machine code, on signals like ``u``."""
    return has_kernels(u) and (cell.static is None or is_network(cell.static))


def _with_loop_where_lost(cell: LFRCell, u: Tensor, x0: Tensor, x: Tensor) -> Trajectory:
    """The trajectory of the states x (R, T + 1, nx), NaN ones found step by step."""
    lost = ~torch.isfinite(x).all(dim=(1, 2))
    if lost.any():
        x = torch.where(lost[:, None, None], _loop(cell, u, x0), x)
    return signals(cell, u, x)


def _loop(cell: LFRCell, u: Tensor, x0: Tensor) -> Tensor:
    """States (R, T + 1, nx), one step after another, any static map and device: the oracle."""
    states = [x0.unsqueeze(1)]
    for u_k in u.split(1, dim=1):
        states.append(cell(u_k, states[-1])[1])
    return torch.cat(states, dim=1)


def _compiled(cell: LFRCell, u: Tensor, x0: Tensor, near: Trajectory | None) -> Trajectory:
    """Trajectory of a linear cell or one hidden layer, in machine code on the CPU.

    ``near`` is that of the same model and input from another start; once the two have met to
    rounding, the rest is taken from there. It is overwritten.
    """
    R, T = u.shape[:2]
    if near is None:
        sizes = ((T + 1, cell.nx), (T, cell.nz), (T, cell.nw), (T, cell.ny))
        near = Trajectory(*(u.new_full((R, *size), torch.nan) for size in sizes))
    near.x[:, 0] = x0
    if cell.static is None:
        vectors, matrices, activation = [u.new_zeros(0)] * 2, [u.new_zeros(0, 0)] * 2, "tanh"
    else:
        assert is_network(cell.static)
        network = cell.static
        vectors, matrices = [network.bz, network.bw], [network.Wz.mT, network.Ww]
        activation = network.activation
    lti = (cell.A, cell.Bu, cell.Bw, cell.Cz, cell.Dzu, cell.Cy, cell.Dyu, cell.Dyw)
    # A leading axis, for one model or one a record.
    weights = [m if m.ndim == 3 else m.unsqueeze(0) for m in (*lti, *matrices)]
    weights += [v if v.ndim == 3 else v[None, None] for v in vectors]
    met_within = MET_ROUNDING * torch.finfo(u.dtype).eps
    arguments = [to_numpy(u), *map(to_numpy, weights), _ACTIVATION_CODES[activation], met_within]
    spread(_run, R, *arguments, *(signal.numpy() for signal in near))
    return near


_ACTIVATION_CODES = {"tanh": 0, "sigmoid": 1, "relu": 2, "rbf": 3, "softplus": 4}


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _run(
    r, u, A, Bu, Bw, Cz, Dzu, Cy, Dyu, Dyw, WzT, Ww, bz, bw, activation, met_within, x, z, w, y
):  # fmt: skip
    m = min(r, len(A) - 1)  # which model
    A, Bu, Bw, Cz, Dzu, Cy, Dyu, Dyw = A[m], Bu[m], Bw[m], Cz[m], Dzu[m], Cy[m], Dyu[m], Dyw[m]
    WzT, Ww, bz, bw = WzT[m], Ww[m], bz[m, 0], bw[m, 0]
    u, x, z, w, y = u[r], x[r], z[r], w[r], y[r]
    h = np.empty(len(bz), u.dtype)
    for k in range(len(u)):
        _affine(Cz, x[k], Dzu, u[k], z[k])
        for n in range(len(h)):
            h[n] = bz[n]
        for j in range(z.shape[1]):
            for n in range(len(h)):
                h[n] += WzT[j, n] * z[k, j]
        _activate(activation, h)
        for i in range(w.shape[1]):
            w[k, i] = bw[i] + _dot(Ww[i], h)
        _affine(Cy, x[k], Dyu, u[k], y[k])
        for i in range(len(Dyw)):
            for j in range(w.shape[1]):
                y[k, i] += Dyw[i, j] * w[k, j]
        met = True
        for i in range(len(A)):
            a = u.dtype.type(0)
            for j in range(len(A)):
                a += A[i, j] * x[k, j]
            for j in range(u.shape[1]):
                a += Bu[i, j] * u[k, j]
            for j in range(w.shape[1]):
                a += Bw[i, j] * w[k, j]
            # What stood there is the other trajectory, or NaN, which nothing meets.
            met = met and abs(a - x[k + 1, i]) <= met_within * (1.0 + abs(a))
            x[k + 1, i] = a
        if met:
            return


@njit(nogil=True, inline="always")
def _affine(C, x, D, u, out):
    for i in range(len(out)):
        a = out.dtype.type(0)
        for j in range(len(x)):
            a += C[i, j] * x[j]
        for j in range(len(u)):
            a += D[i, j] * u[j]
        out[i] = a


@njit(nogil=True, fastmath={"contract", "reassoc"})
def _dot(a, b):
    total = a.dtype.type(0)
    for n in range(len(a)):
        total += a[n] * b[n]
    return total


@njit(nogil=True, fastmath={"contract"})
def _activate(activation, h):
    """σ of all neurons in place, in loops that the compiler can turn into vector instructions."""
    if activation == 0:
        for n in range(len(h)):
            e = _exp(-2.0 * abs(h[n]))
            t = math.copysign((1.0 - e) / (1.0 + e), h[n])
            h[n] = t if h[n] == h[n] else h[n]  # NaN stays
    elif activation == 1:
        for n in range(len(h)):
            e = _exp(-abs(h[n]))
            t = (1.0 if h[n] > 0.0 else e) / (1.0 + e)
            h[n] = t if h[n] == h[n] else h[n]
    elif activation == 2:
        for n in range(len(h)):
            h[n] = max(h[n], 0.0)
    elif activation == 3:
        for n in range(len(h)):
            t = _exp(-h[n] * h[n])
            h[n] = t if h[n] == h[n] else h[n]
    else:
        for n in range(len(h)):
            t = max(h[n], 0.0) + math.log1p(_exp(-abs(h[n])))
            h[n] = t if h[n] == h[n] else h[n]


_STEPS = 32  # of an octave
_POWERS = 2.0 ** (-np.arange(_STEPS * 1024) / _STEPS)
_LOWEST = -700.0
_PER_STEP = _STEPS / math.log(2.0)
_STEP_HIGH = 6.93147180369123816490e-01 / _STEPS  # sum: ln 2 / 32; products with integers are exact
_STEP_LOW = 1.90821492927058770002e-10 / _STEPS
_C2, _C3, _C4, _C5, _C6 = (1.0 / math.factorial(n) for n in range(2, 7))


@njit(nogil=True, inline="always")
def _exp(v):
    """exp(v) for v <= 0, to rounding: exp(v) = 2^(-k / 32) exp(r) with |r| <= ln(2) / 64.

    Twice as fast as the library's in a loop over neurons, as it has no branch.
    """
    v = v if v > _LOWEST else _LOWEST  # NaN, too: the index must stay in the table
    k = np.int32(0.5 - v * _PER_STEP)
    r = v + k * _STEP_HIGH + k * _STEP_LOW
    p = r * r * (_C2 + r * (_C3 + r * (_C4 + r * (_C5 + r * _C6))))
    return _POWERS[k] + _POWERS[k] * (r + p)
