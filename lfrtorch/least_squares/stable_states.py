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


def largest_modulus(samples: int) -> float:
    """Of an eigenvalue that fades to 1/e within a record of so many samples.

    Example:
        >>> from lfrtorch.least_squares.stable_states import largest_modulus
        >>> largest_modulus(1000)
        0.999
    """
    return 1.0 - 1.0 / samples


NEAR = 0.9
"""Moduli below this part of the limit are left out of a step's bounds: no step goes so far, and
eigenvalues at 0, those of delays, have no derivative."""

CORRECTIONS = 5
"""Most rounds in which a step's bounds are tightened by what it passes the limit by."""

ROUNDING = 1e-12
"""A modulus at the limit is not beyond it."""


def fading(A: Float[Tensor, "nx nx"], integrating: Bool[Tensor, " nx"]) -> Float[Tensor, "n n"]:
    """A without the rows and columns of exact integrators, which do not act on the others."""
    return A.detach()[~integrating][:, ~integrating]


def stabilised(
    A: Float[Tensor, "nx nx"], integrating: Bool[Tensor, " nx"], limit: float
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
    one that takes them there: the minimum of |r + J δ|² + λ|δ|² under these bounds, which are
    tightened until the step keeps them to all orders.

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
        self._own = torch.nonzero(~integrating).flatten().cpu().numpy()
        self._A = fading(A, integrating).double().cpu().numpy()
        self._limit = limit
        values, left, right = scipy.linalg.eig(self._A, left=True, right=True)
        near = np.flatnonzero((np.imag(values) >= 0) & (np.abs(values) > NEAR * limit))
        self._values = values[near]
        slopes = np.zeros((len(near), len(A), len(A)), complex)
        # dλ = leftᴴ dA right / leftᴴ right; d|λ| is its part along λ.
        for slope, i in zip(slopes, near, strict=True):
            y, x = np.conj(left[:, i]), right[:, i]
            slope[np.ix_(self._own, self._own)] = np.outer(y, x) / (y @ x)
        self._changes = slopes.reshape(len(near), A.numel())
        along = np.conj(self._values) / np.abs(self._values)
        self._slopes = torch.as_tensor((along[:, None] * self._changes).real).to(A)

    def solve(self, gradient: Float[Tensor, " P"], damping: float) -> Float[Tensor, " P"]:
        """-(JᵀJ + λI)⁻¹ gradient, within the limit."""
        free = self._system.solve(gradient, damping)
        C = free.new_zeros(len(self._slopes), len(free))
        C[:, : self._slopes.shape[1]] = self._slopes
        room = torch.as_tensor(self._limit - np.abs(self._values)).to(free)
        if not (C @ free - room > ROUNDING).any():  # also if the step is NaN
            return free
        across = torch.stack([-self._system.solve(c, damping) for c in C])
        # Multipliers μ >= 0 of the bounds: the least |Lᵀμ - L⁻¹ excess|² for L Lᵀ = C across.
        G = C @ across.mT
        G.diagonal().add_(ROUNDING * G.diagonal().max())
        L = torch.linalg.cholesky(G)
        step = free
        for _ in range(CORRECTIONS):
            excess = (C @ free - room).unsqueeze(-1)
            rest = torch.linalg.solve_triangular(L, excess, upper=False).squeeze(-1)
            multipliers, _ = scipy.optimize.nnls(L.mT.cpu().numpy(), rest.cpu().numpy())
            step = free - across.mT @ torch.as_tensor(multipliers).to(free)
            beyond = self._beyond(step)
            if beyond.max() < ROUNDING:
                break
            room -= torch.as_tensor(beyond).to(room)
        return step

    def _beyond(self, step: Float[Tensor, " P"]) -> Float[np.ndarray, " near"]:
        """How far a step takes each pole beyond the limit, to all orders."""
        dA = step[: self._slopes.shape[1]].double().cpu().numpy()
        size = round(len(dA) ** 0.5)
        after = np.linalg.eigvals(self._A + dA.reshape(size, size)[np.ix_(self._own, self._own)])
        expected = self._values + self._changes @ dA
        which = scipy.optimize.linear_sum_assignment(np.abs(expected[:, None] - after))[1]
        return np.maximum(np.abs(after[which]) - self._limit, 0.0)
