"""The guarantee of stable states: a fit that keeps the eigenvalues of A within the unit circle.

If all eigenvalues of A are inside the unit circle and the static map is bounded, no bounded input
makes the model run away: x is the response of a stable linear system to u and w. Exact integrators
do not change. A step of a search keeps the limit to first order, at the least cost
(``PoleBounds``); an excess of second order is then corrected (``stabilised``).
"""

from __future__ import annotations

import numpy as np
import scipy
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lfrtorch._support.threads import to_float64
from lfrtorch.distributed import agreed
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.held import integrating_states
from lfrtorch.engine.linearised import spectral_radius
from lfrtorch.least_squares.bounded_system import ROUNDING, BoundedSystem
from lfrtorch.least_squares.linear_systems import System


def largest_modulus(samples: int) -> float:
    """Largest modulus of an eigenvalue whose response decays to 1/e within a number of samples."""
    return 1.0 - 1.0 / samples


NEAR = 0.9
"""Eigenvalues with a modulus below this part of the limit do not bound a step: no step moves them
that far, and eigenvalues at 0, as of delays, have no derivative."""


_NEWTON = 10
"""Largest number of Newton steps to the least change; after a step of a search three are enough."""


def fading(A: Float[Tensor, "nx nx"], integrating: Bool[Tensor, " nx"]) -> Float[Tensor, "n n"]:
    """Block of A without the exact integrators, which do not act on the other states."""
    return A.detach()[~integrating][:, ~integrating]


def stabilised(
    A: Float[Tensor, "nx nx"], integrating: Bool[Tensor, " nx"], limit: float
) -> Float[Tensor, "nx nx"]:
    """A with each eigenvalue of a modulus above the limit scaled to it."""
    # In the real Schur form A = Q T Qᵀ, the diagonal blocks of these eigenvalues are scaled, and
    # nothing else changes. Exact integrators do not change.
    own = fading(A, integrating)
    if spectral_radius(own) <= limit:
        return A
    T, Q = scipy.linalg.schur(to_float64(own), output="real")
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


def within(
    A: Float[Tensor, "nx nx"],
    integrating: Bool[Tensor, " nx"],
    held: Bool[Tensor, "nx nx"],
    limit: float,
) -> Float[Tensor, "nx nx"]:
    """A with its eigenvalues brought within the limit, by the least change of its free entries."""
    for _ in range(_NEWTON):
        bounds = PoleBounds(A, integrating, limit)
        beyond = bounds.room < 0
        if not beyond.any():
            break
        slopes = bounds.slopes[beyond].masked_fill(held.flatten(), 0.0)
        change = torch.linalg.pinv(slopes) @ bounds.room[beyond].to(slopes)
        A = A + change.view_as(A)
    return A


class Stable:
    """The guarantee that states decay within a record, by the eigenvalues of A."""

    # Eigenvalues that are outside the limit at the start stay within the smallest circle that has
    # all of them at the start.

    def __init__(self, cell: LFRCell, samples: int) -> None:
        self._nx, self._integrating = cell.nx, integrating_states(cell)
        held = cell.held.get("A", torch.zeros(cell.A.shape, dtype=torch.bool)).to(cell.A.device)
        self._held = held & ~self._integrating
        radius = agreed(spectral_radius(fading(cell.A, self._integrating)).double())
        self._limit = max(largest_modulus(samples), float(radius))

    def admissible(self, theta: Float[Tensor, " P"]) -> Float[Tensor, " P"]:
        """θ with A's eigenvalues within the limit."""
        if not torch.isfinite(theta).all():
            return theta
        A = self._matrix(theta)
        if self._held.any():
            found = within(A, self._integrating, self._held, self._limit)
        else:
            found = stabilised(A, self._integrating, self._limit)
        return theta if found is A else torch.cat([found.flatten(), theta[self._nx**2 :]])

    def bounded(self, theta: Float[Tensor, " P"], system: System) -> System:
        """The system whose steps from θ keep A's eigenvalues within the limit."""
        bounds = PoleBounds(self._matrix(theta), self._integrating, self._limit)
        return BoundedSystem(system, bounds)

    def _matrix(self, theta: Float[Tensor, " P"]) -> Float[Tensor, "nx nx"]:
        return theta[: self._nx**2].view(self._nx, self._nx)


class PoleBounds:
    """Bounds of steps that keep the eigenvalues of A within a limit."""

    trusted, corrections = True, 5

    def __init__(
        self, A: Float[Tensor, "nx nx"], integrating: Bool[Tensor, " nx"], limit: float
    ) -> None:
        self._own = torch.nonzero(~integrating).flatten().cpu().numpy()
        self._A = to_float64(fading(A, integrating))
        self._limit = limit
        values, left, right = scipy.linalg.eig(self._A, left=True, right=True)
        near = np.flatnonzero((np.imag(values) >= 0) & (np.abs(values) > NEAR * limit))
        self._values = values[near]
        slopes = np.zeros((len(near), len(A), len(A)), complex)
        # dλ = leftᴴ dA right / leftᴴ right, and d|λ| is the part of dλ along λ.
        for slope, i in zip(slopes, near, strict=True):
            y, x = np.conj(left[:, i]), right[:, i]
            slope[np.ix_(self._own, self._own)] = np.outer(y, x) / (y @ x)
        self._changes = slopes.reshape(len(near), A.numel())
        along = np.conj(self._values) / np.abs(self._values)
        self.slopes = torch.as_tensor((along[:, None] * self._changes).real).to(A)
        self.room = torch.as_tensor(limit - np.abs(self._values))

    def tightened(
        self, step: Float[Tensor, " P"], room: Float[Tensor, " near"]
    ) -> Float[Tensor, " near"] | None:
        """Reduce the room by the excess of each pole after a step; None if there is no excess."""
        dA = to_float64(step[: self.slopes.shape[1]])
        size = round(len(dA) ** 0.5)
        after = np.linalg.eigvals(self._A + dA.reshape(size, size)[np.ix_(self._own, self._own)])
        expected = self._values + self._changes @ dA
        which = scipy.optimize.linear_sum_assignment(np.abs(expected[:, None] - after))[1]
        beyond = np.maximum(np.abs(after[which]) - self._limit, 0.0)
        return None if beyond.max() < ROUNDING else room - torch.as_tensor(beyond).to(room)
