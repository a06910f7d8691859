"""A fit that keeps a certificate: every iterate is proven to contract, for all inputs.

The inequality of ``certificate`` holds by a margin t, maximised over its unknowns P and T. The dual
variable of this maximisation gives the derivative of t by θ. If a step would lead to a point with
t <= 0, the best step under a linear bound on the decrease of t replaces it. This bound is tightened
until t is positive at the end of the step. If the end still has no certificate, bisection finds the
last point on the way there that has one.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy

import numpy as np
import scipy
import torch
from jaxtyping import Float
from torch import Tensor

from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array
from lfrtorch.engine.cell import LFRCell
from lfrtorch.guarantees.certificate import (
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
from lfrtorch.least_squares.bounded_system import BoundedSystem
from lfrtorch.least_squares.linear_systems import System
from lfrtorch.maps.enclosure import Enclosure, everywhere

HALVINGS = 6
"""Number of bisections of a step whose end has no certificate."""

KEPT = 0.1
"""Fraction of t that is left after a step, so that the next step is not too short."""


class Contracting:
    """The guarantee that every model has a certificate of contraction at a rate below 1."""

    def __init__(self, cell: LFRCell, rate: float = SLOWEST) -> None:
        self._rate = rate
        self._cell = deepcopy(cell).to(device="cpu", dtype=torch.float64)
        if self._slopes is None:
            raise InputError(
                "guarantee=contracting needs a static map with bounded slopes, which a network "
                f"has, and not a {self._cell.map.title}."
            )
        self._free = [p for p in self._cell.parameters() if p.requires_grad]
        self._size = sum(p.numel() for p in self._free)
        start = torch.cat([p.detach().flatten() for p in self._free])
        self._last, self._found = start, self._certified(start, None)
        if self._found is None:
            raise InputError(
                "guarantee=contracting needs a start that is proven to contract: init=zero_output, "
                f"a linear model with poles within {rate:.6g}, and no integrators."
            )

    @property
    def _slopes(self) -> Enclosure | None:
        return self._cell.map.enclosure(everywhere(self._cell.nz))

    def _systems(self, theta: Float[Tensor, " P"]) -> list[Differences]:
        """Systems at θ of the difference of two trajectories; the inequality has their matrices."""
        parts = theta[: self._size].detach().cpu().double().split([p.numel() for p in self._free])
        for p, part in zip(self._free, parts, strict=True):
            p.data = part.view_as(p)
        slopes = self._slopes
        assert slopes is not None
        systems = Differences.of(self._cell, slopes)
        if not slopes.J.radius.all() and len(systems) > 1:  # the map's output is zero at the start
            systems = [system for system in systems if system.neurons]
        return systems

    @np.errstate(over="ignore", invalid="ignore")  # a step may be far too long
    def _certified(
        self, theta: Float[Tensor, " P"], known: tuple[Differences, Certificate] | None
    ) -> tuple[Differences, Certificate] | None:
        """The system at θ with a certificate: the known one, if it holds at θ, or a new one."""
        systems = self._systems(theta)
        if known is not None:
            for system in systems:
                if holds(system, known[1], self._rate):
                    return system, known[1]
        for system in systems:
            found = certificate(system, self._rate)
            if found is not None:
                return system, found
        return None

    def admissible(self, theta: Float[Tensor, " P"]) -> Float[Tensor, " P"]:
        """θ if it has a certificate, or the last point on the way to θ that has one."""
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

    def bounded(self, theta: Float[Tensor, " P"], system: System) -> System:
        """Bound the equations of a step so that it keeps a certificate, which θ has."""
        self._last = theta.detach().cpu().double()
        found = self._certified(self._last, None) or self._certified(self._last, self._found)
        if found is None:  # θ was rounded to single precision
            return system
        self._found = found
        own = found[0]
        moved = prepared(own, self._rate)
        assert moved is not None
        x, L, s = moved
        start = margin(x, self._rate)
        if start is None or not own.C.size:
            return system

        def after(step: Float[Tensor, " P"]) -> float:
            """t after a step."""
            for there in self._systems(self._last + step.detach().cpu().double()):
                if there.neurons == own.neurons and there.B.shape == own.B.shape:
                    found = margin(there.moved(L, s)[0], self._rate)
                    return -np.inf if found is None else found.t
            return -np.inf

        slope = self._slope(own, start, L, s)
        return BoundedSystem(system, MarginBound(slope, start.t, after))

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
        cell, static, slopes = self._cell, self._cell.map, self._slopes
        assert slopes is not None
        if system.neurons:
            assert slopes.neurons is not None
            s, left, right = slopes.neurons
            J = left * torch.as_tensor(s.middle) @ right
            right = torch.as_tensor(s.radius).unsqueeze(1) * right
        else:
            # Each entry of J is extreme at certain z; to first order it stays extreme there.
            centres = torch.as_tensor(slopes.centres)
            phi = static.flat_weights()
            with torch.no_grad():
                at = static.slope(centres.unsqueeze(0), phi)[0].flatten(1)
            ends = centres[torch.cat([at.argmin(0), at.argmax(0)])]
            every = static.slope(ends.unsqueeze(0), phi)[0].flatten(1)
            low, high = every.unflatten(0, (2, -1)).diagonal(dim1=1, dim2=2)
            J = ((low + high) / 2).view(cell.nw, cell.nz)
            radius = ((high - low) / 2).view(cell.nw, cell.nz)
            i, j = np.nonzero(slopes.J.radius)
            left = torch.eye(cell.nw, dtype=J.dtype)[:, i]
            right = radius[i, j].unsqueeze(1) * torch.eye(cell.nz, dtype=J.dtype)[j]
        return cell.A + cell.Bw @ J @ cell.Cz, cell.Bw @ left, right @ cell.Cz


class MarginBound:
    """The bound of a step δ that keeps the margin t(δ) positive."""

    trusted, corrections = False, 4

    def __init__(
        self, slope: Float[Tensor, " own"], t: float, after: Callable[[Tensor], float]
    ) -> None:
        self.slopes, self.t, self.after = slope.unsqueeze(0), t, after
        self.room = slope.new_tensor([(1.0 - KEPT) * t])

    def tightened(
        self, step: Float[Tensor, " P"], room: Float[Tensor, " 1"]
    ) -> Float[Tensor, " 1"] | None:
        """A tighter limit on the decrease of t if t is not positive after a step, else None."""
        left = self.after(step)
        if left > 0.0:
            return None
        used = self.slopes.to(step) @ step[: self.slopes.shape[1]]
        # t has fallen by more than to first order. The excess shrinks the room, so that the part
        # KEPT of t may be kept at the next try.
        return torch.minimum(room, used) - (KEPT * self.t - left)
