"""Columns of the Jacobian that need no recurrence: the columns of Cy, Dyu and Dyw."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lfrtorch.engine.sensitivity import Linearisation
from lfrtorch.least_squares.linear_systems import product, tied


class OutputColumns:
    """The columns of Cy, Dyu and Dyw, and their products with the other columns."""

    # An entry of Cy, Dyu or Dyw multiplies a signal of v = [x; u; w]. The derivative of its output
    # by this entry is that signal; the derivatives of other outputs are zero. So the products of
    # these columns are products of a few signals, and the columns are never formed. All samples
    # must have the same weight.

    def __init__(self, linearisation: Linearisation, own: Int[Tensor, " K"]) -> None:
        self._linearisation = linearisation
        entries = torch.from_numpy(linearisation.columns(own).y).to(own.device)
        self.place, self._output, self._signal = entries.T
        self._with_rows: dict[int, Tensor] = {}
        self._of_signals: dict[int, Tensor] = {}

    def without(self, each: Int[Tensor, " K"]) -> Int[Tensor, " K_other"]:
        """The entries of ``each`` that belong to the other columns."""
        other = torch.ones(len(each), dtype=torch.bool, device=each.device)
        other[self.place] = False
        return each[other]

    def fold(self, to: int, r: int, time: slice, rows: Float[Tensor, "B ny C"]) -> None:
        """Add the products with record r's other columns, at some samples, to the sum ``to``."""
        v = self._linearisation.signals(slice(r, r + 1), time)[0]
        with_rows, of_signals = product(v.mT, rows.flatten(1)), product(v.mT, v)
        if to in self._with_rows:
            with_rows += self._with_rows[to]
            of_signals += self._of_signals[to]
        self._with_rows[to], self._of_signals[to] = with_rows, of_signals

    def products(
        self,
        of: int,
        place: Int[Tensor, " n"],
        width: int,
        tie: Float[Tensor, "m n-1"] | None,
    ) -> Float[Tensor, "{width} {width}"]:
        """JᵀJ with ``width`` columns, but for products among the other columns, at ``place``."""
        outputs = self._linearisation.trajectory.y.shape[2]
        with_rows = self._with_rows[of].unflatten(1, (outputs, -1))[self._signal, self._output]
        if tie is not None:
            with_rows = tied(with_rows, tie)
        own = self.place.unsqueeze(1)
        G = with_rows.new_zeros(width, width)
        G[own, place] = with_rows
        G[place.unsqueeze(1), self.place] = with_rows.mT
        same = self._output.unsqueeze(1) == self._output
        G[own, self.place] = self._of_signals[of][self._signal.unsqueeze(1), self._signal] * same
        return G
