"""Columns of the Jacobian that must be computed: gauge directions give the other columns.

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
        """All columns, from the kept columns: own @ expand, where expand is mostly the identity."""
        if self.expand is None:
            return own
        whole = own.new_empty(len(own), self.expand.shape[1])
        whole[:, self.kept] = own
        left_out = torch.ones(whole.shape[1], dtype=torch.bool, device=own.device)
        left_out[self.kept] = False
        whole[:, left_out] = own @ self.expand[:, left_out]
        return whole

    def reduced(self, d_theta: Tensor) -> Tensor:
        """A change of the kept parameters alone that changes the outputs in the same way."""
        return d_theta if self.expand is None else self.expand @ d_theta

    def gradient(self, own: Float[Tensor, " K"]) -> Float[Tensor, " P"]:
        """The gradient by all parameters, from the gradient by the kept parameters."""
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
    """The columns of the free parameters' Jacobian that must be computed."""
    # Columns of ``initial_states`` come last and are kept. ``coordinates`` is False if an initial
    # state is given, which fixes the coordinates of x. ``before`` is the reduction at nearby
    # weights; its columns are used again if they are still well conditioned. ``fixed`` entries of
    # the free parameters have columns of zeros.
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
        # Directions that move no fixed parameter are combinations G N with G[fixed] N = 0.
        others = np.delete(G, own, axis=0)
        G = G[own] @ scipy.linalg.null_space(others) if G.shape[1] else G[own]
    elif before is not None and len(before.kept) + G.shape[1] == len(G):
        left_out = np.setdiff1d(np.arange(len(G)), before.kept.cpu().numpy(), assume_unique=True)
        found = _expanded(G, left_out, like)
        if found is not None:
            return found
    # Only columns of the linear part are left out: columns of the static map are computed together.
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
    """A reduction of some of the P columns as a reduction of all P; the other columns are zeros."""
    if len(places) == P:
        return found
    kept, at = found.kept, torch.from_numpy(places)
    expand = like.new_zeros(len(kept), P)
    expand[:, at] = torch.eye(len(kept)).to(like) if found.expand is None else found.expand
    return Reduction(at.to(kept.device)[kept], expand)


def _expanded(
    G: Float[Array, "P directions"], left_out: Int[Integers, " n"], like: Tensor
) -> Reduction | None:
    """The reduction without the columns ``left_out``; None if it would amplify rounding errors."""
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
    """The reduction that keeps all of ``count`` columns."""
    return Reduction(torch.arange(count), None)
