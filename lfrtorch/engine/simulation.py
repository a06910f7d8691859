"""Trajectories of the cell over time: from a given state, and the periodic steady state."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lfrtorch._support.threads import spread_loop, to_float64
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.feedback_recurrence import monodromy
from lfrtorch.engine.linearised import spectral_radius
from lfrtorch.engine.newton import newton_states
from lfrtorch.engine.simulation_kernel import simulate_records
from lfrtorch.engine.weights import Weights

Numbers = LFRCell | Weights
"""A model to simulate: a cell, or the vector of its numbers."""

PERIODIC_TOLERANCE = 1e-10
"""Largest |x(T) - x(0)| that counts as periodic, relative to 1 + max |x| (states have unit rms)."""

_PERIODIC_ROUNDING = 100.0
"""The same limit in rounding errors; it is the larger one in float32."""

_MET_ROUNDING = 4.0
"""Distance, in rounding errors, at which the states of two trajectories count as equal."""

_SETTLING_PERIODS = 3
"""Number of periods simulated before Newton's method begins; a well damped model needs one."""

_CLOSER = 1e-2
"""Relative accuracy of a predicted change up to which the monodromy is kept. Newton's method also
begins once the relative change of the states is below this number."""

_MAX_PERIODS = 30
"""Largest number of passes over the record in search of the periodic steady state."""

_EXPLODED = 10.0
"""Growth of the states since the first pass at which an unstable trajectory counts as diverged."""


class Trajectory(NamedTuple):
    """Signals of a simulation, in normalised units."""

    x: Float[Tensor, "R T+1 nx"]
    z: Float[Tensor, "R T nz"]
    w: Float[Tensor, "R T nw"]
    y: Float[Tensor, "R T ny"]

    @property
    def finite(self) -> bool:
        """True if no signal diverged."""
        return bool(torch.isfinite(self.y).all() and torch.isfinite(self.x[:, -1]).all())


def simulate(
    model: Numbers,
    u: Float[Tensor, "R T nu"],
    x0: Float[Tensor, "R nx"] | None,
    *,
    guess: Float[Tensor, "R _ nx"] | None = None,
) -> Trajectory:
    """Trajectory from the state ``x0``, by default 0; infinite or NaN samples if it diverges.

    On the CPU all maps except modules of the user run in machine code. User modules and other
    devices use Newton's method over the whole trajectory; ``guess`` has the states of a nearby
    trajectory. Records for which Newton's method fails are simulated step by step.
    """
    W = model.weights()
    if W.layout.compiled:
        return _compiled(W, u, x0, None)
    x0 = u.new_zeros(len(u), W.nx) if x0 is None else x0
    with torch.no_grad():
        x = newton_states(W, u, x0, guess=guess)
        lost = ~torch.isfinite(x).all(dim=(1, 2))
        if lost.any():
            x = torch.where(lost[:, None, None], _loop(W, u, x0), x)
        return signals(W, u, x)


def simulate_near(
    model: Numbers, u: Float[Tensor, "R T nu"], x0: Float[Tensor, "R nx"], near: Trajectory
) -> Trajectory:
    """Simulate until the states meet those of ``near``, from another start, and copy its rest."""
    W = model.weights()
    if W.layout.compiled:
        return _compiled(
            W, u, x0, Trajectory(*(s.clone(memory_format=torch.contiguous_format) for s in near))
        )
    return simulate(W, u, x0, guess=near.x)


def signals(model: Numbers, u: Float[Tensor, "R T nu"], x: Float[Tensor, "R T+1 nx"]) -> Trajectory:
    """Trajectory with the given states."""
    W = model.weights()
    z, w = W.internal(u, x[:, :-1])
    return Trajectory(x, z, w, x[:, :-1] @ W.Cy.mT + u @ W.Dyu.mT + w @ W.Dyw.mT)


@torch.no_grad()
def steady_state(
    model: Numbers,
    u: Float[Tensor, "R T nu"],
    guess: Float[Tensor, "R nx"] | Float[Tensor, "R _ nx"] | None = None,
) -> Trajectory:
    """Trajectory with x(T) = x(0): the response to the periodic repetition of ``u``.

    In machine code the record is simulated repeatedly, each time from its end state, until end
    state and initial state agree. After a few passes Newton's method on x(T) - x(0) takes over.
    Other cells try Newton's method over the whole trajectory first. The passes go on while the
    trajectory is unstable, for example near an unstable equilibrium. No simulation settles to an
    unstable periodic solution. So it counts as diverged, with NaN samples, unless the search begins
    on it. A record that has not settled after ``_MAX_PERIODS`` passes also counts as diverged.

    Args:
        model: the model to simulate.
        u: input, one or more whole periods.
        guess: initial state of the search, or the states of a nearby solution. Default: zero.
    """
    W = model.weights()
    x0 = u.new_zeros(len(u), W.nx) if guess is None else guess
    x0, states = (x0[:, 0], x0) if x0.ndim == 3 else (x0, None)
    compiled = W.layout.compiled
    if not compiled:
        x = newton_states(W, u, x0, guess=states, periodic=True)
        if torch.isfinite(x).all():
            return signals(W, u, x)
    # `settled` marks records that are periodic, and `lost` those that will never be.
    identity = torch.eye(W.nx, dtype=u.dtype, device=u.device)
    eps = torch.finfo(u.dtype).eps
    tolerance = max(PERIODIC_TOLERANCE, _PERIODIC_ROUNDING * eps)
    trajectory = simulate(W, u, x0)
    lost = torch.zeros(len(u), dtype=torch.bool, device=u.device)  # diverged, or unstable
    settled, size = lost, u.new_ones(len(u))
    transition, unstable, last = None, lost.clone(), u.new_full((len(u),), torch.inf)
    foretold = torch.zeros_like(x0)
    for passes in range(_MAX_PERIODS + 1):
        end = trajectory.x[:, -1].clone()
        if passes == 0:
            size = 1.0 + trajectory.x.abs().amax(dim=(1, 2))  # the states hardly change
        lost |= ~torch.isfinite(end).all(dim=1)
        change = (end - x0).abs().amax(dim=1)
        settled = change <= tolerance * size
        lost |= settled & unstable  # no simulation would stay there
        if (settled | lost).all() or passes == _MAX_PERIODS:
            break
        if passes < _SETTLING_PERIODS:
            closer = end
        else:
            # The monodromy is kept for records whose change it predicted to two digits.
            miss = (end - x0 - foretold).abs().amax(dim=1)
            near = (miss <= _CLOSER * last) & (unstable | (last <= _CLOSER * size))
            if transition is None or not near[~settled & ~lost].all():
                transition = monodromy(W, trajectory.z)
                radius = spectral_radius(transition)
                unstable = ~settled & ~(radius < 1.0)  # comparisons with NaN are False
                # A linear model stays unstable, and a large radius amplifies rounding errors.
                lost |= unstable & ((W.nw == 0) | ~(radius < 1.0 / eps))
            lost |= unstable & (end.abs().amax(dim=1) > _EXPLODED * size)
            last = change
            # From the initial state x0 + d, x(T) = end + Φ d to first order; it shall be x0 + d.
            gap = (end - x0).unsqueeze(-1)
            newton = x0 + torch.linalg.solve_ex(identity - transition, gap).result.squeeze(-1)
            closer = torch.where(unstable.unsqueeze(1), end, newton)
            foretold = (transition @ gap).squeeze(-1) * unstable.unsqueeze(1)  # 0 by Newton
        x0 = torch.where((settled | lost).unsqueeze(1), x0, closer)
        if compiled:
            trajectory = _compiled(W, u, x0, trajectory)
        else:
            trajectory = simulate(W, u, x0, guess=trajectory.x)
    failed = (lost | ~settled)[:, None, None]
    if not failed.any():
        return trajectory
    return Trajectory(*(torch.where(failed, torch.nan, signal) for signal in trajectory))


def _loop(
    W: Weights, u: Float[Tensor, "R T nu"], x0: Float[Tensor, "R nx"]
) -> Float[Tensor, "R T+1 nx"]:
    """States, simulated step by step: any static map, any device."""
    states = [x0.unsqueeze(1)]
    for u_k in u.split(1, dim=1):
        states.append(W.step(u_k, states[-1]))
    return torch.cat(states, dim=1)


def _compiled(
    W: Weights,
    u: Float[Tensor, "R T nu"],
    x0: Float[Tensor, "R nx"] | None,
    near: Trajectory | None,
) -> Trajectory:
    """Trajectory in machine code.

    ``near`` is the trajectory of the same model and input from another initial state; it may be
    overwritten. Its rest is used from the sample at which both have met.
    """
    R, T = u.shape[:2]
    if near is None:
        sizes = ((T + 1, W.nx), (T, W.nz), (T, W.nw), (T, W.ny))
        out = [np.empty((R, *size)) for size in sizes]
        met_within = -1.0  # nothing is met
    else:
        out = [to_float64(signal) for signal in near]
        met_within = _MET_ROUNDING * torch.finfo(u.dtype).eps
    out[0][:, 0] = 0.0 if x0 is None else to_float64(x0)
    spread_loop(simulate_records, R, *W.arguments, to_float64(u), met_within, *out)
    found = map(torch.from_numpy, out)
    if u.dtype == torch.float64:
        return Trajectory(*found)
    return Trajectory(*(signal.to(u.dtype) for signal in found))  # silent beyond float32
