"""The model at rest under a constant input, and linearised at a point.

At rest x = f(x, u). Newton's method on the gap f(x, u) - x takes steps d with (I - F) d = gap, F =
∂f/∂x, halved until the gap shrinks.
"""

from __future__ import annotations

from copy import deepcopy
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from lfrtorch._support.threads import to_float64
from lfrtorch._support.types import Array
from lfrtorch.data.records import Scaler
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.linearised import fed_back, static_slope
from lfrtorch.engine.simulation import simulate

_MAX_NEWTON = 50
"""Largest number of steps of Newton's method."""

HALVINGS = 30
"""Largest number of halvings of a step of Newton's method."""

_TOLERANCE = 1e-10
"""Largest |f(x, u) - x| at rest, relative to 1 + max |x| (states have unit rms)."""

SINGULAR = 1e-12
"""Singular values of I - F below this part of the largest belong to integrators, which are at rest
in any state."""

_SETTLING = 1000
"""Number of simulated samples before a second try of Newton's method, if the first one fails."""


class StateSpace(NamedTuple):
    """Matrices of x+ = A x + B u, y = C x + D u."""

    A: Float[Array, "nx nx"]
    B: Float[Array, "nx nu"]
    C: Float[Array, "ny nx"]
    D: Float[Array, "ny nu"]

    def physical(self, scaler: Scaler) -> StateSpace:
        """The same system between signals in physical units; the states are unchanged."""
        u, y = scaler.u_scale, scaler.y_scale[:, None]
        return StateSpace(self.A, self.B / u, y * self.C, y * self.D / u)


def double(cell: LFRCell) -> LFRCell:
    """The cell on the CPU in float64."""
    if cell.A.dtype == torch.float64 and cell.A.device.type == "cpu":
        return cell
    return deepcopy(cell).to(device="cpu", dtype=torch.float64)


def linear_part(cell: LFRCell) -> StateSpace:
    """Linear part A, Bu, Cy, Dyu: the model without its static nonlinearity."""
    A, Bu, _, _, _, Cy, Dyu, _ = cell.matrices()
    return StateSpace(A, Bu, Cy, Dyu)


@torch.no_grad()
def linearised_at(cell: LFRCell, u: Float[Tensor, " nu"], x: Float[Tensor, " nx"]) -> StateSpace:
    """Derivatives of the next state and the output at an input and a state.

    They are A + Bw J Cz, Bu + Bw J Dzu, Cy + Dyw J Cz and Dyu + Dyw J Dzu, J = ∂w/∂z.
    """
    z, _ = cell.internal(u, x)
    J = to_float64(static_slope(cell, z[None, None])[0, 0])
    return StateSpace(*fed_back(cell.matrices(), J))


@torch.no_grad()
def equilibrium(cell: LFRCell, u: Float[Tensor, " nu"]) -> Float[Tensor, " nx"] | None:
    """Equilibrium state under a constant input; None if none is found.

    Newton's method begins at x = 0, and then at the end of a simulation from there. The equilibrium
    may be unstable, and one of several.
    """
    x = resting_near(cell, u, u.new_zeros(cell.nx))
    if x is None:
        constant = u.expand(1, _SETTLING, -1).contiguous()
        end = simulate(cell, constant, u.new_zeros(1, cell.nx)).x[0, -1]
        x = resting_near(cell, u, end) if torch.isfinite(end).all() else None
    return x


def resting_input(cell: LFRCell, u: Float[Tensor, " nu"]) -> Float[Tensor, " nu"] | None:
    """An input near u under which an integrating model is at rest, or None."""
    found = _rest(cell, u, u.new_zeros(cell.nx), inputs=cell.nu)
    return None if found is None else found[0]


def resting_near(
    cell: LFRCell, u: Float[Tensor, " nu"], x: Float[Tensor, " nx"]
) -> Float[Tensor, " nx"] | None:
    """State at rest that Newton's method finds from x, or None."""
    found = _rest(cell, u, x)
    return None if found is None else found[1]


@torch.no_grad()
def _rest(
    cell: LFRCell, u: Float[Tensor, " nu"], x: Float[Tensor, " nx"], *, inputs: int = 0
) -> tuple[Float[Tensor, " nu"], Float[Tensor, " nx"]] | None:
    """Input and state at rest, by Newton's method in the state and the first ``inputs`` inputs."""
    identity = torch.eye(cell.nx, dtype=u.dtype)
    gap = cell(u, x)[1] - x
    for _ in range(_MAX_NEWTON):
        if gap.abs().max() <= _TOLERANCE * (1.0 + x.abs().max()):
            return u, x
        A, B, _, _ = map(torch.as_tensor, linearised_at(cell, u, x))
        rows = torch.cat([identity - A, -B[:, :inputs]], dim=1)
        step = torch.linalg.pinv(rows, rtol=SINGULAR) @ gap
        for _ in range(HALVINGS):
            closer, beside = x + step[: cell.nx], u + step[cell.nx :] if inputs else u
            left = cell(beside, closer)[1] - closer
            if left.norm() < gap.norm():  # False for NaN
                break
            step = step / 2
        else:
            return None
        u, x, gap = beside, closer, left
    return None
