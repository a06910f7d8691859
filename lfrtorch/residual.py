"""The one residual: simulated minus measured output of a model over its records."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from lfrtorch.checks import number
from lfrtorch.model import Model
from lfrtorch.records import Record, Start, as_records
from lfrtorch.sensitivity import output_jacobian
from lfrtorch.simulate import Trajectory


class Batch(NamedTuple):
    """Records of one length and start, normalised.

    Shape:
        u: (R, T, nu), y: (R, T, ny), scored: (R, T), True where a sample counts.
    """

    u: Tensor
    y: Tensor
    scored: Tensor
    start: Start

    def select(self, signal: Tensor) -> Tensor:
        """The scored samples of a signal (R, T, ...), records one after another."""
        whole = signal.flatten(0, 1)
        return whole if bool(self.scored.all()) else whole[self.scored.flatten()]


class SimulationError:
    """Residual, Jacobian and gradient of a model's mean squared simulation error.

    r = y_hat - y in normalised units, over all scored samples of all records, followed by
    √ridge (θ - θ_start). θ is the vector of all parameters of ``model.lfr`` that require a
    gradient; evaluating at θ writes it into the module.

    Args:
        model: the model whose parameters are θ; θ_start is what they are now.
        records: the data, of the model's channels and rate.
        ridge: weight of |θ - θ_start|² beside |y_hat - y|²: the noise variance over that of a
            prior on each parameter, both normalised.
    """

    def __init__(
        self, model: Model, records: Record | Sequence[Record], *, ridge: float = 0.0
    ) -> None:
        number("ridge", ridge)
        self.model = model
        data = as_records(records)
        for record in data:
            model.check(record)
        self.batches = _batches(model, data)
        self.size = sum(int(b.scored.sum()) for b in self.batches) * len(model.outputs)
        self._ridge, self._start = ridge, self.theta
        self._guesses: list[Tensor | None] = [None] * len(self.batches)
        self._latest: tuple[Tensor, list[Trajectory]] | None = None

    @property
    def theta(self) -> Tensor:
        """Parameters (P,) as they stand in the module."""
        return parameters_to_vector(self._parameters()).detach()

    def rmse(self, residual: Tensor) -> float:
        """Root mean squared error over samples and outputs of a residual, output unit."""
        errors = residual[: self.size].reshape(-1, len(self.model.outputs)).double().cpu().numpy()
        with np.errstate(over="ignore", invalid="ignore"):  # a diverging model scores inf or NaN
            return float(np.sqrt(np.mean((errors * self.model.scaler.y_scale) ** 2)))

    def write(self, theta: Tensor) -> None:
        """Put θ (P,) into the module."""
        vector_to_parameters(theta, self._parameters())

    def residual(self, theta: Tensor) -> Tensor:
        """r (M,); infinite or NaN where the model diverges."""
        pairs = zip(self.batches, self.trajectories(theta), strict=True)
        errors = [batch.select(t.y - batch.y).flatten() for batch, t in pairs]
        return torch.cat([*errors, *self._penalty(theta)])

    def jacobian(self, theta: Tensor) -> Tensor:
        """dr/dθ (M, P)."""
        trajectories = self.trajectories(theta)
        self.write(theta)  # the module may hold a trial that came after the trajectories
        self._guesses = [t.x[:, 0] for t in trajectories]
        P, penalty = len(theta), self._penalty(theta)
        J = theta.new_empty(self.size + sum(map(len, penalty)), P)
        if penalty:
            J[self.size :] = self._ridge**0.5 * torch.eye(P, dtype=J.dtype, device=J.device)
        first = 0
        for batch, trajectory in zip(self.batches, trajectories, strict=True):
            part = J[first : first + int(batch.scored.sum()) * len(self.model.outputs)]
            first += len(part)
            whole = part.numel() == batch.y.numel() * P  # nothing skipped: no copy
            rows = output_jacobian(
                self.model.lfr.cell,
                batch.u,
                trajectory,
                periodic=batch.start == "periodic",
                out=part.view(*batch.y.shape, P) if whole else None,
            )
            if not whole:
                part[:] = batch.select(rows).flatten(0, 1)
        return J

    def gradient(self, theta: Tensor) -> tuple[Tensor, Tensor]:
        """r (M,) and the gradient (P,) of |r|² / samples, by the adjoint recurrence."""
        self.write(theta)
        errors = []
        for i, batch in enumerate(self.batches):
            y_hat = self.model.lfr(batch.u, self._guesses[i], batch.start)
            errors.append(batch.select(y_hat - batch.y).flatten())
        r = torch.cat(errors)
        gradients = torch.autograd.grad(r.square().sum() / self.size, self._parameters())
        gradient = parameters_to_vector(gradients)
        gradient = gradient + 2.0 * self._ridge / self.size * (theta - self._start)
        return torch.cat([r.detach(), *self._penalty(theta)]), gradient

    def _penalty(self, theta: Tensor) -> list[Tensor]:
        return [self._ridge**0.5 * (theta - self._start)] if self._ridge else []

    def _parameters(self) -> list[torch.nn.Parameter]:
        return [p for p in self.model.lfr.parameters() if p.requires_grad]

    def trajectories(self, theta: Tensor) -> list[Trajectory]:
        """Trajectories at θ, those of the latest θ kept; periodic ones start from a good guess."""
        if self._latest is None or self._latest[0] is not theta:
            self.write(theta)
            trajectories = [
                self.model.lfr.trajectory(batch.u, guess, batch.start)
                for batch, guess in zip(self.batches, self._guesses, strict=True)
            ]
            self._latest = theta, trajectories
        return self._latest[1]


def _batches(model: Model, records: list[Record]) -> list[Batch]:
    like = model.lfr.cell.A
    groups: dict[tuple[int, Start], list[Record]] = defaultdict(list)
    for record in records:
        groups[record.samples, record.start].append(record)
    batches = []
    for (T, start), group in groups.items():
        u = np.stack([model.scaler.normalise_u(record.u) for record in group])
        y = np.stack([model.scaler.normalise_y(record.y) for record in group])
        skip = torch.tensor([record.skip for record in group], device=like.device)
        scored = torch.arange(T, device=like.device) >= skip.unsqueeze(1)
        batches.append(Batch(torch.tensor(u).to(like), torch.tensor(y).to(like), scored, start))
    return batches
