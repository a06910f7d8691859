"""Levenberg-Marquardt with geodesic acceleration, for any least-squares problem.

Minimises |r(θ)|² with the damping λI, so that the coordinates of θ decide: signals and states
should be scaled to unit variance. (Marquardt's scaling by column norms stalled at 7e-5 m where
this one reaches 3e-6 m: saturated neurons have vanishing columns and their weights run off.)

References:
    Nielsen, "Damping parameter in Marquardt's method", IMM-REP-1999-05 (the damping rule).
    Transtrum, Machta and Sethna, "Geometry of nonlinear least squares with applications to sloppy
    models and optimization", Phys. Rev. E 83, 2011 (geodesic acceleration).
    Wills and Ninness, "On gradient-based search for multivariable system estimates", IEEE Trans.
    Automatic Control 53, 2008 (singular values leave out the gauge directions).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import torch
from torch import Tensor

from lfrtorch.checks import integer, number

FASTEST_DECREASE = 0.2
"""Smallest factor on λ after a good step; Nielsen has 1/3."""


class LeastSquares(Protocol):
    """A residual and its Jacobian; where the residual is undefined it is infinite or NaN."""

    def residual(self, theta: Tensor) -> Tensor:
        """r (M,) at θ (P,)."""
        ...

    def jacobian(self, theta: Tensor) -> Tensor:
        """dr/dθ (M, P) at θ (P,)."""
        ...


@dataclass(frozen=True)
class LMState:
    """Where the search stands.

    Args:
        theta: parameters (P,).
        residual: r(θ), (M,).
        damping: λ of the next trial; ``None`` before the first step.
        growth: factor of λ on the next rejection.
        iteration: accepted and refused steps so far.
        gain_ratio: actual over predicted decrease of the last trial.
        trials: dampings tried in the last step.
        rank: singular values above the truncation in the last step.
        quiet: steps in a row that changed the cost by less than the tolerance.
        reason: why the search is over; empty while it is not.
    """

    theta: Tensor
    residual: Tensor
    damping: float | None = None
    growth: float = 2.0
    iteration: int = 0
    gain_ratio: float = float("nan")
    trials: int = 0
    rank: int = 0
    quiet: int = 0
    reason: str = ""

    @property
    def cost(self) -> float:
        """|r|²."""
        return float(self.residual.square().sum())

    @property
    def report(self) -> dict[str, float]:
        """What the monitors show of a step."""
        if self.damping is None:
            return {}
        return {
            "damping": self.damping,
            "gain_ratio": self.gain_ratio,
            "trials": self.trials,
            "rank": self.rank,
        }


@dataclass(frozen=True)
class LevenbergMarquardt:
    """Options of the search; ``init`` and ``step`` run it.

    Args:
        max_iter: most steps.
        acceleration: geodesic acceleration, one more residual a trial.
        damping: first λ relative to the largest squared singular value of the Jacobian.
        tolerance: relative decrease of the cost that counts as no progress ...
        patience: ... and the number of such steps in a row that ends the search.
        floor: root mean square of the residual that counts as zero.
        truncation: singular values below this part of the largest are gauge and left out. (Those
            below about 1e-8 count only as far as the damping lets them: the steps come from Jᵀr.)
        finite_step: h of the directional second derivative (Transtrum et al. use 0.1).
        acceleration_limit: largest 2|a| / |δ| at which the acceleration is trusted.
        max_damping: λ relative to the largest squared singular value that ends the search.
    """

    max_iter: int = 200
    acceleration: bool = True
    damping: float = 1e-2
    tolerance: float = 1e-7
    patience: int = 5
    floor: float = 1e-13
    truncation: float = 1e-12
    finite_step: float = 0.1
    acceleration_limit: float = 0.75
    max_damping: float = 1e12

    def __post_init__(self) -> None:
        for name in ("damping", "truncation", "finite_step", "acceleration_limit", "max_damping"):
            number(name, getattr(self, name), positive=True)
        for name in ("tolerance", "floor"):
            number(name, getattr(self, name))
        integer("max_iter", self.max_iter, 0)
        integer("patience", self.patience, 1)

    @property
    def limit(self) -> int:
        """Most iterations."""
        return self.max_iter

    def init(self, problem: LeastSquares, theta: Tensor) -> LMState:
        """State at the start θ.

        Raises:
            ValueError: the residual at the start is not finite.
        """
        residual = problem.residual(theta)
        if not torch.isfinite(residual).all():
            raise ValueError(
                "the residual is not finite at the start of the search; start from a stable model."
            )
        return LMState(theta, residual)

    def step(self, problem: LeastSquares, state: LMState) -> LMState:
        """One iteration: linearise, then raise the damping until a step lowers the cost."""
        jacobian = problem.jacobian(state.theta)
        # Only R is formed: gradients Jᵀr then cost one product each, half the time of forming Q.
        R = torch.linalg.qr(jacobian, mode="r").R
        if not torch.isfinite(R).all() or not R.any():
            return replace(state, reason="the Jacobian vanishes or is not finite")
        _, s, Vh = torch.linalg.svd(R, full_matrices=False)
        kept = s > self.truncation * s[0]
        s, Vh = s[kept], Vh[kept]
        scale = float(s[0]) ** 2
        damping = self.damping * scale if state.damping is None else state.damping
        growth, cost, r = state.growth, state.cost, state.residual

        def solve(right: Tensor) -> Tensor:
            """argmin |J δ + right|² + λ|δ|²."""
            return -Vh.mT @ ((Vh @ (jacobian.mT @ right)) / (s.square() + damping))

        trials, gain_ratio = 0, float("nan")
        while damping <= self.max_damping * scale:
            trials += 1
            delta = solve(r)
            slope = jacobian @ delta
            predicted = float(slope.square().sum() + 2.0 * damping * delta.square().sum())
            theta = state.theta + delta
            if self.acceleration:
                theta = theta + self._acceleration(problem, state, slope, delta, solve)
            residual = problem.residual(theta)
            actual = cost - float(residual.square().sum())
            gain_ratio = actual / predicted if predicted > 0 else float("nan")
            if actual > 0:  # False for NaN: a diverging trial is a rejected step
                damping *= max(FASTEST_DECREASE, 1.0 - (2.0 * gain_ratio - 1.0) ** 3)
                quiet = state.quiet + 1 if actual <= self.tolerance * cost else 0
                accepted = replace(
                    state,
                    theta=theta,
                    residual=residual,
                    damping=damping,
                    growth=2.0,
                    iteration=state.iteration + 1,
                    gain_ratio=gain_ratio,
                    trials=trials,
                    rank=len(s),
                    quiet=quiet,
                )
                if accepted.cost <= self.floor**2 * len(residual):
                    return replace(accepted, reason="converged: the residual vanishes")
                if quiet >= self.patience:
                    return replace(accepted, reason="converged: the cost no longer falls")
                if accepted.iteration >= self.max_iter:
                    return replace(accepted, reason="maximum number of iterations")
                return accepted
            damping *= growth
            growth *= 2.0
        return replace(
            state,
            iteration=state.iteration + 1,
            gain_ratio=gain_ratio,
            trials=trials,
            rank=len(s),
            reason="converged: no step lowers the cost",
        )

    def _acceleration(
        self,
        problem: LeastSquares,
        state: LMState,
        slope: Tensor,
        delta: Tensor,
        solve: Callable[[Tensor], Tensor],
    ) -> Tensor:
        """Second-order correction a = ½ argmin |J a + r''|² + λ|a|², or 0 where it is too long."""
        h = self.finite_step
        ahead = problem.residual(state.theta + h * delta)
        second = 2.0 / h * ((ahead - state.residual) / h - slope)
        a = 0.5 * solve(second)
        trusted = 2.0 * a.norm() <= self.acceleration_limit * delta.norm()  # False for NaN
        return a if trusted else torch.zeros_like(delta)
