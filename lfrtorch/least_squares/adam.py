"""Adam, a baseline for Levenberg-Marquardt, on minibatches of records or on all records at once.

There are many records if a fit is over windows. An epoch then has one step for each minibatch;
with few records it has a single step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import torch
from jaxtyping import Float
from torch import Tensor

from lfrtorch._support.arguments import typed
from lfrtorch._support.reasons import Reason
from lfrtorch._support.settings import documented
from lfrtorch.least_squares.options import AdamOptions
from lfrtorch.least_squares.residual import Point


class Differentiable(Protocol):
    """A residual with the gradient of its mean square."""

    def gradient(
        self, theta: Float[Tensor, " P"], near: Point | None = None
    ) -> tuple[Point, Float[Tensor, " P"]]:
        """r at θ and the gradient of its mean square; ``near`` is a nearby point."""
        ...

    def evaluate(self, theta: Float[Tensor, " P"], near: Point | None = None) -> Point:
        """r at θ."""
        return self.gradient(theta, near)[0]

    def minibatches(self, epoch: int) -> Sequence[Differentiable]:
        """Problems on parts of the data, divided anew in each epoch; the problem itself if not."""
        return [self]

    def admissible(self, theta: Float[Tensor, " P"]) -> Float[Tensor, " P"]:
        """θ, or the nearby θ that the search may use in its place."""
        return theta


@dataclass
class AdamState:
    """State of the search: θ, r(θ), the optimiser's moments, and why the search ended."""

    theta: Float[Tensor, " P"]
    residual: Float[Tensor, " M"]
    cost: float
    seen: tuple[Any, ...]  # see ``Point``
    gradient: Float[Tensor, " P"]
    iteration: int = 0
    reason: str = ""
    moments: dict[str, Tensor] = field(default_factory=dict)

    @property
    def point(self) -> Point:
        """The evaluation at θ."""
        return Point(self.theta, self.residual, self.cost, self.seen)

    @property
    def report(self) -> dict[str, float]:
        """Values of a step for monitors."""
        return {"gradient_norm": float(self.gradient.norm())}


@typed()
@documented
@dataclass(frozen=True)
class Adam(AdamOptions):
    """Options of ``torch.optim.Adam``; ``init`` and ``step`` run it.

    Example:
        >>> trainer = lfrtorch.Adam(max_iter=20, learning_rate=1e-2)
        >>> result = lfrtorch.fit(model, record, trainer=trainer)
        >>> result.history[-1].train < result.history[0].train
        True
    """

    @property
    def limit(self) -> int:
        """Largest number of epochs."""
        return self.max_iter

    def init(self, problem: Differentiable, theta: Tensor, point: Point | None = None) -> AdamState:
        """State at the first θ; ``point`` is the evaluation there, if it is known."""
        found, gradient = problem.gradient(theta, point)
        return AdamState(*found, gradient)

    def step(self, problem: Differentiable, state: AdamState) -> AdamState:
        """One epoch."""
        parameter = torch.nn.Parameter(state.theta.clone())
        optimiser = torch.optim.Adam([parameter], lr=self.learning_rate)
        if state.moments:
            optimiser.state[parameter] = {k: v.clone() for k, v in state.moments.items()}
        theta, gradient = state.theta, state.gradient
        parts = problem.minibatches(state.iteration)
        for part in parts:
            if len(parts) > 1:
                _, gradient = part.gradient(theta)
            parameter.grad = gradient
            optimiser.step()
            theta = problem.admissible(parameter.detach().clone())
            parameter.data.copy_(theta)
        if len(parts) > 1:
            point = problem.evaluate(theta, state.point)
        else:
            point, gradient = problem.gradient(theta, state.point)
        iteration = state.iteration + 1
        reason = Reason.ALL_EPOCHS if iteration >= self.max_iter else ""
        if not torch.isfinite(gradient).all():
            reason = Reason.GRADIENT_DIVERGED
        moments = dict(optimiser.state[parameter])
        return AdamState(*point, gradient, iteration, reason, moments)

    def prolonged(self, state: AdamState) -> AdamState:
        """State to go on from; a search that used up its epochs goes on if the limit rises."""
        spent = state.reason == Reason.ALL_EPOCHS and state.iteration < self.max_iter
        return replace(state, reason="") if spent else state

    def refused(self, before: AdamState, after: AdamState) -> AdamState:
        """State to go on from after a poor step: the step is kept, as small steps can undo it."""
        return after
