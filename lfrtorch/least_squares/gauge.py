"""Gauge directions: changes of the parameters that leave the simulated output as it is.

Many sets of matrices describe the same model. A change of coordinates x -> T x changes A, Bu, Bw,
Cz and Cy, and no output. The same holds for z and w if the static map is a network, whose weights
absorb the change. To first order these changes are directions G in θ with J G = 0: some columns of
J are combinations of others. Those columns need not be computed. With the columns ``kept``,
J = J[:, kept] @ expand, exactly.

Which columns are left out is a choice. J[:, left_out] = -J[:, kept] G[kept] G[left_out]⁻¹, so the
rows G[left_out] must be well conditioned: a QR decomposition with pivoting picks them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lfrtorch._support.threads import to_float64
from lfrtorch._support.types import Array, Integers
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.nonlinearity import networks_of

DEPENDENT = 1e-3
"""A column is left out if its pivot is at least this fraction of the largest pivot."""

DIRECT, RELUCTANT = ("Cy", "Dyu", "Dyw"), 0.1
"""Columns of the output equation need no recurrence, so they are left out only if another pivot is
ten times smaller."""


class Reduction(NamedTuple):
    """The columns of a Jacobian that are computed, and how all columns follow from them."""

    kept: Int[Tensor, " K"]
    expand: Float[Tensor, "K P"]

    def columns(self, own: Float[Tensor, "M K"]) -> Float[Tensor, "M P"]:
        """All columns from the kept ones: own @ expand, most of which is the identity."""
        whole = own.new_empty(len(own), self.expand.shape[1])
        whole[:, self.kept] = own
        left_out = torch.ones(whole.shape[1], dtype=torch.bool, device=own.device)
        left_out[self.kept] = False
        whole[:, left_out] = own @ self.expand[:, left_out]
        return whole


ROUNDING = 1e-10
"""A pivot below this fraction of the norm of G is a rounding error."""


@torch.no_grad()
def reduction(
    cell: LFRCell,
    initial_states: Float[Tensor, "S nx"],
    *,
    coordinates: bool = True,
    before: Reduction | None = None,
    fixed: Bool[Tensor, " free"] | None = None,
) -> Reduction:
    """Which columns of the Jacobian of the free parameters to compute."""
    # Those of ``initial_states`` come last and are kept. ``coordinates``: no initial state is given
    # in those of x. ``before``: the reduction at weights close by, whose columns are kept if they
    # still do. ``fixed`` entries of the free parameters have columns of zeros.
    G = to_float64(_directions(cell, initial_states))[:, 0 if coordinates else cell.nx**2 :]
    parameters = list(cell.named_parameters())
    counts = [p.numel() for _, p in parameters] + [initial_states.numel()]
    mask = np.repeat([p.requires_grad for _, p in parameters] + [True], counts)
    linear = np.repeat([not n.startswith("static.") for n, _ in parameters] + [False], counts)
    theta = np.cumsum(mask) - 1  # position of each free entry in θ
    P = int(mask.sum())
    if fixed is not None:
        mask[np.flatnonzero(mask)[: len(fixed)]] = ~fixed.cpu().numpy()
    size = np.linalg.norm(G)
    places = torch.as_tensor(theta[mask]).to(cell.A.device)
    if not np.isfinite(size):
        return _placed(everything(cell.A.new_zeros(len(places))), places, P)
    if not mask.all():
        # Directions that move no fixed parameter: combinations N of G with G[fixed] N = 0.
        G = G[mask] @ scipy.linalg.null_space(G[~mask]) if G.shape[1] else G[mask]
    elif before is not None and len(before.kept) + G.shape[1] == len(G):
        left_out = np.setdiff1d(np.arange(len(G)), before.kept.cpu().numpy(), assume_unique=True)
        found = _expanded(G, left_out, cell.A)
        if found is not None:
            return found
    # Only columns of the linear part are left out: those of the static map are computed together.
    lti = int((mask & linear).sum())
    direct = np.repeat([n in DIRECT for n, _ in parameters] + [False], counts)[mask][:lti]
    pick = np.where(direct, RELUCTANT, 1.0)[:, None] * G[:lti]
    Q, R, pivots = scipy.linalg.qr(pick.T, mode="economic", pivoting=True)
    diagonal = np.abs(np.diag(R))
    least = max(DEPENDENT * diagonal.max(initial=0.0), ROUNDING * size)
    rank = int((diagonal > least).sum())
    found = _expanded(G @ Q[:, :rank], pivots[:rank], cell.A)
    if found is None:
        found = everything(cell.A.new_zeros(len(G)))
    return _placed(found, places, P)


def _placed(found: Reduction, places: Int[Tensor, " n"], P: int) -> Reduction:
    """A reduction of the columns at some places as one of all P; the others are zeros."""
    if len(places) == P:
        return found
    expand = found.expand.new_zeros(len(found.kept), P)
    expand[:, places] = found.expand
    return Reduction(places[found.kept], expand)


def _expanded(
    G: Float[Array, "P directions"], left_out: Int[Integers, " n"], like: Tensor
) -> Reduction | None:
    """The reduction without those columns; None if it would blow up rounding errors."""
    kept = np.delete(np.arange(len(G)), left_out)
    expand = np.zeros((len(kept), len(G)))
    expand[np.arange(len(kept)), kept] = 1.0
    try:
        expand[:, left_out] = -np.linalg.solve(G[left_out].T, G[kept].T).T
    except np.linalg.LinAlgError:
        return None
    if not np.abs(expand).max(initial=0.0) < 1.0 / DEPENDENT:
        return None
    return Reduction(torch.as_tensor(kept).to(like.device), torch.as_tensor(expand).to(like))


def everything(theta: Float[Tensor, " P"]) -> Reduction:
    """The reduction that keeps all columns."""
    kept = torch.arange(len(theta), device=theta.device)
    return Reduction(kept, torch.eye(len(theta)).to(theta))


def _directions(
    cell: LFRCell, initial_states: Float[Tensor, "S nx"]
) -> Float[Tensor, "parameters directions"]:
    """Gauge directions G: of all parameters, then the initial states."""
    A, Bu, Bw, Cz, Dzu = cell.A, cell.Bu, cell.Bw, cell.Cz, cell.Dzu
    # T is every matrix with one entry 1, stacked: a direction for each. x -> (I + εT) x changes
    # A to A + ε (TA - AT), and so on; z -> (I + εT) z and w -> (I + εT)⁻¹ w likewise.
    T = _units(cell.nx, A)
    changes = {"A": T @ A - A @ T, "Bu": T @ Bu, "Bw": T @ Bw, "Cz": -Cz @ T, "Cy": -cell.Cy @ T}
    groups: list[tuple[dict[str, Tensor], Tensor | None]] = [(changes, initial_states @ T.mT)]
    for prefix, network, first_z, first_w in networks_of(cell.static):
        Wz, Ww, bw = network.Wz, network.Ww, network.bw
        z, w = slice(first_z, first_z + Wz.shape[1]), slice(first_w, first_w + len(Ww))
        T = _units(Wz.shape[1], A)
        changes = {name: A.new_zeros(len(T), *p.shape) for name, p in (("Cz", Cz), ("Dzu", Dzu))}
        changes["Cz"][:, z], changes["Dzu"][:, z] = T @ Cz[z], T @ Dzu[z]
        groups.append((changes | {f"{prefix}Wz": -Wz @ T}, None))
        T, Dyw = _units(len(Ww), A), cell.Dyw
        changes = {name: A.new_zeros(len(T), *p.shape) for name, p in (("Bw", Bw), ("Dyw", Dyw))}
        changes["Bw"][..., w], changes["Dyw"][..., w] = -Bw[:, w] @ T, -Dyw[:, w] @ T
        groups.append((changes | {f"{prefix}Ww": T @ Ww, f"{prefix}bw": T @ bw}, None))
    columns = []
    for changes, states in groups:
        count = len(next(iter(changes.values())))
        parts = [
            changes[name].flatten(1) if name in changes else A.new_zeros(count, p.numel())
            for name, p in cell.named_parameters()
        ]
        parts.append(
            A.new_zeros(count, initial_states.numel()) if states is None else states.flatten(1)
        )
        columns.append(torch.cat(parts, dim=1))
    return torch.cat(columns).mT


def _units(n: int, like: Tensor) -> Float[Tensor, "{n}*{n} {n} {n}"]:
    """The n² matrices with one entry 1."""
    return torch.eye(n * n, dtype=like.dtype, device=like.device).reshape(n * n, n, n)
