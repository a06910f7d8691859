"""The simulation as a function of torch: gradients, forward derivatives and batches of them.

Each pass in machine code is a ``torch.autograd.Function`` with a rule for ``vmap``: the simulation,
its adjoint (gradients: ``grad``, ``jacrev``, ``backward``) and its tangent (``jvp``, ``jacfwd``).
Adjoint and tangent cannot be differentiated again.
"""

from __future__ import annotations

from typing import Any, NoReturn

import torch
from torch import Tensor
from torch.autograd import Function

from lfrtorch._support.errors import LfrtorchError
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.sensitivity import Linearisation
from lfrtorch.engine.simulation import Trajectory, simulate, steady_state

_TWICE = (
    "an LFR has first derivatives only; for second ones step its cell in a loop: "
    "y, x = lfr.cell(u[:, k], x)."
)


Batch = tuple[tuple[Tensor, ...], tuple[int, ...]]
"""Results of a rule for ``vmap``, and the batch axis of each result."""


def _batched(
    function: type[Function], signals: int, info: Any, in_dims: Any, *inputs: Any
) -> Batch:
    """Apply a function of a cell, ``signals`` with an axis of records, and weights to a batch."""
    # A batch of signals becomes further records of one simulation. A batch of weights needs one
    # simulation for each set of weights.
    first, tensors, axes = inputs[:2], inputs[2:], in_dims[2:]
    if all(axis is None for axis in axes[signals:]):
        B = info.batch_size
        whole = [
            t.expand(B, *t.shape) if axis is None else t.movedim(axis, 0)
            for t, axis in zip(tensors[:signals], axes, strict=False)
        ]
        flat = (t.flatten(0, 1) for t in whole)
        found = function.apply(*first, *flat, *tensors[signals:])
        return tuple(each.unflatten(0, (B, -1)) for each in found), (0,) * len(found)
    runs = []
    for b in range(info.batch_size):
        own = (
            t if axis is None else t.select(axis, b) for t, axis in zip(tensors, axes, strict=True)
        )
        runs.append(function.apply(*first, *own))
    found = tuple(torch.stack(each) for each in zip(*runs, strict=True))
    return found, (0,) * len(found)


class _Once(Function):
    """A derivative that cannot be differentiated again."""

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        """Save nothing, as there is no second derivative."""

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Any) -> NoReturn:
        raise LfrtorchError(_TWICE)

    @staticmethod
    def jvp(ctx: Any, *grad_inputs: Any) -> NoReturn:
        raise LfrtorchError(_TWICE)


class _Adjoint(_Once):
    """Derivatives of Σ e · y + end · x(T) with respect to u, x0 and each record's θ."""

    @staticmethod
    def forward(
        cell: LFRCell, periodic: bool, e: Tensor, end: Tensor, u: Tensor, x: Tensor, z: Tensor,
        w: Tensor, *weights: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
        signals = Trajectory(x, z, w, e)  # e stands in for y, which is not used
        about = Linearisation(cell.weights(weights), u, signals, periodic=periodic, every=True)
        with torch.autocast(u.device.type, enabled=False):
            found = about.adjoint(e, end)
        return found.u, found.x0, found.theta

    @staticmethod
    def vmap(info: Any, in_dims: Any, *args: Any) -> Batch:
        """More records."""
        return _batched(_Adjoint, 6, info, in_dims, *args)


class _Tangent(_Once):
    """Changes of y and x(T) by changes of u, x0 and the weights."""

    @staticmethod
    def forward(
        cell: LFRCell, periodic: bool, d_u: Tensor, d_x0: Tensor, u: Tensor, x: Tensor, z: Tensor,
        w: Tensor, *both: Tensor,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        changes, weights = both[: len(both) // 2], both[len(both) // 2 :]
        signals = Trajectory(x, z, w, u)  # u stands in for y, which is not used
        about = Linearisation(cell.weights(weights), u, signals, periodic=periodic, every=True)
        d_theta = torch.cat([change.flatten() for change in changes])
        return about.tangent_with_end(d_theta, None if periodic else d_x0, d_u)

    @staticmethod
    def vmap(info: Any, in_dims: Any, *args: Any) -> Batch:
        """More records."""
        return _batched(_Tangent, 6, info, in_dims, *args)


class Simulation(Function):
    """Simulation of a cell from u, x0 and weights: y and x(T), and x, z, w without gradients."""

    @staticmethod
    def forward(
        cell: LFRCell, periodic: bool, u: Tensor, x0: Tensor, *weights: Tensor
    ) -> tuple[Tensor, ...]:
        """Simulate with the given weights in place of the cell's own."""
        cell.check()
        W = cell.weights(weights)
        found = steady_state(W, u, x0) if periodic else simulate(W, u, x0)
        return found.y, found.x[:, -1].clone(), found.x, found.z, found.w

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        """Keep the trajectory for both derivatives."""
        ctx.cell, ctx.periodic, u, _, *weights = inputs
        _, _, *signals = output
        ctx.mark_non_differentiable(*signals)
        ctx.set_materialize_grads(False)  # zero gradients of x, z and w would take much memory
        ctx.save_for_backward(u, *signals, *weights)
        ctx.save_for_forward(u, *signals, *weights)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor | None) -> tuple[Tensor | None, ...]:
        """The adjoint recurrence."""
        e, end, *_ = grad_outputs
        u, x, _, _, *weights = ctx.saved_tensors
        if e is None:
            e = u.new_zeros(*u.shape[:2], ctx.cell.ny)
        end = torch.zeros_like(x[:, -1]) if end is None else end
        by_u, by_x0, theta = _Adjoint.apply(ctx.cell, ctx.periodic, e, end, *ctx.saved_tensors)
        parts = theta.sum(0).split([p.numel() for p in weights])
        gradients = (part.reshape(p.shape) for part, p in zip(parts, weights, strict=True))
        return None, None, by_u, None if ctx.periodic else by_x0, *gradients

    @staticmethod
    def jvp(ctx: Any, *grad_inputs: Tensor | None) -> tuple[Tensor | None, ...]:
        """The tangent recurrence."""
        _, _, d_u, d_x0, *changes = grad_inputs
        u, x, _, _, *weights = ctx.saved_tensors
        d_u = torch.zeros_like(u) if d_u is None else d_u
        d_x0 = torch.zeros_like(x[:, 0]) if d_x0 is None else d_x0
        pairs = zip(weights, changes, strict=True)
        changes = [torch.zeros_like(p) if d is None else d for p, d in pairs]
        found = _Tangent.apply(ctx.cell, ctx.periodic, d_u, d_x0, u, *ctx.saved_tensors[1:4],
                               *changes, *weights)  # fmt: skip
        return *found, None, None, None

    @staticmethod
    def vmap(info: Any, in_dims: Any, *args: Any) -> Batch:
        """More records."""
        return _batched(Simulation, 2, info, in_dims, *args)
