"""Trajectories of the cell over time: from a given state, and the periodic steady state."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lfrtorch._support.threads import has_kernels, spread, to_numpy, workers
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.feedback_recurrence import monodromy
from lfrtorch.engine.known_kernel import simulate_known_records
from lfrtorch.engine.linearised import spectral_radius
from lfrtorch.engine.newton import newton_states
from lfrtorch.engine.nonlinearity import (
    Beyond,
    Kernel,
    Network,
    Polynomial,
    base_of,
    known,
    known_parts,
)
from lfrtorch.engine.simulation_kernel import simulate_record

PERIODIC_TOLERANCE = 1e-10
"""Largest |x(T) - x(0)| relative to 1 + max |x| that counts as periodic (states have unit rms)."""

_PERIODIC_ROUNDING = 100.0
"""The same in rounding errors, which decides in float32."""

_MET_ROUNDING = 4.0
"""Two trajectories have met if their states differ by at most this many rounding errors."""

_SETTLING_PERIODS = 3
"""Periods simulated forward before Newton's method takes over; a well damped model needs one."""

_CLOSER = 1e-2
"""The monodromy is kept if it foretells a change to this part; for Newton's method the change has
to be below this part of the states, too."""

_MAX_PERIODS = 30
"""Most passes over the record in search of the periodic steady state."""

_EXPLODED = 10.0
"""An unstable trajectory is lost if its states exceed those of the first pass by this factor."""


class Trajectory(NamedTuple):
    """Signals of a simulation, in normalised units."""

    x: Float[Tensor, "R T+1 nx"]
    z: Float[Tensor, "R T nz"]
    w: Float[Tensor, "R T nw"]
    y: Float[Tensor, "R T ny"]

    @property
    def finite(self) -> bool:
        """Whether nothing diverged."""
        return bool(torch.isfinite(self.y).all() and torch.isfinite(self.x[:, -1]).all())


@torch.no_grad()
def simulate(
    cell: LFRCell,
    u: Float[Tensor, "R T nu"],
    x0: Float[Tensor, "R nx"],
    *,
    guess: Float[Tensor, "R _ nx"] | None = None,
) -> Trajectory:
    """Trajectory from the state ``x0``. A model that diverges gives infinite or NaN samples.

    On the CPU a linear model, a ``Network`` and a ``Polynomial`` run in machine code. Any other map
    or device goes through Newton's method over all of time, from the states ``guess`` of a nearby
    trajectory; records for which that fails are simulated step by step.
    """
    if is_compiled(cell, u):
        return _compiled(cell, u, x0, None)
    x = newton_states(cell, u, x0, guess=guess)
    lost = ~torch.isfinite(x).all(dim=(1, 2))
    if lost.any():
        x = torch.where(lost[:, None, None], _loop(cell, u, x0), x)
    return signals(cell, u, x)


def simulate_near(
    cell: LFRCell, u: Float[Tensor, "R T nu"], x0: Float[Tensor, "R nx"], near: Trajectory
) -> Trajectory:
    """``simulate``, given the trajectory from another initial state, up to where both meet."""
    if is_compiled(cell, u):
        return _compiled(cell, u, x0, Trajectory(*(signal.clone() for signal in near)))
    return simulate(cell, u, x0, guess=near.x)


def signals(cell: LFRCell, u: Float[Tensor, "R T nu"], x: Float[Tensor, "R T+1 nx"]) -> Trajectory:
    """Trajectory with the given states."""
    z, w = cell.internal(u, x[:, :-1])
    return Trajectory(x, z, w, x[:, :-1] @ cell.Cy.mT + u @ cell.Dyu.mT + w @ cell.Dyw.mT)


@torch.no_grad()
def steady_state(
    cell: LFRCell,
    u: Float[Tensor, "R T nu"],
    guess: Float[Tensor, "R nx"] | Float[Tensor, "R _ nx"] | None = None,
) -> Trajectory:
    """Trajectory with x(T) = x(0): the response to the periodic repetition of ``u``.

    In machine code the record is simulated again and again, each time from its end state, until the
    end state is the initial state. After a few passes Newton's method on x(T) - x(0) takes over.
    Other cells try Newton's method over all of time first. While the trajectory is unstable, as it
    is near a rest that it leaves, the passes go on. A periodic solution that is not stable counts
    as diverged (its record has NaN samples), unless the search begins right on it: no simulation
    would settle to it. So does a record that has not settled after ``_MAX_PERIODS`` passes.

    Args:
        cell: the model.
        u: input, one or more whole periods.
        guess: initial state of the search, or the states of a nearby solution. Default: zero.
    """
    x0 = u.new_zeros(len(u), cell.nx) if guess is None else guess
    x0, states = (x0[:, 0], x0) if x0.ndim == 3 else (x0, None)
    compiled = is_compiled(cell, u)
    if not compiled:
        x = newton_states(cell, u, x0, guess=states, periodic=True)
        if torch.isfinite(x).all():
            return signals(cell, u, x)
    # `settled` and `lost` tell for each record whether it is periodic, or will never be.
    identity = torch.eye(cell.nx, dtype=u.dtype, device=u.device)
    eps = torch.finfo(u.dtype).eps
    tolerance = max(PERIODIC_TOLERANCE, _PERIODIC_ROUNDING * eps)
    trajectory = simulate(cell, u, x0)
    lost = torch.zeros(len(u), dtype=torch.bool, device=u.device)  # diverged, or unstable
    settled, size = lost, u.new_ones(len(u))
    transition, unstable, last = None, lost.clone(), u.new_full((len(u),), torch.inf)
    foretold = torch.zeros_like(x0)
    for passes in range(_MAX_PERIODS + 1):
        end = trajectory.x[:, -1].clone()
        if passes == 0:
            size = 1.0 + trajectory.x.abs().amax(dim=(1, 2))  # of states that hardly change
        lost |= ~torch.isfinite(end).all(dim=1)
        change = (end - x0).abs().amax(dim=1)
        settled = change <= tolerance * size
        lost |= settled & unstable  # no simulation would stay there
        if (settled | lost).all() or passes == _MAX_PERIODS:
            break
        if passes < _SETTLING_PERIODS:
            closer = end
        else:
            # Where it foretold the change to two digits, it is kept.
            miss = (end - x0 - foretold).abs().amax(dim=1)
            near = (miss <= _CLOSER * last) & (unstable | (last <= _CLOSER * size))
            if transition is None or not near[~settled & ~lost].all():
                transition = monodromy(cell, trajectory.z)
                radius = spectral_radius(transition)
                unstable = ~settled & ~(radius < 1.0)  # comparisons with NaN are False
                # A linear model stays unstable, and a large radius makes states of rounding errors.
                lost |= unstable & ((cell.static is None) | ~(radius < 1.0 / eps))
            lost |= unstable & (end.abs().amax(dim=1) > _EXPLODED * size)
            last = change
            # x(T) = end + Φ d for the initial state x0 + d, and x(T) = x0 + d is wanted.
            gap = (end - x0).unsqueeze(-1)
            newton = x0 + torch.linalg.solve_ex(identity - transition, gap).result.squeeze(-1)
            closer = torch.where(unstable.unsqueeze(1), end, newton)
            foretold = (transition @ gap).squeeze(-1) * unstable.unsqueeze(1)  # 0 by Newton
        x0 = torch.where((settled | lost).unsqueeze(1), x0, closer)
        if compiled:
            trajectory = _compiled(cell, u, x0, trajectory)
        else:
            trajectory = simulate(cell, u, x0, guess=trajectory.x)
    failed = (lost | ~settled)[:, None, None]
    if not failed.any():
        return trajectory
    return Trajectory(*(torch.where(failed, torch.nan, signal) for signal in trajectory))


def is_compiled(cell: LFRCell, u: Tensor) -> bool:
    """Whether machine code simulates the cell on the device of ``u``."""
    static = base_of(cell.static)
    in_code = static is None or known(static) is not None
    in_code |= known_parts(static) is not None and static is cell.static
    return in_code and has_kernels(u)


@torch.no_grad()
def folded(cell: LFRCell) -> LFRCell:
    """The cell with f itself in the place of its ``Beyond``; any other cell as it is.

    L, Z and W go into the linear block. x, u and y stay; z and w are those of f.
    """
    beyond = cell.static
    if not isinstance(beyond, Beyond):
        return cell
    sizes = cell.nu, cell.ny, cell.nx, cell.nz, cell.nw
    found = LFRCell(*sizes, beyond.base, device=cell.A.device, dtype=cell.A.dtype, random=False)
    L, Z, W = beyond.slope, beyond.into, beyond.out
    Cz, Dzu, Bw, Dyw = Z @ cell.Cz, Z @ cell.Dzu, cell.Bw @ W, cell.Dyw @ W
    found.state_covariance.copy_(cell.state_covariance)
    found.A.copy_(cell.A - Bw @ L @ Cz)
    found.Bu.copy_(cell.Bu - Bw @ L @ Dzu)
    found.Bw.copy_(Bw)
    found.Cz.copy_(Cz)
    found.Dzu.copy_(Dzu)
    found.Cy.copy_(cell.Cy - Dyw @ L @ Cz)
    found.Dyu.copy_(cell.Dyu - Dyw @ L @ Dzu)
    found.Dyw.copy_(Dyw)
    return folded(found)


def _loop(
    cell: LFRCell, u: Float[Tensor, "R T nu"], x0: Float[Tensor, "R nx"]
) -> Float[Tensor, "R T+1 nx"]:
    """States, simulated step by step: any static map, any device."""
    states = [x0.unsqueeze(1)]
    for u_k in u.split(1, dim=1):
        states.append(cell(u_k, states[-1])[1])
    return torch.cat(states, dim=1)


def _compiled(
    cell: LFRCell,
    u: Float[Tensor, "R T nu"],
    x0: Float[Tensor, "R nx"],
    near: Trajectory | None,
) -> Trajectory:
    """Trajectory in machine code of a cell that ``is_compiled``.

    ``near`` is the trajectory of the same model and input from another initial state; it is
    overwritten. Once the two have met, the rest of it is taken over.
    """
    R, T = u.shape[:2]
    if near is None:
        sizes = ((T + 1, cell.nx), (T, cell.nz), (T, cell.nw), (T, cell.ny))
        near = Trajectory(*(u.new_full((R, *size), torch.nan) for size in sizes))
    near.x[:, 0] = x0
    met_within = _MET_ROUNDING * torch.finfo(u.dtype).eps
    simulated = folded(cell)
    out = [signal.numpy() for signal in near]
    if (parts := known_parts(cell.static)) is not None:
        model, learned = parts
        # The code of equations is that of float64, for float32 as well.
        given = [to_numpy(u), *kernel_arguments(cell, learned)]
        given = [a.astype(float) if getattr(a, "dtype", None) == np.float32 else a for a in given]
        doubles, parts = [np.asarray(signal, np.float64) for signal in out], min(R, workers())
        weights = [*given, *model.arguments(), *model.kernel()]
        spread(simulate_known_records, parts, parts, *weights, met_within, *doubles)
        for signal, found in zip(near, doubles, strict=True):
            signal.copy_(torch.from_numpy(found))  # silent beyond the range of float32
        return near
    spread(simulate_record, R, to_numpy(u), *kernel_arguments(simulated), met_within, *out)
    return near if simulated is cell else signals(cell, u, near.x)


def kernel_arguments(cell: LFRCell, learned: Network | Polynomial | None = None) -> list[Any]:
    """The weights of a cell as ``simulate_record`` takes them, between u and the tolerance."""
    # ``learned`` stands for the static map if that is a known model and this beside it.
    static, zeros = known(cell.static) or learned, cell.A.new_zeros
    nothing = Kernel(zeros(0, 0), zeros(0, 0), zeros(0), zeros(cell.nw))
    *own, code, growth = nothing if static is None else static.kernel
    lti = (cell.A, cell.Bu, cell.Bw, cell.Cz, cell.Dzu, cell.Cy, cell.Dyu, cell.Dyw)
    return [*map(to_numpy, (*lti, *own)), code, growth]
