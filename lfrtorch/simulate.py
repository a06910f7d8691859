"""Trajectories of the cell over time: from a given state, and the periodic steady state."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from numba import njit
from torch import Tensor
from torch.func import functional_call, jacrev, vmap

from lfrtorch.cell import LFRCell
from lfrtorch.nonlinearity import Network
from lfrtorch.recurrence import linear_recurrence, to_numpy
from lfrtorch.threads import spread

PERIODIC_TOLERANCE = 1e-10
"""Largest |x(T) - x(0)| relative to 1 + max |x| that counts as periodic (states have unit rms)."""

PERIODIC_ROUNDING = 100.0
"""The same in multiples of the rounding error, for dtypes that cannot reach the tolerance."""

MET_ROUNDING = 4.0
"""Distance of two states, in rounding errors, at which their trajectories are taken as one."""

SETTLING_PERIODS = 3
"""Periods simulated forward before Newton's method takes over; a well damped model needs one."""

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


class Slopes(NamedTuple):
    """The model linearised along a trajectory: x+ = F x, y = H x.

    Shape:
        F: (R, T, nx, nx), H: (R, T, ny, nx).
    """

    F: Tensor
    H: Tensor


@torch.no_grad()
def simulate(cell: LFRCell, u: Tensor, x0: Tensor, *, near: Tensor | None = None) -> Trajectory:
    """Trajectory from the state ``x0``. A model that diverges gives infinite or NaN samples.

    Args:
        cell: the model.
        u: input.
        x0: start state.
        near: states of the same model and input from another start; once the two have met to
            rounding, the rest is taken from there. They are overwritten.

    Shape:
        u: (R, T, nu), x0: (R, nx), near: (R, T + 1, nx).
    """
    fast = u.device.type == "cpu" and (cell.static is None or type(cell.static) is Network)
    x = _states_compiled(cell, u, x0, near) if fast else _states_loop(cell, u, x0)
    z, w = cell.internal(u, x[:, :-1])
    y = x[:, :-1] @ cell.Cy.mT + u @ cell.Dyu.mT + w @ cell.Dyw.mT
    return Trajectory(x, z, w, y)


@torch.no_grad()
def steady_state(cell: LFRCell, u: Tensor, guess: Tensor | None = None) -> Trajectory:
    """Trajectory with x(T) = x(0): the response to the periodic repetition of ``u``.

    The record is passed until its end state meets its start state; where that takes more than
    a few passes, Newton's method on x(T) - x(0) takes over. A periodic solution that is not
    stable, so that no simulation would settle to it, counts as diverged (NaN samples).

    Shape:
        u: (R, T, nu), one or more whole periods; guess: (R, nx), start of the search.
    """
    x0 = u.new_zeros(len(u), cell.nx) if guess is None else guess
    identity = torch.eye(cell.nx, dtype=u.dtype, device=u.device)
    tolerance = max(PERIODIC_TOLERANCE, PERIODIC_ROUNDING * torch.finfo(u.dtype).eps)
    trajectory = simulate(cell, u, x0)
    for passes in range(MAX_PERIODS):
        if not trajectory.finite:
            break
        end = trajectory.x[:, -1].clone()
        scale = 1.0 + trajectory.x.abs().amax()
        if (end - x0).abs().amax() <= tolerance * scale:
            return trajectory
        if passes < SETTLING_PERIODS:
            x0 = end
        else:
            transition = monodromy(slopes(cell, static_jacobians(cell, trajectory.z)[0]).F)
            if not spectral_radius(transition) < 1.0:
                break
            gap = (end - x0).unsqueeze(-1)
            x0 = x0 + torch.linalg.solve(identity - transition, gap).squeeze(-1)
        trajectory = simulate(cell, u, x0, near=trajectory.x)
    return Trajectory(*(torch.full_like(signal, torch.nan) for signal in trajectory))


@torch.no_grad()
def slopes(cell: LFRCell, J: Tensor) -> Slopes:
    """The linearised model from the slopes J (R, T, nw, nz) of its static nonlinearity."""
    return Slopes(cell.A + cell.Bw @ J @ cell.Cz, cell.Cy + cell.Dyw @ J @ cell.Cz)


def static_jacobians(
    cell: LFRCell, z: Tensor, parameters: bool = False
) -> tuple[Tensor, dict[str, Tensor]]:
    """Derivatives of the static nonlinearity at every sample, by ``torch.func``.

    Returns:
        J (R, T, nw, nz), and where ``parameters`` are asked for the derivative by each parameter
        of the map, (R, T, nw, elements), by its name.
    """
    if cell.static is None:
        return z.new_zeros(*z.shape[:2], 0, 0), {}
    static = cell.static
    weights = {name: p.detach() for name, p in static.named_parameters()}

    def f(z_k: Tensor, theta: dict[str, Tensor]) -> Tensor:
        return functional_call(static, theta, (z_k,))

    flat = z.detach().reshape(-1, cell.nz)
    if not parameters:
        J = vmap(jacrev(f), in_dims=(0, None))(flat, weights)
        return J.reshape(*z.shape[:2], cell.nw, cell.nz), {}
    J, by_weight = vmap(jacrev(f, argnums=(0, 1)), in_dims=(0, None))(flat, weights)
    return J.reshape(*z.shape[:2], cell.nw, cell.nz), {
        name: d.reshape(*z.shape[:2], cell.nw, -1) for name, d in by_weight.items()
    }


def spectral_radius(matrices: Tensor) -> float:
    """Largest magnitude of an eigenvalue of (..., n, n); NaN where an entry is not finite.

    LAPACK is not asked then: some builds crash the process.
    """
    if not torch.isfinite(matrices).all():
        return float("nan")
    return float(torch.linalg.eigvals(matrices).abs().amax())


def monodromy(F: Tensor) -> Tensor:
    """Transition matrix over the whole record: the product of all F(k), last one leftmost.

    Shape:
        F: (R, T, nx, nx) -> (R, nx, nx).
    """
    identity = torch.eye(F.shape[-1], dtype=F.dtype, device=F.device).expand_as(F[:, 0])
    return linear_recurrence(F, torch.zeros_like(F), identity)[:, -1]


def _states_loop(cell: LFRCell, u: Tensor, x0: Tensor) -> Tensor:
    """One step after another, for any static map and device: the oracle."""
    states = [x0]
    for u_k in u.unbind(dim=1):
        states.append(cell(u_k, states[-1])[1])
    return torch.stack(states, dim=1)


def _states_compiled(cell: LFRCell, u: Tensor, x0: Tensor, near: Tensor | None = None) -> Tensor:
    """The same in machine code, for a linear cell or one hidden layer, on the CPU."""
    x = u.new_full((u.shape[0], u.shape[1] + 1, cell.nx), torch.nan) if near is None else near
    x[:, 0] = x0
    if cell.static is None:
        weights = [u.new_zeros(0, 0), u.new_zeros(0), u.new_zeros(0, 0), u.new_zeros(0)]
        activation = "tanh"
    else:
        assert isinstance(cell.static, Network)
        weights = [cell.static.Wz, cell.static.bz, cell.static.Ww, cell.static.bw]
        activation = cell.static.activation
    matrices = (u, cell.A, cell.Bu, cell.Bw, cell.Cz, cell.Dzu, *weights)
    met_within = MET_ROUNDING * torch.finfo(u.dtype).eps
    arguments = [*map(to_numpy, matrices), _ACTIVATION_CODES[activation], met_within, x.numpy()]
    spread(_run, len(u), *arguments)
    return x


_ACTIVATION_CODES = {"tanh": 0, "sigmoid": 1, "relu": 2, "rbf": 3}


@njit(cache=True, nogil=True, error_model="numpy")
def _run(r, u, A, Bu, Bw, Cz, Dzu, Wz, bz, Ww, bw, activation, met_within, x):
    _, T, nu = u.shape
    nx, (nn, nz), nw = A.shape[0], Wz.shape, bw.shape[0]
    z, w, h = np.empty(nz, u.dtype), np.empty(nw, u.dtype), np.empty(nn, u.dtype)
    for k in range(T):
        for i in range(nz):
            a = u.dtype.type(0)
            for j in range(nx):
                a += Cz[i, j] * x[r, k, j]
            for j in range(nu):
                a += Dzu[i, j] * u[r, k, j]
            z[i] = a
        for n in range(nn):
            a = bz[n]
            for j in range(nz):
                a += Wz[n, j] * z[j]
            if activation == 0:
                h[n] = math.tanh(a)
            elif activation == 1:
                h[n] = 1.0 / (1.0 + math.exp(-a))
            elif activation == 2:
                h[n] = max(a, 0.0)
            else:
                h[n] = math.exp(-a * a)
        for i in range(nw):
            a = bw[i]
            for n in range(nn):
                a += Ww[i, n] * h[n]
            w[i] = a
        met = True
        for i in range(nx):
            a = u.dtype.type(0)
            for j in range(nx):
                a += A[i, j] * x[r, k, j]
            for j in range(nu):
                a += Bu[i, j] * u[r, k, j]
            for j in range(nw):
                a += Bw[i, j] * w[j]
            # What stood there is the other trajectory, or NaN, which nothing meets.
            met = met and abs(a - x[r, k + 1, i]) <= met_within * (1.0 + abs(a))
            x[r, k + 1, i] = a
        if met:
            return
