"""Errors of predictions and of simulations of one model together, weighted.

Predictions lean on the measured outputs: a model that predicts well may simulate badly, or run
away. The parameters θ are those of the one-step predictor (``lfrtorch.engine.innovation``). Those
of the system itself follow from them, φ(θ), so the rows of both errors are J_p and w J_s dφ/dθ.
An estimated initial state is one parameter for both: before the first sample the predictor's state
is the system's.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from lfrtorch._support.types import Array
from lfrtorch.engine.innovation import split_predictor, split_weights
from lfrtorch.engine.lfr import LFR
from lfrtorch.least_squares.jacobian import Jacobian
from lfrtorch.least_squares.linear_systems import BroadcastSystem, SVDSystem, System
from lfrtorch.least_squares.simulation_problem import SimulationProblem
from lfrtorch.records import NormalisedRecord


class PredictionProblem(SimulationProblem):
    """Errors of a predictor's records and, weighted, those of the system's simulation of them.

    Args:
        lfr, records, y_scale, options: of the predictor, see ``SimulationProblem``.
        simulation: weight w of the simulation errors if those of predictions were as large at the
            start.
        weight: w itself, if it is known.
    """

    def __init__(
        self,
        lfr: LFR,
        records: Sequence[NormalisedRecord],
        y_scale: Array | float = 1.0,
        *,
        simulation: float = 1.0,
        weight: float | None = None,
        **options: Any,
    ) -> None:
        super().__init__(lfr, records, y_scale, **options)
        system, _ = split_predictor(lfr.cell)
        driven = [without_past_outputs(record, system.nu) for record in records]
        self._simulated = SimulationProblem(
            LFR(system), driven, y_scale, solve_initial_states=self._solved, ranks=self.ranks
        )
        self.weight = 1.0
        if weight is None:
            r = self.residual(self.theta)
            own = r[: len(r) - self._simulations]
            costs = self.cost(own), self.cost(r[len(own) :])
            weight = simulation * math.sqrt(costs[0] / costs[1]) if costs[1] > 0 else 0.0
        self.weight = weight if math.isfinite(weight) else 0.0

    @property
    def _simulations(self) -> int:
        """Number of errors of the simulation."""
        return sum(group.y.numel() for group in self._simulated.groups)

    def residual(self, theta: Float[Tensor, " P"]) -> Float[Tensor, " M"]:
        """r at θ: of the predictions, and w times those of the simulations."""
        simulated = self._simulated.residual(self._system_theta(theta))
        return torch.cat([super().residual(theta), self.weight * simulated])

    def linearise(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, theta: Float[Tensor, " P"], *, reduce: bool = True
    ) -> _Both:
        """dr/dθ at θ."""
        steps = torch.eye(len(theta)).to(theta)
        # φ is quadratic, so that this difference is its derivative.
        change = (self._system_theta(theta + steps) - self._system_theta(theta - steps)).mT / 2.0
        options: dict[str, Any] = {"reduce": reduce, "eliminate": False}
        simulated = self._simulated.linearise(self._system_theta(theta), **options)
        predicted = super().linearise(theta, **options)
        return _Both(predicted, simulated, change, self.weight, self._simulations)

    def _system_theta(self, theta: Float[Tensor, "*axes n"]) -> Float[Tensor, "*axes m"]:
        """φ of the free parameters at the beginning of θ, then the initial states in θ."""
        axes = theta.shape[:-1]
        cell = self.lfr.cell
        weights, first = {}, 0
        for name, parameter in cell.named_parameters():
            weights[name] = parameter.detach().expand(*axes, *parameter.shape)
            if parameter.requires_grad:
                part = theta[..., first : first + parameter.numel()]
                weights[name] = part.reshape(*axes, *parameter.shape)
                first += parameter.numel()
        found, _ = split_weights(weights)
        free = [n for n, p in self._simulated.lfr.cell.named_parameters() if p.requires_grad]
        own = [found[name].reshape(*axes, -1) for name in free]
        return torch.cat([*own, theta[..., first:]], dim=-1)


class _Both:
    """J = [J_p; J_s T] with T = w dφ/dθ.

    Args:
        predicted, simulated: J_p and J_s.
        change: dφ/dθ.
        weight: w.
        count: rows of J_s.
    """

    def __init__(
        self,
        predicted: Jacobian,
        simulated: Jacobian,
        change: Float[Tensor, "Q P"],
        weight: float,
        count: int,
    ) -> None:
        self._predicted, self._simulated, self._count = predicted, simulated, count
        self._T, self._weight = weight * change, weight

    def system(self, damping: float, truncation: float) -> tuple[System, Float[Tensor, " P"]]:
        """The system and the gradient."""
        own, gradient = self._predicted.factor()
        other, beside = self._simulated.factor()
        system: System = SVDSystem(torch.cat([own, other @ self._T]), truncation)
        gradient = gradient + self._weight * (self._T.mT @ beside)
        ranks = self._predicted.ranks
        return (system if ranks.world == 1 else BroadcastSystem(system, ranks)), gradient

    def tangent(self, d_theta: Float[Tensor, " P"]) -> Float[Tensor, " M"]:
        """J dθ."""
        parts = self._predicted.tangent(d_theta), self._simulated.tangent(self._T @ d_theta)
        return torch.cat(parts)

    def adjoint(self, residual: Float[Tensor, " M"]) -> Float[Tensor, " P"]:
        """Jᵀ residual."""
        own, other = residual.split([len(residual) - self._count, self._count])
        return self._predicted.adjoint(own) + self._T.mT @ self._simulated.adjoint(other)


def without_past_outputs(record: NormalisedRecord, nu: int) -> NormalisedRecord:
    """The record of the system itself, of its predictor's."""
    own = record.record
    given = replace(own, u=own.u[:, :nu], inputs=own.inputs[:nu])
    return replace(record, u=record.u[:, :nu], record=given)
