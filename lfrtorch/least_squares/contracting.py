"""A fit that keeps the certificate: every model on its way is proven to contract, for all inputs.

The inequality of ``certificate`` holds by a margin t, the largest that some P and T give. Its
multiplier says how t changes with θ, to first order. A step that would leave none is replaced by
the best one under a bound on that change, which is tightened until t is positive where the step
ends. If there is no certificate still, the last point on the way there that has one is taken.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy

import numpy as np
import scipy
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.utils import vector_to_parameters

from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.linearised import of_static
from lfrtorch.engine.nonlinearity import Network, is_network
from lfrtorch.engine.static_enclosure import enclosure, everywhere
from lfrtorch.engine.static_jacobian import linearise_static
from lfrtorch.least_squares.certificate import (
    SLOWEST,
    Certificate,
    Differences,
    Margin,
    certificate,
    holds,
    margin,
    prepared,
    returned,
)
from lfrtorch.least_squares.linear_systems import System

HALVINGS = 6
"""Halvings of the way to a step's end without a certificate."""

KEPT = 0.1
"""Part of t that a step should leave for the next one."""

CORRECTIONS = 4
"""Most rounds in which a step's bound is tightened by what it passes t = 0 by."""

TINY = 1e-300
"""Smallest divisor."""


class Contracting:
    """Certificates on the way of a search.

    Args:
        cell: the model; its free parameters are the first entries of θ.

    Raises:
        ValueError: its static map is no network, or it has no certificate.
    """

    def __init__(self, cell: LFRCell) -> None:
        if not is_network(cell.static):
            raise InputError(
                "contracting=true needs a network as the static map, whose slopes are bounded, not "
                f"a {type(cell.static).__name__}."
            )
        self._cell = deepcopy(cell).to(device="cpu", dtype=torch.float64)
        self._free = [p for p in self._cell.parameters() if p.requires_grad]
        self._size = sum(p.numel() for p in self._free)
        start = torch.cat([p.detach().flatten() for p in self._free])
        self._last, self._found = start, self._certified(start, None)
        if self._found is None:
            raise InputError(
                "contracting=true needs a start that is proven to contract: init=zero_output, a "
                "linear model with its poles inside the unit circle, and no integrators."
            )

    @property
    def _static(self) -> Network:
        static = self._cell.static
        assert is_network(static)
        return static

    def _systems(self, theta: Float[Tensor, " P"]) -> list[Differences]:
        """The inequality's matrices at θ."""
        vector_to_parameters(theta[: self._size].detach().cpu().double(), self._free)
        slopes = enclosure(self._static, everywhere(self._cell.nz))
        systems = Differences.of(self._cell, slopes)
        if not slopes.J.radius.all() and len(systems) > 1:  # at a start without output
            systems = [system for system in systems if system.neurons]
        return systems

    def _certified(
        self, theta: Float[Tensor, " P"], known: tuple[Differences, Certificate] | None
    ) -> tuple[Differences, Certificate] | None:
        """The system at θ with a certificate: one that is known, if it holds, or a new one."""
        systems = self._systems(theta)
        if known is not None:
            for system in systems:
                if holds(system, known[1], SLOWEST):
                    return system, known[1]
        for system in systems:
            found = certificate(system, SLOWEST)
            if found is not None:
                return system, found
        return None

    def admissible(self, theta: Float[Tensor, " P"]) -> Float[Tensor, " P"]:
        """θ if it has a certificate, or the last point on the way there that has."""
        if not torch.isfinite(theta).all() or self._certified(theta, self._found) is not None:
            return theta
        last = theta.clone()
        last[: self._size] = self._last[: self._size].to(theta)
        low, high = 0.0, 1.0
        for _ in range(HALVINGS):
            part = (low + high) / 2
            if self._certified(last + part * (theta - last), self._found) is None:
                high = part
            else:
                low = part
        return last + low * (theta - last)

    def begin(self, theta: Float[Tensor, " P"]) -> None:
        """Note where the next step begins; θ has a certificate."""
        self._last = theta.detach().cpu().double()

    def bounded(self, system: System) -> System:
        """A system of steps from there that keep the certificate."""
        found = self._certified(self._last, None) or self._certified(self._last, self._found)
        if found is None:  # rounding of θ to single precision
            return system
        self._found = found
        own = found[0]
        moved = prepared(own, SLOWEST)
        assert moved is not None
        x, L, s = moved
        start = margin(x, SLOWEST)
        if start is None or not own.C.size:
            return system

        def room(step: Float[Tensor, " P"]) -> float:
            """t after a step."""
            for after in self._systems(self._last + step.detach().cpu().double()):
                if after.neurons == own.neurons and after.B.shape == own.B.shape:
                    found = margin(after.moved(L, s)[0], SLOWEST)
                    return -np.inf if found is None else found.t
            return -np.inf

        return HeldSystem(system, self._slope(own, start, L, s), start.t, room)

    def _slope(
        self, system: Differences, found: Margin, L: Array, s: Array
    ) -> Float[Tensor, " own"]:
        """Derivative of -t by θ."""
        P, T = (torch.as_tensor(part) for part in returned(found.P, found.T, L, s))
        A, B, C = self._matrices(system)
        to = scipy.linalg.block_diag(np.linalg.inv(L), np.diag(1.0 / s))
        V = torch.as_tensor(to @ found.Z @ to.T)
        step, seen = torch.cat([A, B], dim=1), torch.cat([C, C.new_zeros(len(C), len(C))], dim=1)
        value = (V * (step.mT @ P @ step + (seen.mT * T) @ seen)).sum()
        parts = torch.autograd.grad(value, self._free, allow_unused=True)
        pairs = zip(parts, self._free, strict=True)
        return torch.cat([(0.0 * p if d is None else d).detach().flatten() for d, p in pairs])

    def _matrices(self, system: Differences) -> tuple[Tensor, Tensor, Tensor]:
        """A, B and C of the system as functions of the parameters."""
        cell, static = self._cell, self._static
        slopes = enclosure(static, everywhere(cell.nz))
        if system.neurons:
            middle = torch.as_tensor(slopes.slopes.middle)
            radius = torch.as_tensor(slopes.slopes.radius).unsqueeze(1)
            J, left, right = static.Ww * middle @ static.Wz, static.Ww, radius * static.Wz
        else:
            # Each entry's extremes are at certain z, which stay the extremes to first order.
            centres = torch.as_tensor(slopes.centres)
            weights = of_static(dict(cell.named_parameters()))
            with torch.no_grad():
                at = linearise_static(static, centres.unsqueeze(0), weights).J[0].flatten(1)
            ends = centres[torch.cat([at.argmin(0), at.argmax(0)])]
            every = linearise_static(static, ends.unsqueeze(0), weights).J[0].flatten(1)
            low, high = every.unflatten(0, (2, -1)).diagonal(dim1=1, dim2=2)
            J = ((low + high) / 2).view(cell.nw, cell.nz)
            radius = ((high - low) / 2).view(cell.nw, cell.nz)
            i, j = np.nonzero(slopes.J.radius)
            left = torch.eye(cell.nw, dtype=J.dtype)[:, i]
            right = radius[i, j].unsqueeze(1) * torch.eye(cell.nz, dtype=J.dtype)[j]
        return cell.A + cell.Bw @ J @ cell.Cz, cell.Bw @ left, right @ cell.Cz


class HeldSystem:
    """A system whose steps keep a number t(δ) positive.

    Where a step would not, it is replaced by the minimum of |r + J δ|² + λ|δ|² under slope δ =
    room, with the room such that t is nearly 0 where the step ends.

    Args:
        system: without the bound.
        slope: the derivative of -t by the first entries of a step.
        t: at 0.
        after: t after a step.
    """

    def __init__(
        self,
        system: System,
        slope: Float[Tensor, " own"],
        t: float,
        after: Callable[[Tensor], float],
    ) -> None:
        self._system, self.scale, self.rank = system, system.scale, system.rank
        self.slope, self.t, self.after = slope, t, after

    def solve(self, gradient: Float[Tensor, " P"], damping: float) -> Float[Tensor, " P"]:
        """-(JᵀJ + λI)⁻¹ gradient, within the bound."""
        free = step = self._system.solve(gradient, damping)
        if not torch.isfinite(free).all():
            return free
        slope = torch.zeros_like(free)
        slope[: len(self.slope)] = self.slope.to(free)
        across = -self._system.solve(slope, damping)
        curvature = float(slope @ across)
        room = (1.0 - KEPT) * self.t
        for _ in range(CORRECTIONS):
            excess = float(slope @ free) - room
            step = free - max(0.0, excess) / max(curvature, TINY) * across
            left = self.after(step)
            if left > 0.0:
                break
            # t is left less than the bound says; half of it is tried to be kept.
            room = min(room, float(slope @ step)) - (KEPT * self.t - left)
        return step
