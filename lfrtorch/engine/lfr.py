"""The NL-LFR cell as a recurrent network u -> y that composes with autograd."""

from __future__ import annotations

import sys
from typing import Any, Literal, overload

import torch
from torch import Tensor, nn

from lfrtorch._support.errors import InputError
from lfrtorch._support.threads import fast_paths
from lfrtorch.data.records import Start, check_start
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.differentiable import Simulation
from lfrtorch.engine.simulation import Trajectory, simulate, steady_state

_UNCOMPILED: list[Any] = []
"""The simulation as ``torch.compile`` calls it, made at the first use, as the import of the
compiler takes a second."""


class LFR(nn.Module):
    """NL-LFR model over time, which simulates the cell; gradients are by the adjoint recurrence.

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
            x0: initial state, or a first guess of the periodic steady state. Default: zero.
            start: ``"periodic"`` for the periodic steady state; otherwise the start is ``x0``.
            guess: states of a nearby trajectory, which may save time.

        Shape:
            u: (R, T, nu), x0: (R, nx), guess: (R, T + 1, nx), or (R, 1, nx) for a period.

        Raises:
            ValueError: signals of other sizes, dtype or device than the weights.
        """
        self._check_start(start)
        self.cell.check()
        self.cell.check_signals(u, x0, guess)
        if start == "periodic":
            return steady_state(self.cell, u, x0 if guess is None else guess)
        zero = u.new_zeros(len(u), self.cell.nx)
        return simulate(self.cell, u, zero if x0 is None else x0, guess=guess)

    @overload
    def forward(
        self, u: Tensor, x0: Tensor | None = ..., start: Start = ..., *,
        return_state: Literal[False] = ...,
    ) -> Tensor: ...  # fmt: skip

    @overload
    def forward(
        self, u: Tensor, x0: Tensor | None = ..., start: Start = ..., *,
        return_state: Literal[True],
    ) -> tuple[Tensor, Tensor]: ...  # fmt: skip

    def forward(
        self,
        u: Tensor,
        x0: Tensor | None = None,
        start: Start = "zero",
        return_state: bool = False,
    ) -> Tensor | tuple[Tensor, Tensor]:
        """Simulated output; ``backward`` is one adjoint recurrence, without second derivatives.

        Args:
            u: input.
            x0: initial state, or a first guess of the periodic steady state. Default: zero.
            start: ``"periodic"`` for the periodic steady state; otherwise the start is ``x0``.
            return_state: also return the state after the last sample, (R, nx), from which a
                simulation of the next samples can go on.

        Raises:
            ValueError: signals of other sizes, dtype or device than the weights, or
                ``return_state`` with a periodic steady state.
        """
        if "torch._dynamo" in sys.modules:  # torch.compile leaves this layer as it is
            if not _UNCOMPILED:
                _UNCOMPILED.append(torch.compiler.disable(LFR._simulated))
            y, end = _UNCOMPILED[0](self, u, x0, start, return_state)
        else:
            y, end = self._simulated(u, x0, start, return_state)
        return (y, end) if return_state else y

    def _simulated(
        self, u: Tensor, x0: Tensor | None, start: Start, return_state: bool
    ) -> tuple[Tensor, Tensor]:
        """Output and last state."""
        if torch.onnx.is_in_onnx_export() or torch.compiler.is_compiling():
            raise InputError(
                "an LFR runs in machine code, which torch.export and torch.onnx.export cannot "
                "trace;\nlfrtorch.export.write(model, 'onnx', FOLDER) writes the lfrtorch.Model "
                "that has this layer."
            )
        if self.cell.autocast:
            u, x0 = self.cell.uncast(u, x0)
            with torch.autocast(self.cell.A.device.type, enabled=False):
                return self._simulated(u, x0, start, return_state)
        if isinstance(u, Tensor) and u.ndim == 2:  # one record
            x0 = x0.unsqueeze(0) if isinstance(x0, Tensor) else x0
            y, end = self._simulated(u.unsqueeze(0), x0, start, return_state)
            return y.squeeze(0), end.squeeze(0)
        self._check_start(start)
        if return_state and start == "periodic":
            raise InputError(
                "return_state=True with start='periodic': a period ends where it begins; give "
                "start='zero'."
            )
        self.cell.check_signals(u, x0)
        if x0 is None:
            x0 = u.new_zeros(len(u), self.cell.nx)
        if start != "periodic" and not fast_paths():
            return self._stepped(u, x0)
        weights = self.cell.parameters()
        y, end, *_ = Simulation.apply(self.cell, start == "periodic", u, x0, *weights)
        return y, end

    def _stepped(self, u: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
        """Output and last state, computed by torch alone, sample by sample."""
        self.cell.check()
        outputs = []
        for u_k in u.unbind(1):
            y, x = self.cell(u_k, x)
            outputs.append(y)
        return torch.stack(outputs, dim=1), x

    @staticmethod
    def _check_start(start: Start) -> None:
        check_start(start, "simulation")
        if start in ("estimated", "measured"):
            raise InputError(f"start='{start}' needs measured outputs; use Model.simulate(record).")
