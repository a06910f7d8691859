"""The NL-LFR cell as a recurrent network u -> y that composes with autograd."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from lfrtorch.cell import LFRCell
from lfrtorch.records import Start
from lfrtorch.recurrence import linear_recurrence
from lfrtorch.simulate import (
    Trajectory,
    monodromy,
    simulate,
    slopes,
    static_jacobians,
    steady_state,
)


class LFR(nn.Module):
    """NL-LFR model over time: simulates the cell and differentiates by the adjoint recurrence.

    Args:
        cell: the model equations and their weights.

    Shape:
        u: (R, T, nu), x0: (R, nx) -> y: (R, T, ny), normalised units.
    """

    def __init__(self, cell: LFRCell) -> None:
        super().__init__()
        self.cell = cell

    def trajectory(self, u: Tensor, x0: Tensor | None = None, start: Start = "zero") -> Trajectory:
        """All signals of a simulation, without gradients.

        Args:
            u: input.
            x0: start state; zero where left out. In periodic steady state the guess to begin with.
            start: ``"zero"`` to begin at ``x0``, ``"periodic"`` for the periodic steady state.
        """
        if start == "periodic":
            return steady_state(self.cell, u, x0)
        return simulate(self.cell, u, u.new_zeros(len(u), self.cell.nx) if x0 is None else x0)

    def forward(self, u: Tensor, x0: Tensor | None = None, start: Start = "zero") -> Tensor:
        """Simulated output; ``backward`` costs one adjoint recurrence (no second derivatives)."""
        trajectory = self.trajectory(u.detach(), None if x0 is None else x0.detach(), start)
        if not torch.is_grad_enabled():
            return trajectory.y
        # All steps in one batch with the states held fixed; what flows through the states is the
        # adjoint recurrence of _ThroughStates.
        y, x_next = self.cell(u, trajectory.x[:, :-1])
        F, H = slopes(self.cell, static_jacobians(self.cell, trajectory.z)[0])
        if x0 is None or start == "periodic":
            x0 = trajectory.x[:, 0]
        return _ThroughStates.apply(y, x_next, x0, F, H, start == "periodic")


class _ThroughStates(torch.autograd.Function):
    """Identity on y whose backward pass is λ(k) = F(k)ᵀ λ(k+1) + H(k)ᵀ dV/dy(k)."""

    @staticmethod
    def forward(
        ctx: Any,
        y: Tensor,
        x_next: Tensor,
        x0: Tensor,
        F: Tensor,
        H: Tensor,
        periodic: bool,
    ) -> Tensor:
        ctx.save_for_backward(F, H)
        ctx.periodic = periodic
        return y.clone()

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, *grad_outputs: Tensor
    ) -> tuple[Tensor | None, ...]:
        (grad_y,) = grad_outputs
        F, H = ctx.saved_tensors
        # Backwards in time: index 0 of the recurrence is the end of the record.
        F = F.mT.flip(1)
        g = (H.mT @ grad_y.unsqueeze(-1)).flip(1)
        end = g.new_zeros(g.shape[0], *g.shape[2:])
        adjoint = linear_recurrence(F, g, end)
        if ctx.periodic:
            identity = torch.eye(F.shape[-1], dtype=F.dtype, device=F.device)
            end = torch.linalg.solve(identity - monodromy(F), adjoint[:, -1])
            adjoint = linear_recurrence(F, g, end)
        adjoint = adjoint.squeeze(-1).flip(1)
        return grad_y, adjoint[:, 1:], adjoint[:, 0], None, None, None
