"""The errors that a fit minimises: simulated minus measured outputs of groups of records."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lfrtorch._support.threads import fast_paths, has_kernels
from lfrtorch._support.types import Array
from lfrtorch.data.records import NormalisedRecord
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.record_starts import STARTS
from lfrtorch.engine.sensitivity import Linearisation
from lfrtorch.engine.simulation import Trajectory
from lfrtorch.engine.weights import Weights
from lfrtorch.least_squares.output_rows import Memory, OutputRows
from lfrtorch.least_squares.record_groups import EVERY, group_records
from lfrtorch.least_squares.term import Seen


class Parameters:
    """θ: the free numbers of a model in their order, then the initial states of records."""

    # On the CPU θ and all numbers computed from it are float64, whatever the dtype of the cell.

    def __init__(self, cell: LFRCell, states: int) -> None:
        W = cell.weights()
        self.layout, self.states = W.layout, states
        self._flat = W.flat.double() if has_kernels(W.flat) else W.flat
        self._free = torch.from_numpy(self.layout.free).to(W.flat.device)
        self.own = len(self._free)
        """Number of entries before the initial states."""
        self.sizes = {n: p.numel() for n, p in cell.named_parameters() if p.requires_grad}
        """Number of entries of each parameter, and of the initial states if there are any."""
        self.names = list(self.sizes)
        if states:
            self.sizes["x0"] = states * cell.nx

    @property
    def start(self) -> Float[Tensor, " own"]:
        """θ of the given cell, without initial states."""
        return self._flat[self._free]

    def weights(self, theta: Float[Tensor, " P"]) -> Weights:
        """The numbers of the model at θ."""
        if self.own == len(self._flat):
            return Weights(self.layout, theta[: self.own])
        flat = self._flat.clone()
        flat[self._free] = theta[: self.own]
        return Weights(self.layout, flat)

    def initial_states(self, theta: Float[Tensor, " P"]) -> Float[Tensor, "states nx"]:
        """The initial states in θ."""
        return theta[self.own :].view(self.states, self.layout.sizes[0])

    def read(self, cell: LFRCell) -> Float[Tensor, " own"]:
        """θ of a cell, without initial states."""
        free = [p.detach().flatten() for p in cell.parameters() if p.requires_grad]
        return torch.cat([self._flat[:0], *(p.to(self._flat) for p in free)])

    def write(self, cell: LFRCell, theta: Float[Tensor, " P"]) -> None:
        """Put θ into a cell."""
        free = [p for p in cell.parameters() if p.requires_grad]
        parts = theta[: self.own].detach().split([p.numel() for p in free])
        with torch.no_grad():
            for p, part in zip(free, parts, strict=True):
                p.copy_(part.view_as(p))


class SimulationErrors:
    """A term of a problem: weighted, normalised y_hat - y; 0 where a sample does not count."""

    # ``own`` selects the records that have errors here; θ has the start states of all records.
    # ``solve_initial_states``: estimated initial states are not part of θ, but are solved for at
    # every θ, and outputs are clipped to the limits of a record, as in a score.

    def __init__(
        self,
        cell: LFRCell,
        records: Sequence[NormalisedRecord],
        *,
        own: slice = EVERY,
        y_scale: Array | float = 1.0,
        solve_initial_states: bool = False,
    ) -> None:
        cell.check()
        self._y_scale = y_scale
        self._solved = solve_initial_states
        estimated = sum(STARTS[each.record.start].fitted for each in records)
        self.parameters = Parameters(cell, 0 if solve_initial_states else estimated)
        start = self.parameters.weights(self.parameters.start)
        self.groups = group_records(records, start, own)
        self.size = sum(int(each.record.scored.sum()) for each in records)
        self._memory = Memory()

    def evaluate(self, theta: Float[Tensor, " P"], near: Seen | None = None) -> tuple[Tensor, Seen]:
        """Weighted errors at θ, infinite or NaN if the model diverges, and the trajectories."""
        errors, seen = [], self._simulated(theta, near)
        for group, trajectory in zip(self.groups, seen, strict=True):
            y_hat = group.shown(trajectory.y) if self._solved else trajectory.y
            errors.append(group.counted(y_hat).weigh(y_hat - group.y).flatten())
        return errors[0] if len(errors) == 1 else torch.cat(errors), seen

    def linearise(
        self, theta: Float[Tensor, " P"], seen: Seen, *, eliminate: bool = False
    ) -> list[OutputRows]:
        """The rows of each group at θ; ``eliminate`` leaves out the columns of initial states."""
        W, own, rows = self.parameters.weights(theta), self.parameters.own, []
        for group, trajectory in zip(self.groups, seen, strict=True):
            x0 = group.estimated if self.parameters.states else None
            if x0 is not None:
                x0 = own + W.nx * x0.unsqueeze(1) + torch.arange(W.nx)
            linearisation = Linearisation(W, group.u, trajectory, periodic=group.start.periodic)
            counted = group.counted(trajectory.y)
            rows.append(OutputRows(counted, linearisation, x0, self._memory, eliminate=eliminate))
        return rows

    def squares(self, seen: Seen) -> Tensor:
        """Sum of squared errors over scored samples, unweighted, in output units, as in a score."""
        total = torch.zeros((), dtype=torch.float64)
        for group, trajectory in zip(self.groups, seen, strict=True):
            scale = torch.as_tensor(self._y_scale).to(group.y)
            errors = (group.shown(trajectory.y) - group.y) * scale * group.scored
            total = total + errors.double().square().sum()
        return total

    def _simulated(self, theta: Float[Tensor, " P"], near: Seen | None) -> tuple[Trajectory, ...]:
        """The trajectory of each group at θ; ``near`` has trajectories at a nearby θ."""
        W, found = self.parameters.weights(theta), []
        for i, group in enumerate(self.groups):
            states = near[i].x if near is not None and fast_paths() else None
            x0 = group.x0
            if group.start_weight is not None and self._solved:
                first = None if states is None else states[:, 0]
                x0 = group.start.solved(W, group.u, group.y, group.start_weight, first)
            elif group.estimated is not None:
                x0 = self.parameters.initial_states(theta)[group.estimated]
            found.append(group.start.trajectory(W, group.u, x0, states))
        return tuple(found)

    def part(self, chosen: Sequence[Int[Tensor, " n"]]) -> SimulationErrors:
        """The errors of some records of each group, as functions of the same θ."""
        found = copy(self)
        pairs = zip(self.groups, chosen, strict=True)
        found.groups = [group.part(records) for group, records in pairs if len(records)]
        found.size = int(sum(group.scored.sum() for group in found.groups))
        found._memory = Memory()
        return found

    def first_theta(self) -> Float[Tensor, " P"]:
        """θ of the given cell, with the initial states that fit best."""
        start = self.parameters.start
        W, count = self.parameters.weights(start), self.parameters.states
        states = start.new_zeros(count, W.nx)
        for group in self.groups if count else ():
            if group.estimated is not None:
                weight = group.weight
                if group.beyond is not None:
                    weight = weight * (group.beyond == 0)
                states[group.estimated] = group.start.guess(W, group.u, group.y, weight)
        return torch.cat([start, states.flatten()])

    def release(self) -> None:
        """Free the memory of rows."""
        self._memory = Memory()
