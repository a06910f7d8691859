"""Gauge directions: changes of the parameters that leave the simulated output as it is.

The coordinates of x, and those of z and w where the static map is a network that can absorb them,
are free. A Jacobian therefore has columns that are combinations of others; they need not be
computed: with the columns ``kept``, J = J[:, kept] @ expand, exactly.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.linalg
import torch
from numpy.typing import NDArray
from torch import Tensor

from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.nonlinearity import is_network

DEPENDENT = 1e-3
"""Smallest pivot, relative to the largest, of a column that is left out; the rest is computed."""


class Reduction(NamedTuple):
    """Columns of a Jacobian that are computed and what the whole one is made of.

    Shape:
        kept: (K,), expand: (K, P).
    """

    kept: Tensor
    expand: Tensor

    def columns(self, own: Tensor) -> Tensor:
        """All columns (M, P) from the kept ones (M, K): own @ expand, most of which is identity."""
        whole = own.new_empty(len(own), self.expand.shape[1])
        whole[:, self.kept] = own
        left_out = torch.ones(whole.shape[1], dtype=torch.bool, device=own.device)
        left_out[self.kept] = False
        whole[:, left_out] = own @ self.expand[:, left_out]
        return whole


ROUNDING = 1e-10
"""The same relative to all gauge directions: below it none is left but rounding errors."""


@torch.no_grad()
def reduction(
    cell: LFRCell,
    start: Tensor,
    *,
    coordinates: bool = True,
    before: Reduction | None = None,
    fixed: Tensor | None = None,
) -> Reduction:
    """Which columns of the Jacobian of the free parameters to compute.

    Args:
        cell: the model.
        start: start states (S, nx) that are parameters, too; their columns come last and are kept.
        coordinates: whether those of x are free: no start state is given in them.
        before: of the same cell with weights close by: its columns are taken where they still do.
        fixed: which entries of the free parameters stay as they are, too: columns of zeros.

    Shape:
        fixed: as many as the cell has free parameters.
    """
    G = _directions(cell, start)[:, 0 if coordinates else cell.nx**2 :].double().cpu().numpy()
    parameters = list(cell.named_parameters())
    counts = [p.numel() for _, p in parameters] + [start.numel()]
    mask = np.repeat([p.requires_grad for _, p in parameters] + [True], counts)
    linear = np.repeat([not n.startswith("static.") for n, _ in parameters] + [False], counts)
    theta = np.cumsum(mask) - 1  # where each free entry stands in θ
    P = int(mask.sum())
    if fixed is not None:
        mask[np.flatnonzero(mask)[: len(fixed)]] = ~fixed.cpu().numpy()
    size = np.linalg.norm(G)
    places = torch.as_tensor(theta[mask]).to(cell.A.device)
    if not np.isfinite(size):
        return _placed(everything(cell.A.new_zeros(len(places))), places, P)
    if not mask.all():
        # Directions that move no fixed parameter.
        G = G[mask] @ scipy.linalg.null_space(G[~mask]) if G.shape[1] else G[mask]
    elif before is not None and len(before.kept) + G.shape[1] == len(G):
        left_out = np.setdiff1d(np.arange(len(G)), before.kept.cpu().numpy(), assume_unique=True)
        found = _expanded(G, left_out, cell.A)
        if found is not None:
            return found
    # Columns of the linear part only: those of the static map are computed together.
    lti = int((mask & linear).sum())
    Q, R, pivots = scipy.linalg.qr(G[:lti].T, mode="economic", pivoting=True)
    diagonal = np.abs(np.diag(R))
    least = max(DEPENDENT * diagonal.max(initial=0.0), ROUNDING * size)
    rank = int((diagonal > least).sum())
    found = _expanded(G @ Q[:, :rank], pivots[:rank], cell.A)
    if found is None:
        found = everything(cell.A.new_zeros(len(G)))
    return _placed(found, places, P)


def _placed(found: Reduction, places: Tensor, P: int) -> Reduction:
    """A reduction of the columns at some places (n,) as one of all P; the others are zeros."""
    if len(places) == P:
        return found
    expand = found.expand.new_zeros(len(found.kept), P)
    expand[:, places] = found.expand
    return Reduction(places[found.kept], expand)


def _expanded(G: NDArray, left_out: NDArray, like: Tensor) -> Reduction | None:
    """The reduction without those columns; None where it would blow up rounding errors."""
    kept = np.delete(np.arange(len(G)), left_out)
    expand = np.zeros((len(kept), len(G)))
    expand[np.arange(len(kept)), kept] = 1.0
    # J G = 0, so that J[:, left_out] = -J[:, kept] G[kept] G[left_out]⁻¹.
    try:
        expand[:, left_out] = -np.linalg.solve(G[left_out].T, G[kept].T).T
    except np.linalg.LinAlgError:
        return None
    if not np.abs(expand).max(initial=0.0) < 1.0 / DEPENDENT:
        return None
    return Reduction(torch.as_tensor(kept).to(like.device), torch.as_tensor(expand).to(like))


def everything(theta: Tensor) -> Reduction:
    """All columns of the Jacobian by θ (P,)."""
    kept = torch.arange(len(theta), device=theta.device)
    return Reduction(kept, torch.eye(len(theta)).to(theta))


def _directions(cell: LFRCell, start: Tensor) -> Tensor:
    """Gauge directions (all parameters and start states, number of directions)."""
    A, Bu, Bw, Cz, Dzu = cell.A, cell.Bu, cell.Bw, cell.Cz, cell.Dzu
    T = _units(cell.nx, A)  # x -> (I + εT) x
    changes = {"A": T @ A - A @ T, "Bu": T @ Bu, "Bw": T @ Bw, "Cz": -Cz @ T, "Cy": -cell.Cy @ T}
    groups: list[tuple[dict[str, Tensor], Tensor | None]] = [(changes, start @ T.mT)]
    if is_network(cell.static):
        Wz, Ww, bw = cell.static.Wz, cell.static.Ww, cell.static.bw
        T = _units(cell.nz, A)
        groups.append(({"Cz": T @ Cz, "Dzu": T @ Dzu, "static.Wz": -Wz @ T}, None))
        T = _units(cell.nw, A)
        changes = {"Bw": -Bw @ T, "Dyw": -cell.Dyw @ T, "static.Ww": T @ Ww, "static.bw": T @ bw}
        groups.append((changes, None))
    columns = []
    for changes, states in groups:
        count = len(next(iter(changes.values())))
        parts = [
            changes[name].flatten(1) if name in changes else A.new_zeros(count, p.numel())
            for name, p in cell.named_parameters()
        ]
        parts.append(A.new_zeros(count, start.numel()) if states is None else states.flatten(1))
        columns.append(torch.cat(parts, dim=1))
    return torch.cat(columns).mT


def _units(n: int, like: Tensor) -> Tensor:
    """The n² matrices (n, n) with one entry 1."""
    return torch.eye(n * n, dtype=like.dtype, device=like.device).reshape(n * n, n, n)
