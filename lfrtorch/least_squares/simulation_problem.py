"""The one residual: simulated minus measured output of a model over its records."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from lfrtorch._checks import number
from lfrtorch._errors import InputError
from lfrtorch.distributed import Ranks
from lfrtorch.engine.initial_state import simulate_estimated
from lfrtorch.engine.sensitivity import Linearisation
from lfrtorch.engine.simulation import Trajectory, is_compiled
from lfrtorch.least_squares.gauge import Reduction, everything, reduction
from lfrtorch.least_squares.jacobian import Jacobian, Memory, Part
from lfrtorch.least_squares.record_groups import group_records
from lfrtorch.model import Model
from lfrtorch.records import Record, as_records

Ridge = float | Mapping[str, float]


class SimulationProblem:
    """Residual, slope and gradient of a model's mean squared simulation error.

    r = weighted y_hat - y in normalised units, over all samples of all records (0 where a sample
    does not count), followed by √ridge (θ - θ_0). θ is the vector of all parameters of
    ``model.lfr`` that require a gradient, then the initial state of each record whose start is
    ``"estimated"``; the module holds the θ that was evaluated or written last.

    Args:
        model: the model whose parameters are θ; θ_0 is what they are now.
        records: the data, of the model's channels and rate.
        ridge: weight of |θ - θ_0|² beside |y_hat - y|²: the noise variance over that of a
            prior on each parameter, both normalised. One number, or one for each group of
            parameters by the beginning of their names: ``{"static": 1e-3, "A": 1e-2, "x0": 0}``;
            those without get none.
        solve_initial_states: estimated initial states are no part of θ, but solved for at every θ.
        ranks: the processes that share the records; θ, cost and gradient are the same on all, a
            residual is each one's own.

    Raises:
        ValueError: records that are not the model's, fewer records than processes, a negative ridge
            or an unknown group.
    """

    def __init__(
        self,
        model: Model,
        records: Record | Sequence[Record],
        *,
        ridge: Ridge = 0.0,
        solve_initial_states: bool = False,
        ranks: Ranks | None = None,
    ) -> None:
        self.model, self.ranks = model, Ranks() if ranks is None else ranks
        self._parameters = [p for p in model.lfr.parameters() if p.requires_grad]
        data = as_records(records)
        estimated = any(record.start == "estimated" for record in data)
        if not self._parameters and not estimated and not solve_initial_states:
            raise InputError("all parameters of the model are frozen; there is nothing to fit.")
        for record in data:
            model.check(record)
        if len(data) < self.ranks.world:
            raise InputError(
                f"{self.ranks.world} processes share {len(data)} record(s); each needs one: start "
                "fewer processes, or cut the data into more records."
            )
        self.groups = group_records(model, data, self.ranks)
        self.size = sum(record.samples - record.skip for record in data) * len(model.outputs)
        self._solved = solve_initial_states
        self._initial_states = self._first_initial_states(
            sum(record.start == "estimated" for record in data)
        )
        self._theta_0 = self.theta
        self._ridge = self._ridge_of(ridge)
        self.fixed: Tensor | None = None
        """Which entries of the module's free parameters stay as they are: columns of zeros in J."""
        self._reduced: Reduction | None = None
        self._memory = Memory()
        self.guesses: list[Tensor | None] = [None] * len(self.groups)
        """States of each group near those to come."""
        self._latest: tuple[Tensor, list[Trajectory]] | None = None

    @property
    def theta(self) -> Tensor:
        """Parameters (P,) as they stand in the module, then the estimated initial states."""
        own = [p.detach().flatten() for p in self._parameters]
        return torch.cat([*own, self._initial_states.flatten()])

    def initial_states(self, theta: Tensor) -> Tensor:
        """The estimated initial states (records, nx) in θ."""
        return theta[len(theta) - self._initial_states.numel() :].view(self._initial_states.shape)

    def rmse(self, theta: Tensor) -> float:
        """Root mean squared error at θ over scored samples and outputs, output unit, unweighted."""
        total = torch.zeros((), dtype=torch.float64, device=self._theta_0.device)
        scale = torch.as_tensor(self.model.scaler.y_scale).to(self._theta_0)
        for group, trajectory in zip(self.groups, self.trajectories(theta), strict=True):
            errors = (trajectory.y - group.y) * scale * group.scored.unsqueeze(-1)
            total = total + errors.double().square().sum()
        return math.sqrt(self.ranks.sum(total) / self.size)

    def write(self, theta: Tensor) -> None:
        """Put θ (P,) into the module."""
        theta = theta.detach().to(
            self._initial_states, copy=True
        )  # the module's weights are its own
        sizes = [p.numel() for p in self._parameters]
        *own, starts = theta.split([*sizes, self._initial_states.numel()])
        for parameter, part in zip(self._parameters, own, strict=True):
            parameter.data = part.view(parameter.shape)
        self._initial_states = starts.view(self._initial_states.shape)

    def cost(self, residual: Tensor) -> float:
        """|r|² of all processes."""
        return float(self.ranks.sum(residual.square().sum()))

    def residual(self, theta: Tensor) -> Tensor:
        """r (M,); infinite or NaN where the model diverges."""
        pairs = zip(self.groups, self.trajectories(theta), strict=True)
        errors = [group.weigh(t.y - group.y).flatten() for group, t in pairs]
        if self._ridge.any() and self.ranks.rank == 0:
            errors.append(self._ridge.sqrt() * (theta - self._theta_0))
        return torch.cat(errors)

    def linearise(self, theta: Tensor, *, reduce: bool = True) -> Jacobian:
        """dr/dθ at θ, held as a whole only where it is small.

        Args:
            theta: θ (P,).
            reduce: leave the columns of gauge directions out of its rows.
        """
        trajectories = self.trajectories(theta)
        self.write(theta)  # the module may hold a trial that came after the trajectories
        self.guesses = [t.x for t in trajectories]
        cell = self.model.lfr.cell
        parts, P = [], len(theta) - self._initial_states.numel()
        for group, trajectory in zip(self.groups, trajectories, strict=True):
            x0 = group.estimated if self._initial_states.numel() else None
            if x0 is not None:
                x0 = P + cell.nx * x0.unsqueeze(1) + torch.arange(cell.nx)
            periodic = group.start == "periodic"
            linearisation = Linearisation(cell, group.u, trajectory, periodic=periodic)
            parts.append(Part(group, linearisation, x0, self._memory))
        fixed = None
        if self.fixed is not None:
            fixed = torch.zeros_like(theta, dtype=torch.bool)
            fixed[: len(self.fixed)] = self.fixed.to(fixed)
        if reduce:
            held = any(group.x0 is not None for group in self.groups)
            held = bool(self.ranks.sum(self._theta_0.new_tensor(float(held))))
            reduced = reduction(
                cell,
                self._initial_states,
                coordinates=not held,
                before=self._reduced,
                fixed=self.fixed,
            )
            # A tie between columns is broken by rounding errors, on each process by its own.
            reduced = self._reduced = Reduction(*map(self.ranks.first, reduced))
        else:
            reduced = everything(theta)
        penalty = theta - self._theta_0
        return Jacobian(parts, reduced, self._ridge.sqrt(), penalty, self.ranks, fixed)

    def jacobian(self, theta: Tensor) -> Tensor:
        """dr/dθ (M, P) as a whole: for a look at it, and for small problems."""
        return SimulationProblem.linearise(self, theta).whole()

    def gradient(self, theta: Tensor) -> tuple[Tensor, Tensor]:
        """r (M,) and the gradient (P,) of |r|² / samples, by the adjoint recurrence."""
        r = self.residual(theta)
        return r, 2.0 / self.size * self.linearise(theta, reduce=False).adjoint(r)

    def trajectories(self, theta: Tensor) -> list[Trajectory]:
        """Trajectories at θ, those of the latest θ kept; periodic ones start from a good guess."""
        if self._latest is None or not torch.equal(self._latest[0], theta):
            self.write(theta)
            self._latest = theta.clone(), [self._trajectory(i) for i in range(len(self.groups))]
        return self._latest[1]

    def remember(self, theta: Tensor, trajectories: list[Trajectory]) -> None:
        """Take trajectories at θ, one a group, from elsewhere."""
        self._latest = theta.clone(), trajectories

    def release(self) -> None:
        """Let go of what would only speed up the next evaluation."""
        self._latest, self._memory = None, Memory()

    def state_dict(self) -> dict[str, Tensor]:
        """What the next evaluations depend on beside θ, the last bit of them included."""
        tensors = {"start": self._theta_0}
        cell = self.model.lfr.cell
        for i, (group, guess) in enumerate(zip(self.groups, self.guesses, strict=True)):
            if guess is not None:  # of machine code the initial state of a period is of use alone
                tensors[f"guess.{i}"] = guess[:, :1] if is_compiled(cell, group.u) else guess
        if self._reduced is not None:
            tensors["kept"] = self._reduced.kept
        return tensors

    def load_state_dict(self, tensors: Mapping[str, Tensor]) -> None:
        """Take over what the same problem had.

        Raises:
            ValueError: it is of another problem.
        """
        start = tensors["start"]
        if start.shape != self._theta_0.shape or not torch.allclose(
            start, self._theta_0, 1e-6, 1e-6
        ):
            raise InputError(
                "the fit that is to go on began elsewhere: the data, the settings or the package "
                "have changed since. Start a new one, from its best model: init_from=DIR."
            )
        self._theta_0 = start
        self.guesses = [tensors.get(f"guess.{i}") for i in range(len(self.groups))]
        if "kept" in tensors:
            kept = tensors["kept"]
            self._reduced = Reduction(kept, start.new_zeros(0, len(start)))
        self._latest = None

    def initial_state(self, i: int) -> Tensor | None:
        """Initial state (R, nx) of a group where it is given or a parameter."""
        group = self.groups[i]
        if group.estimated is None:
            return group.x0
        if self._solved:
            assert group.start_weight is not None
            cell = self.model.lfr.cell
            return simulate_estimated(cell, group.u, group.y, group.start_weight).x[:, 0]
        return self._initial_states[group.estimated]

    def _trajectory(self, i: int) -> Trajectory:
        group, lfr = self.groups[i], self.model.lfr
        start = "periodic" if group.start == "periodic" else "zero"
        return lfr.trajectory(group.u, self.initial_state(i), start, guess=self.guesses[i])

    def _first_initial_states(self, count: int) -> Tensor:
        """Initial states (count, nx) of the records where they are parameters."""
        cell = self.model.lfr.cell
        starts = cell.A.new_zeros(0 if self._solved else count, cell.nx)
        for group in self.groups if len(starts) else ():
            if group.estimated is not None:
                found = simulate_estimated(cell, group.u, group.y, group.weight)
                starts[group.estimated] = found.x[:, 0]
        return self.ranks.sum(starts)

    def _ridge_of(self, ridge: Ridge) -> Tensor:
        """The weight of every entry of θ."""
        groups = ridge if isinstance(ridge, Mapping) else {"": ridge}
        names = [n for n, p in self.model.lfr.cell.named_parameters() if p.requires_grad]
        sizes = [p.numel() for p in self._parameters]
        if self._initial_states.numel():
            names.append("x0")
            sizes.append(self._initial_states.numel())
        weights = [0.0] * len(names)
        for group, value in groups.items():
            number(f"ridge of '{group}'" if group else "ridge", value)
            own = [i for i, name in enumerate(names) if _belongs(name, group)]
            if not own:
                raise InputError(
                    f"ridge has a group '{group}', and no parameter's name begins so; "
                    f"the parameters are {', '.join(dict.fromkeys(names))}."
                )
            for i in own:
                weights[i] = float(value)
        every = torch.tensor(weights, dtype=torch.float64).repeat_interleave(torch.tensor(sizes))
        return every.to(self._theta_0)


def _belongs(name: str, group: str) -> bool:
    return not group or name == group or name.startswith(f"{group}.")
