"""Levenberg-Marquardt with geodesic acceleration, for any least-squares problem.

Minimises |r(θ)|² with the damping λI. The result depends on the scaling of θ, so signals and states
should be scaled to unit variance. On Bouc-Wen, Marquardt's scaling by column norms stalled at an
rms error of 7e-5 m, and λI reached 3e-6 m: saturated neurons have vanishing columns, and their
weights run off.

References:
    Nielsen, "Damping parameter in Marquardt's method", IMM-REP-1999-05 (the damping rule).
    Transtrum, Machta and Sethna, "Geometry of nonlinear least squares with applications to sloppy
    models and optimization", Phys. Rev. E 83, 2011 (geodesic acceleration).
    Wills and Ninness, "On gradient-based search for multivariable system estimates", IEEE Trans.
    Automatic Control 53, 2008 (singular values leave out the gauge directions).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from lfrtorch._support.arguments import typed
from lfrtorch._support.errors import InputError
from lfrtorch._support.reasons import Reason
from lfrtorch._support.settings import documented
from lfrtorch.least_squares.linear_systems import System
from lfrtorch.least_squares.options import LevenbergMarquardtOptions
from lfrtorch.least_squares.residual import Jacobian, LeastSquares, Point

FASTEST_DECREASE = 0.2
"""Smallest factor on λ after an accepted step; Nielsen uses 1/3."""

FIRST = 0.1
"""Factor on λ between trials of the first step. Trials go on while each decreases the cost by at
least 10 % more than the one before.

As λ falls the gain ratio stays near 1 at first, and is then far below 0 within two trials.
benchmarks/starts.md shows how many iterations this saves.
"""

TAKEN_BACK = 10.0
"""Factor on λ after an undone step: twice the factor 1/0.2 = 5 that undoes the largest decrease."""


@dataclass(frozen=True)
class LMState:
    """State of the search: θ, r(θ), the cost |r|² and the damping λ of the next trial."""

    theta: Float[Tensor, " P"]
    residual: Float[Tensor, " M"]
    cost: float
    seen: tuple[Any, ...] = ()  # see ``Point``
    damping: float | None = None  # None before the first step
    scale: float = 1.0  # about the largest squared singular value of J in the last step
    growth: float = 2.0  # factor on λ if the next trial is rejected
    iteration: int = 0  # accepted and refused steps
    gain_ratio: float = float("nan")
    trials: int = 0
    rank: int = 0
    quiet: int = 0  # steps in a row that changed the cost by less than the tolerance
    reason: str = ""

    @cached_property
    def point(self) -> Point:
        """The evaluation at θ."""
        return Point(self.theta, self.residual, self.cost, self.seen)

    @property
    def report(self) -> dict[str, float]:
        """Values of a step for monitors."""
        if self.damping is None:
            return {}
        return {
            "damping": self.damping,
            "gain_ratio": self.gain_ratio,
            "trials": self.trials,
            "rank": self.rank,
        }


class _Trial(NamedTuple):
    """A step and the point that it reached."""

    point: Point
    damping: float
    gain_ratio: float

    @property
    def cost(self) -> float:
        """|r|²."""
        return self.point.cost


@typed()
@documented
@dataclass(frozen=True)
class LevenbergMarquardt(LevenbergMarquardtOptions):
    """Options of the search; ``init`` and ``step`` run it.

    Example:
        >>> trainer = lfrtorch.LevenbergMarquardt(max_iter=10, acceleration=False)
        >>> result = lfrtorch.fit(model, record, trainer=trainer)
        >>> result.history[-1].train < result.history[0].train
        True
    """

    @property
    def limit(self) -> int:
        """Largest number of iterations."""
        return self.max_iter

    def init(self, problem: LeastSquares, theta: Tensor, point: Point | None = None) -> LMState:
        """State at the first θ; ``point`` is the evaluation there, if it is known."""
        point = problem.evaluate(theta) if point is None else point
        if not math.isfinite(point.cost):
            raise InputError(
                "the residual is not finite at the start of the search; start from a stable model."
            )
        return LMState(*point)

    def step(self, problem: LeastSquares, state: LMState) -> LMState:
        """One iteration: linearise, then raise the damping until a step lowers the cost."""
        # The first iteration also lowers the damping, as long as the next trial is better.
        jacobian = problem.linearise_at(state.point)
        damping, least = state.damping, math.inf
        first = min(self.damping, self.least_damping)
        relative = first if damping is None else damping / state.scale
        system, gradient = jacobian.system(relative, self.truncation)
        scale = system.scale if damping is None else system.size
        if not 0.0 < scale < math.inf:
            return replace(state, reason=Reason.JACOBIAN_VANISHES)
        if damping is None:  # the first iteration may lower the damping down to ``least``
            damping, least = self.damping * scale, self.least_damping * scale
        growth, trials, gain_ratio = state.growth, 0, float("nan")
        best: _Trial | None = None
        while damping / scale <= self.max_damping:
            trials += 1
            trial = self._trial(problem, state, jacobian, system, gradient, damping)
            gain_ratio, decrease = trial.gain_ratio, state.cost - trial.cost
            before = 0.0 if best is None else state.cost - best.cost
            if decrease > before:  # False for NaN: a diverging trial is a rejected step
                best = trial
            elif best is None:
                damping, growth, least = growth * damping, 2.0 * growth, math.inf
                continue
            damping *= FIRST
            if damping < least or not decrease > (1.0 + FIRST) * before:
                break
        if best is None:
            return replace(
                state,
                iteration=state.iteration + 1,
                gain_ratio=gain_ratio,
                trials=trials,
                rank=system.rank,
                reason=Reason.NO_STEP_LEFT,
            )
        actual = state.cost - best.cost
        quiet = state.quiet + 1 if actual <= self.tolerance * state.cost else 0
        accepted = replace(
            state,
            **best.point._asdict(),
            damping=best.damping * max(FASTEST_DECREASE, 1.0 - (2.0 * best.gain_ratio - 1.0) ** 3),
            scale=scale,
            growth=2.0,
            iteration=state.iteration + 1,
            gain_ratio=best.gain_ratio,
            trials=trials,
            rank=system.rank,
            quiet=quiet,
        )
        floor = self.floor**2 * problem.cost(torch.ones_like(best.point.residual))
        if max(accepted.cost, state.cost) <= floor:  # a step later: it improves poor θ
            return replace(accepted, reason=Reason.RESIDUAL_VANISHES)
        if quiet >= self.patience:
            return replace(accepted, reason=Reason.COST_SETTLED)
        if accepted.iteration >= self.max_iter:
            return replace(accepted, reason=Reason.ALL_ITERATIONS)
        return accepted

    def refused(self, before: LMState, after: LMState) -> LMState:
        """State to go on from after a step is undone: the state before, with a larger damping."""
        assert after.damping is not None
        return replace(
            before,
            damping=TAKEN_BACK * after.damping,
            scale=after.scale,
            iteration=after.iteration,
            trials=after.trials,
            rank=after.rank,
            reason=after.reason,
        )

    def prolonged(self, state: LMState) -> LMState:
        """State to go on from; a search that used up its iterations goes on if the limit rises."""
        spent = state.reason == Reason.ALL_ITERATIONS and state.iteration < self.max_iter
        return replace(state, reason="") if spent else state

    def _trial(
        self,
        problem: LeastSquares,
        state: LMState,
        jacobian: Jacobian,
        system: System,
        gradient: Float[Tensor, " P"],
        damping: float,
    ) -> _Trial:
        """The step at one damping."""
        delta = system.solve(gradient, damping)
        # Predicted decrease of |r + J δ|² for the δ with (JᵀJ + λI) δ = -gradient.
        predicted = damping * float(delta @ delta) - float(gradient @ delta)
        theta = state.theta + delta
        if self.acceleration:
            theta = theta + self._acceleration(problem, state, jacobian, system, delta, damping)
        point = problem.evaluate(problem.admissible(theta), state.point)
        gain_ratio = (state.cost - point.cost) / predicted if predicted > 0 else float("nan")
        return _Trial(point, damping, gain_ratio)

    def _acceleration(
        self,
        problem: LeastSquares,
        state: LMState,
        jacobian: Jacobian,
        system: System,
        delta: Float[Tensor, " P"],
        damping: float,
    ) -> Tensor:
        """Second-order correction a = ½ argmin |J a + r''|² + λ|a|², or 0 if it is too long."""
        h = self.finite_step
        ahead = problem.evaluate(state.theta + h * delta, state.point)
        if not math.isfinite(ahead.cost):
            return torch.zeros_like(delta)
        # Second derivative r'' along δ, from r(θ + hδ) = r + h J δ + h² r'' / 2 + O(h³).
        second = (
            (ahead.residual - state.residual).div_(h).sub_(jacobian.tangent(delta)).mul_(2.0 / h)
        )
        a = 0.5 * system.solve(jacobian.adjoint(second), damping)
        squares = 4.0 * float(a @ a), self.acceleration_limit**2 * float(delta @ delta)
        trusted = squares[0] <= squares[1]  # False for NaN
        return a if trusted else torch.zeros_like(delta)
