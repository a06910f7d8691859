"""The NL-LFR cell as a recurrent network u -> y that composes with autograd."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from lfrtorch._support.errors import InputError
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.sensitivity import Linearisation
from lfrtorch.engine.simulation import Trajectory, simulate, steady_state
from lfrtorch.records import Start, check_start


class LFR(nn.Module):
    """NL-LFR model over time: simulates the cell and differentiates by the adjoint recurrence.

    Args:
        cell: the model equations and their weights.

    Signals are in normalised units.

    Shape:
        u: (R, T, nu), x0: (R, nx) -> (R, T, ny). One record may come without the axis R, as in
        ``torch.nn.RNN``: u: (T, nu), x0: (nx,) -> (T, ny).

    Example:
        >>> u = torch.ones(3, 100, 1, dtype=torch.float64)  # three records
        >>> y = model.lfr(u)
        >>> y.square().mean().backward()
        >>> y.shape, model.lfr.cell.A.grad.shape
        (torch.Size([3, 100, 1]), torch.Size([1, 1]))
    """

    def __init__(self, cell: LFRCell) -> None:
        super().__init__()
        self.cell = cell

    def trajectory(
        self,
        u: Tensor,
        x0: Tensor | None = None,
        start: Start = "zero",
        *,
        guess: Tensor | None = None,
    ) -> Trajectory:
        """All signals of a simulation, without gradients.

        Args:
            u: input.
            x0: initial state; a first guess in periodic steady state. Default: zero.
            start: ``"periodic"`` for the periodic steady state; otherwise from ``x0``.
            guess: states of a nearby trajectory, which may save time.

        Shape:
            u: (R, T, nu), x0: (R, nx), guess: (R, T + 1, nx), or (R, 1, nx) for a period.

        Raises:
            ValueError: signals of other sizes, dtype or device than the weights.
        """
        check_start(start, "simulation")
        self.cell.check()
        self.cell.check_signals(u, x0, guess)
        if start in ("estimated", "measured"):
            raise InputError(f"start='{start}' needs a record's output: Model.simulate.")
        if start == "periodic":
            return steady_state(self.cell, u, x0 if guess is None else guess)
        zero = u.new_zeros(len(u), self.cell.nx)
        return simulate(self.cell, u, zero if x0 is None else x0, guess=guess)

    def forward(
        self,
        u: Tensor,
        x0: Tensor | None = None,
        start: Start = "zero",
    ) -> Tensor:
        """Simulated output; ``backward`` costs one adjoint recurrence (no second derivatives).

        Raises:
            ValueError: signals of other sizes, dtype or device than the weights.
        """
        if isinstance(u, Tensor) and u.ndim == 2:  # one record
            x0 = x0.unsqueeze(0) if isinstance(x0, Tensor) else x0
            return self.forward(u.unsqueeze(0), x0, start).squeeze(0)
        self.cell.check_signals(u, x0)
        weights = list(self.cell.parameters())
        if x0 is None:
            x0 = u.new_zeros(len(u), self.cell.nx)
        return _Simulation.apply(self, start, u, x0, *weights)


class _Simulation(torch.autograd.Function):
    """The simulation with the adjoint recurrence as its derivative."""

    @staticmethod
    def forward(
        ctx: Any, lfr: LFR, start: Start, u: Tensor, x0: Tensor, *weights: Tensor
    ) -> Tensor:
        trajectory = lfr.trajectory(u, x0, start)
        ctx.save_for_backward(u, x0, *weights)
        ctx.lfr, ctx.start, ctx.trajectory = lfr, start, trajectory
        return trajectory.y.clone()

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, *grad_outputs: Tensor
    ) -> tuple[Tensor | None, ...]:
        (grad_y,) = grad_outputs
        u, _, *weights = ctx.saved_tensors
        periodic = ctx.start == "periodic"
        cell = ctx.lfr.cell
        linearisation = Linearisation(cell, u, ctx.trajectory, periodic=periodic, weights=weights)
        adjoint = linearisation.adjoint(grad_y)
        sizes = [p.numel() for p in weights]
        gradients = [
            part.reshape(p.shape)
            for part, p in zip(adjoint.theta.sum(0).split(sizes), weights, strict=True)
        ]
        return None, None, adjoint.u, None if periodic else adjoint.x0, *gradients
