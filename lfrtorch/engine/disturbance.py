"""An NL-LFR whose additional states are constant disturbances of its inputs and outputs.

An unmeasured constant disturbance d, such as a load or a leak, adds Eu d to the inputs and Ey d to
the outputs. It is modelled as a constant state, so that an observer estimates it with x::

    [x+]   [A  Bu Eu] [x]
    [d+] = [0    1  ] [d] + ...,    z = Cz x + Dzu (u + Eu d),    y = ... + (Dyu Eu + Ey) d

References:
    Pannocchia and Rawlings, "Disturbance models for offset-free model-predictive control", AIChE
    Journal 49(2), 2003.
"""

from __future__ import annotations

import math
from copy import deepcopy

import numpy as np
import torch
from jaxtyping import Float

from lfrtorch._support.types import Array
from lfrtorch.data.records import Scaler
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.operating_point import StateSpace

_DRIFT = 0.1
"""Drift of a disturbance per slowest time constant, relative to its scale (rms)."""

_FASTEST, _SLOWEST = 1.0, 1e4  # limits of time constants in samples; integrators do not count


def disturbed_cell(cell: LFRCell, E: Float[Array, "n nd"], scaler: Scaler) -> LFRCell:
    """The cell with the states (x, d), d in physical units; E has a row for each u, then y."""
    nu, nd = cell.nu, E.shape[1]
    sizes = nu, cell.ny, cell.nx + nd, cell.nz, cell.nw
    with torch.no_grad():
        Eu, Ey = (
            torch.as_tensor(part / scale[:, None]).to(cell.A)
            for part, scale in ((E[:nu], scaler.u_scale), (E[nu:], scaler.y_scale))
        )
        found = LFRCell(
            *sizes, deepcopy(cell.static), device=cell.A.device, dtype=cell.A.dtype, random=False
        )
        found.A.copy_(torch.block_diag(cell.A, torch.eye(nd).to(cell.A)))
        found.A[: cell.nx, cell.nx :] = cell.Bu @ Eu
        for name in ("Bu", "Bw"):
            getattr(found, name)[: cell.nx] = getattr(cell, name)
        found.Cz.copy_(torch.cat([cell.Cz, cell.Dzu @ Eu], dim=1))
        found.Cy.copy_(torch.cat([cell.Cy, cell.Dyu @ Eu + Ey], dim=1))
        for name in ("Dzu", "Dyu", "Dyw"):
            getattr(found, name).copy_(getattr(cell, name))
        variance = torch.as_tensor(disturbance_scale(E, scaler) ** 2).to(cell.A)
        found.state_covariance.copy_(torch.block_diag(cell.state_covariance, variance.diag()))
    return found


def disturbance_scale(E: Float[Array, "n nd"], scaler: Scaler) -> Float[Array, " nd"]:
    """The size of each disturbance that moves its most affected channel by the channel's scale."""
    each = np.abs(E) / np.concatenate([scaler.u_scale, scaler.y_scale])[:, None]
    return 1.0 / each.max(axis=0)


def drift_variance(moduli: Array, scale: Float[Array, " nd"]) -> Float[Array, " nd"]:
    """Variance of the change of each disturbance in one sample.

    The rms change over the slowest time constant is a tenth of the disturbance's scale. ``moduli``
    are those of the poles, without integrators."""
    stable = moduli[moduli < math.exp(-1.0 / _SLOWEST)]
    slowest = -1.0 / math.log(max(stable.max(initial=0.0), math.exp(-1.0 / _FASTEST)))
    return (_DRIFT * scale) ** 2 / slowest


def tells_apart(system: StateSpace, states: int) -> bool:
    """Tell if the outputs at rest determine the disturbances, which are the last states."""
    # Pannocchia and Rawlings: [A - 1, Bd; C, Cd] has full column rank.
    rows = np.vstack([system.A[:states] - np.eye(states, len(system.A)), system.C])
    values = np.linalg.svd(rows / np.maximum(np.abs(rows).max(axis=0), 1e-300), compute_uv=False)
    return len(values) == rows.shape[1] and bool(values[-1] > 1e-9 * values[0])
