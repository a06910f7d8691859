"""The one residual: simulated minus measured output of a model over its records."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Self

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lfrtorch._support.checks import number
from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array
from lfrtorch.distributed import Ranks
from lfrtorch.engine.initial_state import estimated_start, start_from_beginning
from lfrtorch.engine.lfr import LFR
from lfrtorch.engine.sensitivity import Linearisation
from lfrtorch.engine.simulation import Trajectory, is_compiled
from lfrtorch.least_squares.exact_integrators import fixed_parameters
from lfrtorch.least_squares.fit_memory import check_fit_memory
from lfrtorch.least_squares.gauge import Reduction, everything, reduction
from lfrtorch.least_squares.guarantee import Name, guarantee_of
from lfrtorch.least_squares.jacobian import Jacobian, Memory, Part
from lfrtorch.least_squares.levenberg_marquardt import LeastSquares
from lfrtorch.least_squares.record_groups import group_records
from lfrtorch.model import Model
from lfrtorch.records import NormalisedRecord, Record, as_records

LARGEST_RIDGE = 1e100
"""Its square is still a number; 1 holds parameters where they are already."""

Ridge = float | Mapping[str, float]


class SimulationProblem(LeastSquares):
    """Residual, Jacobian and gradient of a model's squared simulation error.

    r = weighted y_hat - y in normalised units, over all samples of all records (0 if a sample does
    not count), followed by √ridge (θ - θ_0). θ is the vector of all parameters of ``model.lfr``
    that require a gradient, then the initial state of each record whose start is ``"estimated"``.
    The LFR holds the θ that was evaluated or written last.

    Args:
        lfr: the LFR whose parameters are θ; θ_0 is what they are now.
        records: the data.
        y_scale: (ny,), from normalised to physical outputs, for ``rmse``.
        ridge: weight of |θ - θ_0|²; that of |y_hat - y|² is 1. As a prior on each parameter: noise
            variance over prior variance, both normalised. One number, or one for each group of
            parameters by the beginning of their names: ``{"static": 1e-3, "A": 1e-2, "x0": 0}``;
            other groups get 0.
        guarantee: what every model on the way of a search keeps: ``"stable"`` or
            ``"contracting"``, see ``lfrtorch.least_squares.guarantee``. Default: nothing.
        longest: samples of the longest record before they were cut into windows, which
            ``"stable"`` goes by. Default: of these records.
        solve_initial_states: estimated initial states are no part of θ, but solved for at every θ,
            and outputs end at the limits of a record, as in a score.
        ranks: the processes that share the records. All have the same θ, cost and gradient; each
            has the residual of its own records.

    Raises:
        ValueError: records that are not the model's, fewer records than processes, a negative ridge
            or an unknown group.
    """

    def __init__(
        self,
        lfr: LFR,
        records: Sequence[NormalisedRecord],
        y_scale: Array | float = 1.0,
        *,
        ridge: Ridge = 0.0,
        guarantee: Name | None = None,
        longest: int | None = None,
        solve_initial_states: bool = False,
        ranks: Ranks | None = None,
    ) -> None:
        self.lfr, self.ranks = lfr, Ranks() if ranks is None else ranks
        self._parameters = [p for p in lfr.parameters() if p.requires_grad]
        self._y_scale = y_scale
        data = [each.record for each in records]
        estimated = any(record.start == "estimated" for record in data)
        if not self._parameters and not estimated and not solve_initial_states:
            raise InputError("all parameters of the model are frozen; there is nothing to fit.")
        if len(data) < self.ranks.world:
            raise InputError(
                f"{self.ranks.world} processes share {len(data)} record(s); each needs one: start "
                "fewer processes, or cut the data into more records."
            )
        self.groups = group_records(records, lfr.cell.A, self.ranks)
        self.size = sum(int(record.scored.sum()) for record in data)
        self._solved = solve_initial_states
        self._initial_states = self._first_initial_states(
            sum(record.start == "estimated" for record in data)
        )
        self._theta_0 = self.theta
        self._ridge = self._ridge_of(ridge)
        self.fixed: Bool[Tensor, " free"] | None = fixed_parameters(lfr.cell)
        """Which entries of the module's free parameters are constants: columns of zeros in J."""
        samples = longest or max((record.samples for record in data), default=1)
        self._guarantee = guarantee_of(guarantee, lfr.cell, samples, self.ranks)
        self._reduced: Reduction | None = None
        self._memory = Memory()
        self.guesses: list[Tensor | None] = [None] * len(self.groups)
        """States of each group at a θ close to the next one."""
        # A search evaluates r at a θ and, if it accepts it, J there: one simulation serves both.
        self._latest: tuple[Tensor, list[Trajectory]] | None = None

    @classmethod
    def of(cls, model: Model, records: Record | Sequence[Record], **options: Any) -> Self:
        """The problem of a model and records of its channels and rate, in physical units."""
        data = as_records(records)
        for record in data:
            model.check(record)
        normalised = [model.scaler.normalise(record) for record in data]
        return cls(model.lfr, normalised, model.scaler.y_scale, **options)

    @classmethod
    def judge(cls, model: Model, records: Record | Sequence[Record], **options: Any) -> Self:
        """The same for records that are not fitted, each from its most probable initial state."""
        return cls.of(model, records, solve_initial_states=True, **options)

    @property
    def theta(self) -> Float[Tensor, " P"]:
        """Parameters as they stand in the module, then the estimated initial states."""
        own = [p.detach().flatten() for p in self._parameters]
        return torch.cat([*own, self._initial_states.flatten()])

    def initial_states(self, theta: Float[Tensor, " P"]) -> Float[Tensor, "estimated nx"]:
        """The estimated initial states in θ."""
        return theta[len(theta) - self._initial_states.numel() :].view(self._initial_states.shape)

    def rmse(self, theta: Float[Tensor, " P"]) -> float:
        """RMSE at θ over scored samples and outputs, unweighted, in output units, as in a score."""
        total = torch.zeros((), dtype=torch.float64, device=self._theta_0.device)
        scale = torch.as_tensor(self._y_scale).to(self._theta_0)
        for group, trajectory in zip(self.groups, self.trajectories(theta), strict=True):
            errors = (group.shown(trajectory.y) - group.y) * scale * group.scored
            total = total + errors.double().square().sum()
        return math.sqrt(self.ranks.sum(total) / self.size)

    def write(self, theta: Float[Tensor, " P"]) -> None:
        """Put θ into the module."""
        theta = theta.detach().to(
            self._initial_states, copy=True
        )  # the module's weights are its own
        sizes = [p.numel() for p in self._parameters]
        *own, states = theta.split([*sizes, self._initial_states.numel()])
        for parameter, part in zip(self._parameters, own, strict=True):
            parameter.data = part.view(parameter.shape)
        self._initial_states = states.view(self._initial_states.shape)

    def cost(self, residual: Float[Tensor, " M"]) -> float:
        """|r|² of all processes."""
        return float(self.ranks.sum(residual.square().sum()))

    def residual(self, theta: Float[Tensor, " P"]) -> Float[Tensor, " M"]:
        """r at θ; infinite or NaN if the model diverges."""
        errors = []
        for group, trajectory in zip(self.groups, self.trajectories(theta), strict=True):
            y_hat = group.shown(trajectory.y) if self._solved else trajectory.y
            errors.append(group.counted(y_hat).weigh(y_hat - group.y).flatten())
        if self._ridge.any() and self.ranks.rank == 0:
            errors.append(self._ridge.sqrt() * (theta - self._theta_0))
        return torch.cat(errors)

    def admissible(self, theta: Float[Tensor, " P"]) -> Float[Tensor, " P"]:
        """θ, or one near it that keeps the guarantee."""
        if self._guarantee is None:
            return theta
        return self.ranks.first(self._guarantee.admissible(theta))

    def linearise(
        self, theta: Float[Tensor, " P"], *, reduce: bool = True, eliminate: bool = True
    ) -> Jacobian:
        """dr/dθ at θ.

        Args:
            theta: θ.
            reduce: whether columns that gauge directions make dependent are left out of the rows.
            eliminate: whether initial states are eliminated if they outnumber the parameters; a
                system without damping, or its factor, needs them all.
        """
        states = self._initial_states.numel()
        parts, P = [], len(theta) - states
        eliminate = eliminate and states > P and self.ranks.world == 1
        spectral = sum(group.y.numel() for group in self.groups if group.spectral)
        check_fit_memory(self.lfr.cell, 0 if eliminate else states, spectral)
        trajectories = self.trajectories(theta)
        self.write(theta)  # the module may hold a trial that came after the trajectories
        self.guesses = [t.x for t in trajectories]
        cell = self.lfr.cell
        for group, trajectory in zip(self.groups, trajectories, strict=True):
            x0 = group.estimated if states else None
            if x0 is not None:
                x0 = P + cell.nx * x0.unsqueeze(1) + torch.arange(cell.nx)
            periodic = group.start == "periodic"
            linearisation = Linearisation(cell, group.u, trajectory, periodic=periodic)
            counted = group.counted(trajectory.y)
            parts.append(Part(counted, linearisation, x0, self._memory, eliminate=eliminate))
        fixed = None
        if self.fixed is not None:
            fixed = torch.zeros_like(theta, dtype=torch.bool)
            fixed[: len(self.fixed)] = self.fixed.to(fixed)
        if eliminate:
            reduced = everything(theta[:P])
        elif reduce:
            held = any(group.x0 is not None for group in self.groups)
            held = bool(self.ranks.sum(self._theta_0.new_tensor(float(held))))
            reduced = reduction(
                cell,
                self._initial_states,
                coordinates=not held,
                before=self._reduced,
                fixed=self.fixed,
            )
            # Rounding errors decide between columns that are as good; processes must agree.
            reduced = self._reduced = Reduction(*map(self.ranks.first, reduced))
        else:
            reduced = everything(theta)
        penalty, ridge = theta - self._theta_0, self._ridge.sqrt()
        if self._guarantee is None:
            return Jacobian(parts, reduced, ridge, penalty, self.ranks, fixed)
        bounded = self._guarantee.bounded(theta)
        return Jacobian(parts, reduced, ridge, penalty, self.ranks, fixed, bounded)

    def jacobian(self, theta: Float[Tensor, " P"]) -> Float[Tensor, "M P"]:
        """dr/dθ as one matrix, for small problems."""
        return SimulationProblem.linearise(self, theta).whole()

    def gradient(
        self, theta: Float[Tensor, " P"]
    ) -> tuple[Float[Tensor, " M"], Float[Tensor, " P"]]:
        """r and the gradient of |r|² / samples, by the adjoint recurrence."""
        r = self.residual(theta)
        return r, 2.0 / self.size * self.linearise(theta, reduce=False).adjoint(r)

    def trajectories(self, theta: Float[Tensor, " P"]) -> list[Trajectory]:
        """Trajectories of each group at θ; those of the latest θ are cached."""
        if self._latest is None or not torch.equal(self._latest[0], theta):
            self.write(theta)
            self._latest = None  # free its memory first
            self._latest = theta.clone(), [self._trajectory(i) for i in range(len(self.groups))]
        return self._latest[1]

    def remember(self, theta: Float[Tensor, " P"], trajectories: list[Trajectory]) -> None:
        """Cache trajectories at θ, one for each group, that someone else has simulated."""
        self._latest = theta.clone(), trajectories

    def release(self) -> None:
        """Free the memory of what only speeds up the next evaluation."""
        self._latest, self._memory = None, Memory()

    def state_dict(self) -> dict[str, Tensor]:
        """What the next evaluations depend on in addition to θ, to the last bit."""
        tensors = {"start": self._theta_0}
        cell = self.lfr.cell
        for i, (group, guess) in enumerate(zip(self.groups, self.guesses, strict=True)):
            if guess is not None:  # machine code needs the initial state of a period alone
                tensors[f"guess.{i}"] = guess[:, :1] if is_compiled(cell, group.u) else guess
        if self._reduced is not None:
            tensors["kept"] = self._reduced.kept
        return tensors

    def load_state_dict(self, tensors: Mapping[str, Tensor]) -> None:
        """Take over what the same problem had.

        Raises:
            ValueError: it is of another problem.
        """
        theta_0 = tensors["start"]
        if theta_0.shape != self._theta_0.shape or not torch.allclose(
            theta_0, self._theta_0, 1e-6, 1e-6
        ):
            raise InputError(
                "the fit that is to go on began elsewhere: the data, the settings or the package "
                "have changed since. Start a new one, from its best model: init_from=DIR."
            )
        self._theta_0 = theta_0
        self.guesses = [tensors.get(f"guess.{i}") for i in range(len(self.groups))]
        if "kept" in tensors:
            kept = tensors["kept"]
            self._reduced = Reduction(kept, theta_0.new_zeros(0, len(theta_0)))
        self._latest = None

    def initial_state(self, i: int) -> Float[Tensor, "R nx"] | None:
        """Initial states of group i, unless they are zero or periodic."""
        group = self.groups[i]
        if group.estimated is None:
            return group.x0
        if self._solved:
            assert group.start_weight is not None
            cell = self.lfr.cell
            return estimated_start(cell, group.u, group.y, group.start_weight)
        return self._initial_states[group.estimated]

    def _trajectory(self, i: int) -> Trajectory:
        group, lfr = self.groups[i], self.lfr
        start = "periodic" if group.start == "periodic" else "zero"  # from x0
        return lfr.trajectory(group.u, self.initial_state(i), start, guess=self.guesses[i])

    def _first_initial_states(self, count: int) -> Float[Tensor, "estimated nx"]:
        """First values of the initial states that are parameters."""
        cell = self.lfr.cell
        states = cell.A.new_zeros(0 if self._solved else count, cell.nx)
        for group in self.groups if len(states) else ():
            if group.estimated is not None:
                weight = group.weight
                if group.beyond is not None:
                    weight = weight * (group.beyond == 0)
                states[group.estimated] = start_from_beginning(cell, group.u, group.y, weight)
        return self.ranks.sum(states)

    def _ridge_of(self, ridge: Ridge) -> Float[Tensor, " P"]:
        """The weight of every entry of θ."""
        groups = ridge if isinstance(ridge, Mapping) else {"": ridge}
        names = [n for n, p in self.lfr.cell.named_parameters() if p.requires_grad]
        sizes = [p.numel() for p in self._parameters]
        if self._initial_states.numel():
            names.append("x0")
            sizes.append(self._initial_states.numel())
        weights = [0.0] * len(names)
        for group, value in groups.items():
            name = f"ridge of '{group}'" if group else "ridge"
            number(name, value)
            if value > LARGEST_RIDGE:
                raise InputError(f"{name} is {value}; give {LARGEST_RIDGE} at most.")
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
