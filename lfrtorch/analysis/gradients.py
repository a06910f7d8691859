"""Derivatives of a simulated output along a record, by the parameters that the data determine.

The columns are those of ``gauge``: the other parameters are held, which changes no output. The
start state moves with the parameters. For a periodic record it is the end state. An estimated start
state is the one that fits best. It moves by dx0 = -(W X)⁺ W J dθ, with rows X of the start state,
rows J of the parameters and weights W. The rows of the output are then J + X dx0/dθ.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lfrtorch.analysis.noise_model import NoiseModel
from lfrtorch.data.records import Record
from lfrtorch.engine.sensitivity import Linearisation, fixed_point
from lfrtorch.least_squares.linear_systems import GramAccumulator, QRAccumulator
from lfrtorch.least_squares.record_groups import RecordGroup
from lfrtorch.least_squares.simulation_errors import SimulationErrors
from lfrtorch.model.model import Model

_SEEN = 1e-9
"""Directions of a start state that move the output by less than this, relatively, are held."""


class Gradients:
    """Rows dy/dθ of one record, block by block, normalised; the model is in float64.

    Args:
        kept: the columns, by their place in θ.
        fitted: an estimated start was fitted together with the parameters. Otherwise it
            follows from the skipped samples, as in ``Model.simulate``.
        hold: keep the rows, rather than compute them at each pass.
    """

    def __init__(
        self,
        model: Model,
        record: Record,
        kept: Int[Tensor, " K"],
        *,
        fitted: bool,
        hold: bool = False,
    ) -> None:
        records = [model.scaler.normalise(record)]
        errors = SimulationErrors(model.lfr.cell, records, solve_initial_states=not fitted)
        self.record, self.kept = record, kept
        self.basis: Tensor | None = None
        """Directions (K, m) of the kept parameters; ``blocks`` yields their columns if given."""
        _, (self.trajectory,) = errors.evaluate(errors.first_theta())
        self.group: RecordGroup = errors.groups[0].counted(self.trajectory.y)
        periodic, self.estimated = self.group.start.periodic, self.group.start.fitted
        self._along = Linearisation(
            model.lfr.cell, self.group.u, self.trajectory, periodic=periodic
        )
        self._held: list[tuple[slice, Tensor]] | None = [] if hold else None
        self._weight = self.group.weight if fitted else self.group.start_weight
        self._inverse = self.group.y.new_zeros(0, 0)  # R⁻¹ of the weighted rows X: X R⁻¹ is Q
        self._initial: Tensor | None = None  # dx0/dθ
        K, nx = len(kept), model.lfr.cell.nx
        if not torch.isfinite(self.trajectory.y).all():
            return
        if periodic:
            *_, (_, _, end) = self._blocks(start=True)
            self._initial = fixed_point(end[None, :, K:], end[None, :, :K])[0]
        elif self.estimated:
            total = QRAccumulator()
            for rows in self._start_rows():
                total.fold(rows)
            R = total.R[:nx]
            self._inverse = torch.linalg.pinv(R[:, :nx], rtol=_SEEN)
            self._initial = -self._inverse @ R[:, nx:]

    @property
    def errors(self) -> Float[Tensor, "T ny"]:
        """Simulated minus measured output."""
        return (self.trajectory.y - self.group.y)[0]

    def blocks(self) -> Iterator[tuple[slice, Float[Tensor, "B ny C"]]]:
        """Yield samples and their rows; nx columns of an estimated start state come last."""
        K = len(self.kept)
        for time, rows in self._held or self._moved():
            if self.basis is None:
                yield time, rows
            else:
                yield time, torch.cat([rows[..., :K] @ self.basis, rows[..., K:]], -1)

    def _moved(self) -> Iterator[tuple[slice, Float[Tensor, "B ny C"]]]:
        """Samples and their rows by the kept parameters, which move the start state, too."""
        K = len(self.kept)
        for time, found, _ in self._blocks(start=self._initial is not None):
            rows = found
            if self._initial is not None:
                own = found[..., :K] + found[..., K:] @ self._initial
                rows = torch.cat([own, found[..., K:]], -1) if self.estimated else own
            if self._held is not None:
                self._held.append((time, rows))
            yield time, rows

    def weighted(self) -> Iterator[tuple[slice, Float[Tensor, "m ny K"], Float[Tensor, "m ny"]]]:
        """Yield columns and errors, weighted as in a fit; by line real, then imaginary parts."""
        group, m = self.group, len(self.kept) if self.basis is None else self.basis.shape[1]
        for time, rows in self.blocks():
            part, errors = rows[None, ..., :m], self.errors[None, time]
            yield time, group.weigh(part, time=time)[0], group.weigh(errors, time=time)[0]

    def _blocks(self, *, start: bool) -> Iterator[tuple[slice, Tensor, Tensor]]:
        out = None
        if self.group.spectral:  # a spectrum is taken of the whole record
            columns = len(self.kept) + self._along.state.shape[1] * start
            out = self.group.y.new_empty(*self.group.y.shape, columns)
        for block in self._along.rows(self.kept, initial_state=start, out=out):
            yield block.time, block.rows[0], block.end[0]

    def start_factor(self, noise: NoiseModel) -> Float[Tensor, "nx m"]:
        """S, so that S Sᵀ is what noise adds to the covariance of an estimated start state."""
        nx, ny = len(self._inverse), self.group.y.shape[2]
        total = GramAccumulator()
        for rows in self._start_rows():
            total.fold(noise.coloured((rows[:, :nx] @ self._inverse).unflatten(0, (-1, ny))))
        return self._inverse @ root(total.G)

    def _start_rows(self) -> Iterator[Float[Tensor, "m C"]]:
        """Weighted rows of the start state, then of the parameters."""
        assert self._weight is not None
        K = len(self.kept)
        for time, rows, _ in self._blocks(start=True):
            weight = self._weight[0, time].unsqueeze(-1)
            yield (torch.cat([rows[..., K:], rows[..., :K]], -1) * weight).flatten(0, 1)


def root(G: Float[Tensor, "n n"]) -> Float[Tensor, "n n"]:
    """R with R Rᵀ = G, for a matrix that is positive semidefinite up to rounding errors."""
    values, vectors = torch.linalg.eigh((G + G.mT) / 2)
    return vectors * values.clamp_min(0.0).sqrt()
