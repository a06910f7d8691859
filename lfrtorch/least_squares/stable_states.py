"""States that fade: a fit that keeps the eigenvalues of A within the unit circle.

If all eigenvalues of A are inside the unit circle and the static map is bounded, no bounded input
makes the model run away: x is the response of a stable linear system to u and w. Exact integrators
stay as they are. A step of a search is held within the limit to first order, at the least cost
(``StableSystem``); what it passes the limit by to second order is taken back (``stabilised``).
"""

from __future__ import annotations

import numpy as np
import scipy
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lfrtorch.engine.linearised import spectral_radius
from lfrtorch.least_squares.linear_systems import System

LIMIT = 1.0 - 1e-6
"""Largest modulus of an eigenvalue: a million samples to fade to 1/e."""


NEAR = 0.9
"""Moduli below this part of the limit are left out of a step's bounds: no step goes so far, and
eigenvalues at 0, those of delays, have no derivative."""

ROUNDING = 1e-12
"""A modulus at the limit is not beyond it."""


def fading(A: Float[Tensor, "nx nx"], integrating: Bool[Tensor, " nx"]) -> Float[Tensor, "n n"]:
    """A without the rows and columns of exact integrators, which do not act on the others."""
    return A.detach()[~integrating][:, ~integrating]


def stabilised(
    A: Float[Tensor, "nx nx"], integrating: Bool[Tensor, " nx"], limit: float = LIMIT
) -> Float[Tensor, "nx nx"]:
    """A with each eigenvalue of a modulus above the limit scaled to it.

    In A = Q T Qᵀ, the real Schur form, the blocks of these eigenvalues on the diagonal are scaled,
    and nothing else changes.

    Args:
        A: matrix.
        integrating: its exact integrators (``exact_integrators.integrating_states``), which stay.
        limit: of the moduli.

    Example:
        >>> from lfrtorch.least_squares.stable_states import stabilised
        >>> A = torch.tensor([[0.5, 7.0], [0.0, 1.25]])
        >>> stabilised(A, torch.tensor([False, False]), limit=0.75)
        tensor([[0.5000, 7.0000],
                [0.0000, 0.7500]])
    """
    own = fading(A, integrating)
    if spectral_radius(own) <= limit:
        return A
    T, Q = scipy.linalg.schur(own.double().cpu().numpy(), output="real")
    i = 0
    while i < len(T):
        block = slice(i, i + 1 + (i + 1 < len(T) and T[i + 1, i] != 0))
        modulus = np.abs(np.linalg.eigvals(T[block, block])).max()
        T[block, block] *= limit / max(limit, modulus)
        i = block.stop
    found = A.clone()
    places = torch.nonzero(~integrating.to(A.device)).flatten()
    found[places.unsqueeze(1), places] = torch.as_tensor(Q @ T @ Q.T).to(A)
    return found


class StableSystem:
    """A system whose steps keep the eigenvalues of A within a limit, to first order.

    A step that would take the modulus of some eigenvalues beyond the limit is replaced by the best
    one that takes them there: the minimum of |r + J δ|² + λ|δ|² under these equations.

    Args:
        system: without the limit.
        A: where the step begins; its entries are the first ones of θ.
        integrating: its exact integrators.
        limit: of the moduli.
    """

    def __init__(
        self,
        system: System,
        A: Float[Tensor, "nx nx"],
        integrating: Bool[Tensor, " nx"],
        limit: float,
    ) -> None:
        self._system, self.scale, self.rank = system, system.scale, system.rank
        own = torch.nonzero(~integrating).flatten().cpu().numpy()
        matrix = fading(A, integrating).double().cpu().numpy()
        values, left, right = scipy.linalg.eig(matrix, left=True, right=True)
        near = np.flatnonzero((np.imag(values) >= 0) & (np.abs(values) > NEAR * limit))
        slopes = np.zeros((len(near), len(A), len(A)))
        # dλ = leftᴴ dA right / leftᴴ right; d|λ| is its part along λ.
        for slope, i in zip(slopes, near, strict=True):
            y, x = np.conj(left[:, i]), right[:, i]
            along = np.conj(values[i]) / abs(values[i])
            slope[np.ix_(own, own)] = (along * np.outer(y, x) / (y @ x)).real
        self._slopes = torch.as_tensor(slopes).flatten(1).to(A)
        self._room = torch.as_tensor(limit - np.abs(values[near])).to(A)

    def solve(self, gradient: Float[Tensor, " P"], damping: float) -> Float[Tensor, " P"]:
        """-(JᵀJ + λI)⁻¹ gradient, within the limit."""
        free = step = self._system.solve(gradient, damping)
        size = self._slopes.shape[1]
        held = torch.zeros(len(self._room), dtype=torch.bool, device=step.device)
        while True:
            passed = (self._slopes @ step[:size] > self._room + ROUNDING) & ~held
            if not passed.any():  # also if the step is NaN
                return step
            held |= passed
            C = step.new_zeros(int(held.sum()), len(step))
            C[:, :size] = self._slopes[held]
            across = torch.stack([-self._system.solve(c, damping) for c in C])
            excess = C @ free - self._room[held]
            step = free - across.mT @ torch.linalg.lstsq(across @ C.mT, excess).solution
