"""The one residual: simulated minus measured output of a model over its records."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from lfrtorch.batch import batches_of
from lfrtorch.checks import number
from lfrtorch.gauge import reduction
from lfrtorch.jacobian import Jacobian, Part
from lfrtorch.model import Model
from lfrtorch.records import Record, as_records
from lfrtorch.sensitivity import Linearisation
from lfrtorch.simulate import Trajectory, estimated_start

Ridge = float | Mapping[str, float]


class SimulationError:
    """Residual, slope and gradient of a model's mean squared simulation error.

    r = weighted y_hat - y in normalised units, over all samples of all records (0 where a sample
    does not count), followed by √ridge (θ - θ_start). θ is the vector of all parameters of
    ``model.lfr`` that require a gradient, then the start state of each record whose start is
    ``"estimated"``; evaluating at θ writes it into the module.

    Args:
        model: the model whose parameters are θ; θ_start is what they are now.
        records: the data, of the model's channels and rate.
        ridge: weight of |θ - θ_start|² beside |y_hat - y|²: the noise variance over that of a
            prior on each parameter, both normalised. One number, or one for each group of
            parameters by the beginning of their names: ``{"static": 1e-3, "A": 1e-2, "x0": 0}``;
            those without get none.
        solved_starts: estimated start states are no part of θ, but solved for at every θ.

    Raises:
        ValueError: records that are not the model's, a negative ridge or an unknown group.
    """

    def __init__(
        self,
        model: Model,
        records: Record | Sequence[Record],
        *,
        ridge: Ridge = 0.0,
        solved_starts: bool = False,
    ) -> None:
        self.model = model
        self._parameters = [p for p in model.lfr.parameters() if p.requires_grad]
        data = as_records(records)
        for record in data:
            model.check(record)
        self.batches = batches_of(model, data)
        self.size = sum(record.samples - record.skip for record in data) * len(model.outputs)
        self._solved = solved_starts
        self._starts = self._first_starts()
        self._start = self.theta
        self._ridge = self._ridge_of(ridge)
        self._guesses: list[Tensor | None] = [None] * len(self.batches)
        self._latest: tuple[Tensor, list[Trajectory]] | None = None

    @property
    def theta(self) -> Tensor:
        """Parameters (P,) as they stand in the module, then the estimated start states."""
        starts = [x0.flatten() for x0 in self._starts.values()]
        return torch.cat([parameters_to_vector(self._parameters).detach(), *starts])

    def rmse(self, theta: Tensor) -> float:
        """Root mean squared error at θ over scored samples and outputs, output unit, unweighted."""
        total, scale = 0.0, torch.as_tensor(self.model.scaler.y_scale).to(self._start)
        for batch, trajectory in zip(self.batches, self.trajectories(theta), strict=True):
            errors = (trajectory.y - batch.y) * scale
            if not batch.spectral:
                errors = errors * (batch.weight != 0)
            total += float(errors.double().square().sum())
        return float(np.sqrt(total / self.size))

    def write(self, theta: Tensor) -> None:
        """Put θ (P,) into the module."""
        sizes = [x0.numel() for x0 in self._starts.values()]
        own, *starts = theta.split([len(theta) - sum(sizes), *sizes])
        vector_to_parameters(own, self._parameters)
        for (i, x0), start in zip(self._starts.items(), starts, strict=True):
            self._starts[i] = start.reshape(x0.shape)

    def cost(self, residual: Tensor) -> float:
        """|r|²."""
        return float(residual.square().sum())

    def residual(self, theta: Tensor) -> Tensor:
        """r (M,); infinite or NaN where the model diverges."""
        pairs = zip(self.batches, self.trajectories(theta), strict=True)
        errors = [batch.weigh(t.y - batch.y).flatten() for batch, t in pairs]
        return torch.cat([*errors, *self._penalty(theta)])

    def linearise(self, theta: Tensor) -> Jacobian:
        """dr/dθ at θ, held as a whole only where it is small."""
        trajectories = self.trajectories(theta)
        self.write(theta)  # the module may hold a trial that came after the trajectories
        self._guesses = [t.x for t in trajectories]
        cell = self.model.lfr.cell
        parts, first = [], sum(p.numel() for p in self._parameters)
        for i, (batch, trajectory) in enumerate(zip(self.batches, trajectories, strict=True)):
            x0 = slice(first, first + self._starts[i].numel()) if i in self._starts else None
            first = first if x0 is None else x0.stop
            periodic = batch.start == "periodic"
            linearisation = Linearisation(cell, batch.u, trajectory, periodic=periodic)
            parts.append(Part(batch, linearisation, x0))
        start = torch.cat([cell.A.new_zeros(0, cell.nx), *self._starts.values()])
        held = any(batch.x0 is not None for batch in self.batches)
        reduced = reduction(cell, start, coordinates=not held)
        return Jacobian(parts, reduced, self._ridge.sqrt(), *self._penalty(theta))

    def jacobian(self, theta: Tensor) -> Tensor:
        """dr/dθ (M, P) as a whole: for a look at it, and for small problems."""
        return SimulationError.linearise(self, theta).whole()

    def gradient(self, theta: Tensor) -> tuple[Tensor, Tensor]:
        """r (M,) and the gradient (P,) of |r|² / samples, by the adjoint recurrence."""
        r = self.residual(theta)
        return r, 2.0 / self.size * self.linearise(theta).adjoint(r)

    def trajectories(self, theta: Tensor) -> list[Trajectory]:
        """Trajectories at θ, those of the latest θ kept; periodic ones start from a good guess."""
        if self._latest is None or self._latest[0] is not theta:
            self.write(theta)
            self._latest = theta, [self._trajectory(i) for i in range(len(self.batches))]
        return self._latest[1]

    def _trajectory(self, i: int) -> Trajectory:
        batch, cell = self.batches[i], self.model.lfr.cell
        guess, lfr = self._guesses[i], self.model.lfr
        if batch.start == "estimated" and self._solved:
            return estimated_start(cell, batch.u, batch.y, batch.weight)
        start = "periodic" if batch.start == "periodic" else "zero"
        return lfr.trajectory(batch.u, self._starts.get(i, batch.x0), start, guess=guess)

    def _first_starts(self) -> dict[int, Tensor]:
        """Start states by the number of their batch, where they are parameters."""
        if self._solved:
            return {}
        cell = self.model.lfr.cell
        return {
            i: estimated_start(cell, batch.u, batch.y, batch.weight).x[:, 0].clone()
            for i, batch in enumerate(self.batches)
            if batch.start == "estimated"
        }

    def _penalty(self, theta: Tensor) -> list[Tensor]:
        return [self._ridge.sqrt() * (theta - self._start)] if self._ridge.any() else []

    def _ridge_of(self, ridge: Ridge) -> Tensor:
        """The weight of every entry of θ."""
        groups = ridge if isinstance(ridge, Mapping) else {"": ridge}
        names = [n for n, p in self.model.lfr.cell.named_parameters() if p.requires_grad]
        sizes = [p.numel() for p in self._parameters]
        names += ["x0"] * len(self._starts)
        sizes += [x0.numel() for x0 in self._starts.values()]
        weights = [0.0] * len(names)
        for group, value in groups.items():
            number(f"ridge of '{group}'" if group else "ridge", value)
            own = [i for i, name in enumerate(names) if _belongs(name, group)]
            if not own:
                raise ValueError(
                    f"ridge has a group '{group}', and no parameter's name begins so; "
                    f"the parameters are {', '.join(dict.fromkeys(names))}."
                )
            for i in own:
                weights[i] = float(value)
        return torch.tensor(weights).to(self._start).repeat_interleave(torch.tensor(sizes))


def _belongs(name: str, group: str) -> bool:
    return not group or name == group or name.startswith(f"{group}.")
