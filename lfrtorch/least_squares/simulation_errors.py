"""The errors that a fit is about: simulated minus measured outputs of groups of records.

``SimulationErrors`` are those of a model along its own records. ``SystemErrors`` are those of the
system that a one-step predictor stands for, as a function of the predictor's parameters.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from copy import copy, deepcopy
from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.utils import vector_to_parameters

from lfrtorch._support.types import Array
from lfrtorch.distributed import Ranks
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.initial_state import estimated_start, start_from_beginning
from lfrtorch.engine.innovation import split_predictor, split_weights
from lfrtorch.engine.sensitivity import Linearisation
from lfrtorch.engine.simulation import Trajectory, is_compiled, simulate, steady_state
from lfrtorch.least_squares.jacobian import MappedRows, Memory, OutputRows
from lfrtorch.least_squares.record_groups import group_records
from lfrtorch.records import NormalisedRecord


class Parameters:
    """θ: the parameters of a cell that require a gradient, then initial states of records."""

    def __init__(self, cell: LFRCell, states: int) -> None:
        self.sizes = {n: p.numel() for n, p in cell.named_parameters() if p.requires_grad}
        """Entries of each parameter, and of the initial states if there are any."""
        self.names, self.own = list(self.sizes), sum(self.sizes.values())
        """Names of the cell's parameters, and their entries, before those of initial states."""
        self.states, self._nx = states, cell.nx
        if states:
            self.sizes["x0"] = states * cell.nx

    def of(self, cell: LFRCell, initial_states: Float[Tensor, "states nx"]) -> Float[Tensor, " P"]:
        """θ of the weights of a cell and initial states."""
        own = [cell.get_parameter(name).detach().flatten() for name in self.names]
        return torch.cat([*own, initial_states.flatten()])

    def initial_states(self, theta: Float[Tensor, " P"]) -> Float[Tensor, "states nx"]:
        """The initial states in θ."""
        return theta[self.own :].view(self.states, self._nx)

    def write(self, cell: LFRCell, theta: Float[Tensor, " P"]) -> None:
        """Put θ into a cell, whose weights are views of it from then on."""
        weights = [cell.get_parameter(name) for name in self.names]
        vector_to_parameters(theta[: self.own].detach().to(cell.A), weights)


class SimulationErrors:
    """A term of a problem: weighted y_hat - y, normalised; 0 where a sample does not count."""

    # ``solve_initial_states``: estimated initial states are no part of θ, but solved for at every
    # θ, and outputs end at the limits of a record, as in a score.

    eliminates = True

    def __init__(
        self,
        cell: LFRCell,
        records: Sequence[NormalisedRecord],
        ranks: Ranks,
        *,
        y_scale: Array | float = 1.0,
        solve_initial_states: bool = False,
    ) -> None:
        cell.check()
        self._cell, self.ranks, self._y_scale = deepcopy(cell), ranks, y_scale
        self._solved = solve_initial_states
        self.groups = group_records(records, self._cell, ranks)
        self.size = sum(int(each.record.scored.sum()) for each in records)
        estimated = sum(each.record.start == "estimated" for each in records)
        self.parameters = Parameters(cell, 0 if solve_initial_states else estimated)
        self._memory = Memory()
        self._guesses: list[Tensor | None] = [None] * len(self.groups)
        """States of each group at a θ close to the next one."""
        self._starts: list[Tensor | None] = [None] * len(self.groups)
        """Initial states of each group that were solved for last."""
        self._written: Tensor | None = None
        """The θ whose weights the cell has."""
        # A search evaluates r at a θ and, if it accepts it, J there: one simulation serves both.
        self._latest: tuple[Tensor, list[Trajectory]] | None = None

    def cell_at(self, theta: Float[Tensor, " P"]) -> LFRCell:
        """The model with the weights in θ, until the next call."""
        if self._written is None or not torch.equal(self._written, theta):
            self._written = theta.clone()
            self.parameters.write(self._cell, self._written)
        return self._cell

    def residual(self, theta: Float[Tensor, " P"]) -> Float[Tensor, " M"]:
        """Weighted errors at θ; infinite or NaN if the model diverges."""
        errors = []
        for group, trajectory in zip(self.groups, self.trajectories(theta), strict=True):
            y_hat = group.shown(trajectory.y) if self._solved else trajectory.y
            errors.append(group.counted(y_hat).weigh(y_hat - group.y).flatten())
        return torch.cat(errors)

    def linearise(self, theta: Float[Tensor, " P"], *, eliminate: bool = False) -> list[OutputRows]:
        """The rows of each group at θ; ``eliminate``: without columns of initial states."""
        trajectories = self.trajectories(theta)
        self._guesses = [t.x for t in trajectories]
        cell, own, rows = self.cell_at(theta), self.parameters.own, []
        for group, trajectory in zip(self.groups, trajectories, strict=True):
            x0 = group.estimated if self.parameters.states else None
            if x0 is not None:
                x0 = own + cell.nx * x0.unsqueeze(1) + torch.arange(cell.nx)
            periodic = group.start == "periodic"
            linearisation = Linearisation(cell, group.u, trajectory, periodic=periodic)
            counted = group.counted(trajectory.y)
            rows.append(OutputRows(counted, linearisation, x0, self._memory, eliminate=eliminate))
        return rows

    def rmse(self, theta: Float[Tensor, " P"]) -> float:
        """RMSE at θ over scored samples and outputs, unweighted, in output units, as in a score."""
        total = torch.zeros((), dtype=torch.float64, device=theta.device)
        scale = torch.as_tensor(self._y_scale).to(theta)
        for group, trajectory in zip(self.groups, self.trajectories(theta), strict=True):
            errors = (group.shown(trajectory.y) - group.y) * scale * group.scored
            total = total + errors.double().square().sum()
        return math.sqrt(self.ranks.sum(total) / self.size)

    def trajectories(self, theta: Float[Tensor, " P"]) -> list[Trajectory]:
        """Trajectories of each group at θ; those of the latest θ are cached."""
        if self._latest is None or not torch.equal(self._latest[0], theta):
            self._latest = None  # free its memory first
            found = [self._trajectory(i, theta) for i in range(len(self.groups))]
            self._latest = theta.clone(), found
        return self._latest[1]

    def _trajectory(self, i: int, theta: Float[Tensor, " P"]) -> Trajectory:
        """The trajectory of a group at θ."""
        group, x0 = self.groups[i], self._initial_state(i, theta)
        cell = self.cell_at(theta)  # whose sizes and dtype θ cannot change: no check
        if group.start == "periodic":
            return steady_state(cell, group.u, self._guesses[i])
        x0 = group.u.new_zeros(len(group.u), cell.nx) if x0 is None else x0
        return simulate(cell, group.u, x0, guess=self._guesses[i])

    def _initial_state(self, i: int, theta: Float[Tensor, " P"]) -> Float[Tensor, "R nx"] | None:
        """Initial states of group i at θ, unless they are zero or periodic."""
        group = self.groups[i]
        if group.estimated is None:
            return group.x0
        if self._solved:
            assert group.start_weight is not None
            cell, near = self.cell_at(theta), self._starts[i]
            found = estimated_start(cell, group.u, group.y, group.start_weight, near)
            self._starts[i] = found
            return found
        return self.parameters.initial_states(theta)[group.estimated]

    def part(self, chosen: Sequence[Int[Tensor, " n"]]) -> SimulationErrors:
        """The errors of some records of each group, as functions of the same θ."""
        found = copy(self)
        pairs = zip(self.groups, chosen, strict=True)
        found.groups = [group.part(records) for group, records in pairs if len(records)]
        found.size = int(sum(group.scored.sum() for group in found.groups))
        found._cell, found._memory = deepcopy(self._cell), Memory()
        found._guesses, found._starts = [None] * len(found.groups), [None] * len(found.groups)
        found._written = found._latest = None
        return found

    def first_initial_states(self) -> Float[Tensor, "states nx"]:
        """Initial states in θ that fit best at the weights that were given."""
        cell = self._cell
        states = cell.A.new_zeros(self.parameters.states, cell.nx)
        for group in self.groups if len(states) else ():
            if group.estimated is not None:
                weight = group.weight
                if group.beyond is not None:
                    weight = weight * (group.beyond == 0)
                states[group.estimated] = start_from_beginning(cell, group.u, group.y, weight)
        return self.ranks.sum(states)

    def release(self) -> None:
        """Free the memory of what only speeds up the next evaluation."""
        self._latest, self._memory = None, Memory()

    def state_dict(self) -> dict[str, Tensor]:
        """What the next evaluations depend on besides θ, to the last bit."""
        tensors = {}
        for i, (group, guess) in enumerate(zip(self.groups, self._guesses, strict=True)):
            if guess is not None:  # machine code needs the initial state of a period alone
                compiled = is_compiled(self._cell, group.u)
                tensors[f"guess.{i}"] = guess[:, :1] if compiled else guess
        tensors |= {f"solved.{i}": x for i, x in enumerate(self._starts) if x is not None}
        return tensors

    def load_state_dict(self, tensors: Mapping[str, Tensor]) -> None:
        """Take over what the same term had."""
        self._guesses = [tensors.get(f"guess.{i}") for i in range(len(self.groups))]
        self._starts = [tensors.get(f"solved.{i}") for i in range(len(self.groups))]
        self._latest = None


class SystemErrors:
    """A term of a problem: errors of simulations by the system that a predictor stands for."""

    # θ are the parameters of the one-step predictor (``engine.innovation``), and φ(θ) are those of
    # the system. An estimated initial state is one parameter for both: before the first sample the
    # predictor's state is the system's.

    eliminates = False

    def __init__(
        self,
        predictor: LFRCell,
        records: Sequence[NormalisedRecord],
        ranks: Ranks,
        *,
        solve_initial_states: bool = False,
        weight: float = 1.0,
    ) -> None:
        system, _ = split_predictor(predictor)
        self._predictor, self.weight = predictor, weight
        self._errors = SimulationErrors(
            system,
            [_without_past_outputs(record, system.nu) for record in records],
            ranks,
            solve_initial_states=solve_initial_states,
        )

    def residual(self, theta: Float[Tensor, " P"]) -> Float[Tensor, " M"]:
        """Weighted errors at φ(θ)."""
        return self.weight * self._errors.residual(self._system_theta(theta))

    def linearise(self, theta: Float[Tensor, " P"], *, eliminate: bool = False) -> list[MappedRows]:
        """The rows of each group at θ: those of the system times dφ/dθ."""
        steps = torch.eye(len(theta)).to(theta)
        # φ is quadratic, so that this difference is its derivative.
        change = (self._system_theta(theta + steps) - self._system_theta(theta - steps)).mT / 2.0
        rows = self._errors.linearise(self._system_theta(theta))
        return [MappedRows(part, change, self.weight) for part in rows]

    def release(self) -> None:
        """Free the memory of what only speeds up the next evaluation."""
        self._errors.release()

    def state_dict(self) -> dict[str, Tensor]:
        """What the next evaluations depend on besides θ, to the last bit."""
        return self._errors.state_dict()

    def load_state_dict(self, tensors: Mapping[str, Tensor]) -> None:
        """Take over what the same term had."""
        self._errors.load_state_dict(tensors)

    def _system_theta(self, theta: Float[Tensor, "*axes n"]) -> Float[Tensor, "*axes m"]:
        """φ of the free parameters at the beginning of θ, then the initial states in θ."""
        axes, weights, first = theta.shape[:-1], {}, 0
        for name, parameter in self._predictor.named_parameters():
            weights[name] = parameter.detach().expand(*axes, *parameter.shape)
            if parameter.requires_grad:
                part = theta[..., first : first + parameter.numel()]
                weights[name] = part.reshape(*axes, *parameter.shape)
                first += parameter.numel()
        found, _ = split_weights(weights)
        own = [found[name].reshape(*axes, -1) for name in self._errors.parameters.names]
        return torch.cat([*own, theta[..., first:]], dim=-1)


def _without_past_outputs(record: NormalisedRecord, nu: int) -> NormalisedRecord:
    """The record of the system, from its predictor's."""
    own = record.record
    given = replace(own, u=own.u[:, :nu], inputs=own.inputs[:nu])
    return replace(record, u=record.u[:, :nu], record=given)
