"""Columns of the Jacobian that gauge directions leave: the others follow from them.

Directions G in θ that change no output (``engine.gauge_directions``) have J G = 0: some columns of
J are combinations of others. Those columns need not be computed. The columns ``kept`` give
J = J[:, kept] @ expand, exactly.

The columns left out are a choice. J[:, left_out] = -J[:, kept] G[kept] G[left_out]⁻¹, so the
rows G[left_out] must be well conditioned: a QR decomposition with pivoting picks them.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import scipy
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lfrtorch._support.types import Array, Integers
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.gauge_directions import ROUNDING, gauge_directions
from lfrtorch.engine.weights import Weights

DEPENDENT = 1e-3
"""A column is left out if its pivot is at least this fraction of the largest pivot."""

RELUCTANT = 0.1
"""Columns of the output equation need no recurrence, so they are left out only if another pivot is
ten times smaller."""


class Reduction(NamedTuple):
    """The columns of a Jacobian that are computed, and how all columns follow from them."""

    kept: Int[Tensor, " K"]
    expand: Float[Tensor, "K P"] | None
    """None if all columns are kept."""

    def columns(self, own: Float[Tensor, "M K"]) -> Float[Tensor, "M P"]:
        """All columns from the kept ones: own @ expand, most of which is the identity."""
        if self.expand is None:
            return own
        whole = own.new_empty(len(own), self.expand.shape[1])
        whole[:, self.kept] = own
        left_out = torch.ones(whole.shape[1], dtype=torch.bool, device=own.device)
        left_out[self.kept] = False
        whole[:, left_out] = own @ self.expand[:, left_out]
        return whole

    def reduced(self, d_theta: Tensor) -> Tensor:
        """A change of the kept parameters alone that has the same outputs."""
        return d_theta if self.expand is None else self.expand @ d_theta

    def gradient(self, own: Float[Tensor, " K"]) -> Float[Tensor, " P"]:
        """A gradient from that in the kept columns."""
        return own if self.expand is None else self.expand.mT @ own


@torch.no_grad()
def reduction(
    model: LFRCell | Weights,
    initial_states: Float[Tensor, "S nx"],
    *,
    coordinates: bool = True,
    before: Reduction | None = None,
    fixed: Bool[Tensor, " free"] | None = None,
) -> Reduction:
    """Columns of the Jacobian of the free parameters to compute."""
    # Those of ``initial_states`` come last and are kept. ``coordinates``: no initial state is given
    # in those of x. ``before``: the reduction at weights close by, whose columns are kept if they
    # still do. ``fixed`` entries of the free parameters have columns of zeros.
    W = model.weights()
    layout, states = W.layout, initial_states.numel()
    G = gauge_directions(W, initial_states)[:, 0 if coordinates else W.nx**2 :]
    free = np.concatenate([layout.free, len(W.flat) + np.arange(states)])
    P, like = len(free), initial_states
    places, size = np.arange(P), np.linalg.norm(G)
    if fixed is not None:
        places = np.delete(places, np.flatnonzero(fixed.cpu().numpy()))
    if not np.isfinite(size):
        return _placed(everything(len(places)), places, P, like)
    own = free[places]
    if len(own) < len(G):
        # Directions that move no fixed parameter: combinations N of G with G[fixed] N = 0.
        others = np.delete(G, own, axis=0)
        G = G[own] @ scipy.linalg.null_space(others) if G.shape[1] else G[own]
    elif before is not None and len(before.kept) + G.shape[1] == len(G):
        left_out = np.setdiff1d(np.arange(len(G)), before.kept.cpu().numpy(), assume_unique=True)
        found = _expanded(G, left_out, like)
        if found is not None:
            return found
    # Only columns of the linear part are left out: those of the static map are computed together.
    lti = int((own < layout.phi.start).sum())
    direct = layout.table[0, own[:lti]] == 2
    pick = np.where(direct, RELUCTANT, 1.0)[:, None] * G[:lti]
    Q, R, pivots = scipy.linalg.qr(pick.T, mode="economic", pivoting=True)
    diagonal = np.abs(np.diag(R))
    least = max(DEPENDENT * diagonal.max(initial=0.0), ROUNDING * size)
    rank = int((diagonal > least).sum())
    found = _expanded(G @ Q[:, :rank], pivots[:rank], like)
    if found is None:
        found = everything(len(G))
    return _placed(found, places, P, like)


def _placed(found: Reduction, places: Int[Integers, " n"], P: int, like: Tensor) -> Reduction:
    """A reduction of the columns at some places as one of all P; the others are zeros."""
    if len(places) == P:
        return found
    kept, at = found.kept, torch.from_numpy(places)
    expand = like.new_zeros(len(kept), P)
    expand[:, at] = torch.eye(len(kept)).to(like) if found.expand is None else found.expand
    return Reduction(at.to(kept.device)[kept], expand)


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


@lru_cache(maxsize=64)
def everything(count: int) -> Reduction:
    """The reduction that keeps all of so many columns."""
    return Reduction(torch.arange(count), None)
