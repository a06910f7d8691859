"""Newton's method over the whole trajectory: all states of a simulation at once.

x(k+1) = f(x(k), u(k)) at all k is one system of equations in all states. Its Newton step is the
model linearised along the latest trajectory: a linear recurrence, which is parallel in time::

    x_new(k+1) = F(k) (x_new(k) - x(k)) + f(x(k), u(k)),    F(k) = A + Bw J(k) Cz
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from lfrtorch._support.threads import fast_paths
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.linear_recurrence import linear_recurrence
from lfrtorch.engine.linearised import linearise, spectral_radius
from lfrtorch.engine.weights import Weights

MAX_NEWTON = 20
"""Iterations after which Newton's method counts as failed; near a solution it needs 3 or 4."""

_UPDATE_ROUNDING = 1.0
"""The states have converged after an update below this many √eps, relative to 1 + max |x|.

Convergence is quadratic, so the remaining error is about eps, as that of a loop over time.
"""


@torch.no_grad()
def newton_states(
    model: LFRCell | Weights,
    u: Float[Tensor, "R T nu"],
    x0: Float[Tensor, "R nx"],
    *,
    guess: Float[Tensor, "R T+1 nx"] | None = None,
    periodic: bool = False,
) -> Float[Tensor, "R T+1 nx"]:
    """States of x(k+1) = f(x(k), u(k)), equal to those of a loop over time up to rounding.

    The boundary is x(0) = x0, or x(T) = x(0) if ``periodic``. ``guess`` has the states of a nearby
    trajectory from any initial state; the default is x0 at all times. A record is NaN if the
    iteration does not converge or overflows (a model that diverges or is chaotic), or if the
    periodic solution is unstable, so that no simulation would settle to it.

    References:
        Lim, Zhu, Selfridge and Kasim, "Parallelizing non-linear sequential models over the sequence
        length", ICLR 2024.
    """
    W = model.weights()
    tolerance = _UPDATE_ROUNDING * torch.finfo(u.dtype).eps ** 0.5
    x = (
        x0.unsqueeze(1).expand(-1, u.shape[1] + 1, -1)
        if guess is None or not fast_paths()
        else guess
    )
    driven = u @ W.Bu.mT
    transition, found = W.A, torch.zeros(len(u), dtype=torch.bool)  # before the first iteration
    for _ in range(MAX_NEWTON):
        z, w = W.internal(u, x[:, :-1])
        defect = x[:, :-1] @ W.A.mT + driven + w @ W.Bw.mT - x[:, 1:]
        gap = (x[:, -1] if periodic else x0) - x[:, 0]
        # `defect` is f(x(k), u(k)) - x(k+1), and `gap` is the error of the boundary condition. Both
        # are 0 at the solution.
        update, transition = (_closed if periodic else _open)(linearise(W, z).F, defect, gap)
        x = x + update
        change, size = (signal.abs().amax(dim=(1, 2)) for signal in (update, x))
        found = change <= tolerance * (1.0 + size)  # False for NaN
        if (found | ~torch.isfinite(change)).all():
            break
    if periodic:
        found &= spectral_radius(transition) < 1.0  # False for NaN
    return torch.where(found[:, None, None], x, torch.nan)


def _open(
    F: Float[Tensor, "R T nx nx"], defect: Float[Tensor, "R T nx"], gap: Float[Tensor, "R nx"]
) -> tuple[Float[Tensor, "R T+1 nx"], Float[Tensor, "R nx"]]:
    """Solve d(k+1) = F(k) d(k) + defect(k) from d(0) = gap: all d, and the last d."""
    d = linear_recurrence(F, defect.unsqueeze(-1), gap.unsqueeze(-1)).squeeze(-1)
    return d, d[:, -1]


def _closed(
    F: Float[Tensor, "R T nx nx"], defect: Float[Tensor, "R T nx"], gap: Float[Tensor, "R nx"]
) -> tuple[Float[Tensor, "R T+1 nx"], Float[Tensor, "R nx nx"]]:
    """Solve that recurrence with d(0) = d(T) + gap: all d, and the transition Φ over the record.

    The solution is d(k) = Φ(k) d(0) + p(k). One recurrence has the columns [Φ(k) p(k)], and the
    boundary gives (I - Φ) d(0) = p(T) + gap.
    """
    R, _, nx = defect.shape
    identity = torch.eye(nx, dtype=F.dtype, device=F.device).expand(R, nx, nx)
    columns = torch.cat([torch.zeros_like(F), defect.unsqueeze(-1)], dim=-1)
    states = linear_recurrence(F, columns, pad(identity, (0, 1)))
    transition, p = states[:, -1].split([nx, 1], dim=-1)
    d0 = torch.linalg.solve_ex(identity - transition, p + gap.unsqueeze(-1)).result
    d = states.flatten(1, 2) @ pad(d0, (0, 0, 0, 1), value=1.0)  # [Φ(k) p(k)] [d0; 1]
    return d.unflatten(1, (-1, nx)).squeeze(-1), transition
