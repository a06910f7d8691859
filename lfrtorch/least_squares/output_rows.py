"""Rows of the Jacobian of simulated outputs, folded block by block into a least-squares system.

If the rows take little memory they are cached, and J dθ and Jᵀ e are products with them. Otherwise
each product is a recurrence over the records (``sensitivity``).
"""

from __future__ import annotations

import math
import weakref
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from lfrtorch._support.threads import has_kernels, spread
from lfrtorch.engine.sensitivity import Linearisation, Rows, fixed_point, output_jacobian
from lfrtorch.least_squares.linear_systems import GramAccumulator, QRAccumulator
from lfrtorch.least_squares.output_columns import OutputColumns
from lfrtorch.least_squares.record_groups import RecordGroup
from lfrtorch.least_squares.start_states import Eliminator, StartStates

MANY = 64
"""Number of records from which one call computes the products of all records."""

SPECTRA = 16
"""Number of columns that are transformed to spectra at once, as spectra need copies."""


class Memory:
    """Buffers for rows; a Jacobian takes over the buffer of an earlier one of the same size."""

    # New allocations took a fifth of an iteration on the parallel Wiener-Hammerstein benchmark.

    def __init__(self) -> None:
        self._free: dict[int, list[Tensor]] = {}

    def take(self, owner: object, shape: Sequence[int], like: Tensor) -> Tensor:
        """A buffer of that shape, until the owner is garbage-collected."""
        size = math.prod(shape)
        if self._free.get(size):
            buffer = self._free[size].pop()
        else:
            self._free.clear()  # the free buffers have other sizes
            buffer = like.new_empty(size)
        weakref.finalize(owner, self._give, buffer)
        return buffer.view(*shape)

    def _give(self, buffer: Tensor) -> None:
        self._free.setdefault(buffer.numel(), []).append(buffer)


class _Cached(NamedTuple):
    """Weighted rows of each record, and the places of their first n columns among the kept ones."""

    # If the initial state of a record depends on the other parameters, the last nx columns are
    # those of the initial state; otherwise C = n.

    rows: Float[Tensor, "R T*ny C"]
    places: Int[Tensor, "R n"]
    initial: Float[Tensor, "R nx n"] | None


class OutputRows:
    """The rows of one group of records."""

    # ``x0`` has the places in θ of each record's initial state, if initial states are parameters.

    def __init__(
        self,
        group: RecordGroup,
        linearisation: Linearisation,
        x0: Int[Tensor, "R nx"] | None,
        memory: Memory,
        *,
        eliminate: bool = False,
    ) -> None:
        self.group, self.linearisation, self.x0, self._memory = group, linearisation, x0, memory
        self._eliminate = eliminate and x0 is not None
        self.count = group.y.numel()
        self.has_initial_state = linearisation.periodic or x0 is not None
        """Whether the rows have columns of the initial state."""
        self.states: StartStates | None = None
        """The initial states that the last ``fold`` eliminated."""
        self._buffer: Tensor | None = None
        self._cached: _Cached | None = None
        self._tied: tuple[Tensor, Tensor, Tensor] | None = None
        """Kept parameters, those of them that change the initial state, and its derivative."""

    def fold(
        self, kept: Int[Tensor, " K"], total: QRAccumulator | GramAccumulator, room: int
    ) -> int:
        """Add weighted rows [J r] in the kept columns; return the bytes cached, up to ``room``."""
        group, linearisation = self.group, self.linearisation
        P = linearisation.parameters
        own = kept if int(kept[-1]) < P else kept[kept < P]  # ascending
        nx, start = linearisation.weights.nx, self.has_initial_state
        errors = linearisation.trajectory.y - group.y
        shape = (*errors.shape, len(own) + nx * start + 1)
        size = math.prod(shape) * errors.element_size()
        cache, direct = size <= room, None
        columns = own
        if isinstance(total, GramAccumulator) and group.plain and not (self._eliminate or cache):
            direct = OutputColumns(linearisation, own)
            columns = direct.without(own)
            shape = (*errors.shape, shape[-1] - len(direct.place))
        # Columns of an initial state are combined with or placed among other columns, in another
        # way for each record. So each record then has its own accumulator.
        eliminator, sums = None, [total]
        if self._eliminate and self.x0 is not None:
            eliminator = Eliminator(self.x0, group.u.shape[1], total)
        elif start:
            sums = [type(total)() for _ in group.u]
        elif direct is not None or len(own) < len(kept):
            sums = [type(total)()]
        end = errors.new_empty(len(errors), nx, shape[-1] - 1)
        # A spectrum also needs the rows of whole records.
        for block in self._blocks(columns, shape if cache or group.spectral else None):
            rows, records = block.rows, block.records
            rows[..., -1] = errors[records, block.time]
            weighted = self._weighted(rows, records, block.time, keep=cache)
            if eliminator is not None:
                eliminator.fold(weighted.flatten(1, 2), block.time)
            elif start:
                for accumulator, of_record in zip(sums[records], weighted, strict=True):
                    accumulator.fold(of_record.flatten(0, 1))
            else:
                sums[0].fold(weighted.flatten(0, 2))
            if direct is not None:
                for r, of_record in zip(range(len(errors))[records], rows, strict=True):
                    direct.fold(r if start else 0, r, block.time, of_record)
            end[records] = block.end
        if eliminator is not None:
            self.states = eliminator.found()
        places, initial = self._columns(kept, own, direct, end)
        self._tied = None if initial is None else (kept, places, initial)
        if eliminator is None and sums[0] is not total:
            # The residual is the last column in both numberings.
            last = places.new_full((len(places), 1), len(kept))
            for r, accumulator in enumerate(sums):
                place = torch.cat([places, last], dim=1)[r]
                tie = None if initial is None else initial[r]
                total.absorb(accumulator, place, len(kept) + 1, tie)
                if direct is not None and isinstance(total, GramAccumulator):
                    total.add(direct.products(r, place, len(kept) + 1, tie))
        if not cache:
            return 0
        assert self._buffer is not None
        self._cached = _Cached(self._buffer[..., :-1].flatten(1, 2), places, initial)
        return size

    def _weighted(self, rows: Tensor, records: slice, time: slice, *, keep: bool) -> Tensor:
        """Weighted rows; they overwrite the rows if these are kept or are spectra."""
        group = self.group
        if group.plain:
            return rows
        if group.spectral:
            for part in rows.split(SPECTRA, -1):
                part.copy_(group.weigh(part, records))
            return rows
        weighted = group.weigh(rows, records, time)
        return rows.copy_(weighted) if keep else weighted

    def _blocks(self, own: Int[Tensor, " K"], shape: tuple[int, ...] | None) -> Iterable[Rows]:
        """The rows in the columns ``own``, written to a buffer if ``shape`` is given."""
        if shape is not None and (self._buffer is None or self._buffer.shape != shape):
            self._buffer = self._memory.take(self, shape, self.group.y)
        return self.linearisation.rows(
            own,
            initial_state=self.has_initial_state,
            spare=1,
            out=self._buffer if shape is not None else None,
        )

    def _columns(
        self,
        kept: Int[Tensor, " all"],
        own: Int[Tensor, " K"],
        direct: OutputColumns | None,
        end: Float[Tensor, "R nx C"],
    ) -> tuple[Int[Tensor, "R n"], Float[Tensor, "R nx n"] | None]:
        """Places of each record's columns among the kept ones, and dx0/dθ if x0 depends on θ."""
        # The first K places are the same for all records. An initial state that is a parameter has
        # its own places. The initial state of a periodic record depends on the other parameters:
        # dx0/dθ = (I - Φ)⁻¹ end.
        among_kept = torch.arange(len(own), device=end.device)
        among_kept = among_kept if direct is None else direct.without(among_kept)
        K = len(among_kept)
        places = among_kept.expand(len(end), K)
        if self.linearisation.periodic:
            return places, fixed_point(end[:, :, K:], end[:, :, :K])
        if self.x0 is not None and not self._eliminate:
            at = self.x0.to(end.device) - self.linearisation.parameters + len(own)
            places = torch.cat([places, at], dim=1)
        return places, None

    def tangent(
        self, d_theta: Float[Tensor, " P"], reduced: Float[Tensor, " K"]
    ) -> Float[Tensor, " count"]:
        """Weighted changes of the outputs, J dθ; ``reduced`` is dθ in the kept columns."""
        if self._cached is not None:
            rows, places, initial = self._cached
            by_column = reduced[places]
            if initial is not None:
                d_x0 = (initial @ by_column.unsqueeze(-1)).squeeze(-1)
                by_column = torch.cat([by_column, d_x0], dim=1)
            elif self._eliminate:
                by_column = torch.cat([by_column, d_theta[self.x0]], dim=1)
            return _product(rows, by_column).flatten()
        linearisation = self.linearisation
        d_x0 = None if self.x0 is None else d_theta[self.x0]
        if self._tied is not None:
            # A change of the kept parameters alone that changes the outputs in the same way.
            kept, places, initial = self._tied
            d_theta = torch.zeros_like(d_theta).index_put_((kept,), reduced)
            d_x0 = (initial @ reduced[places].unsqueeze(-1)).squeeze(-1)
        d_y = linearisation.tangent(d_theta[: linearisation.parameters], d_x0)
        return self.group.weigh(d_y).flatten()

    def adjoint(
        self,
        residual: Float[Tensor, " count"],
        gradient: Float[Tensor, " P"],
        reduced: Float[Tensor, " K"],
    ) -> None:
        """Add Jᵀ residual to the gradient, or to ``reduced`` if rows are cached."""
        if self._cached is not None:
            rows, places, initial = self._cached
            by_column = _product(rows.mT, residual.reshape(len(rows), -1))
            if initial is not None:
                by_column, d_x0 = by_column.split([places.shape[1], initial.shape[1]], dim=1)
                by_column = by_column + (initial.mT @ d_x0.unsqueeze(-1)).squeeze(-1)
            elif self._eliminate and self.x0 is not None:
                by_column, d_x0 = by_column.split([places.shape[1], self.x0.shape[1]], dim=1)
                gradient[self.x0] += d_x0
            reduced.index_add_(0, places.flatten(), by_column.flatten())
            return
        errors = residual.reshape(self.group.y.shape)
        adjoint = self.linearisation.adjoint(self.group.unweigh(errors))
        gradient[: self.linearisation.parameters] += adjoint.theta.sum(0)
        if self.x0 is not None:
            gradient[self.x0] += adjoint.x0

    def whole(self, parameters: int) -> Float[Tensor, "count P"]:
        """All rows, with as many columns as θ has parameters."""
        rows, P = output_jacobian(self.linearisation), self.linearisation.parameters
        J = rows.new_zeros(*rows.shape[:3], parameters)
        J[..., :P] = rows[..., :P]
        if self.x0 is not None:
            for r, own_columns in enumerate(self.x0):
                J[r][..., own_columns] = rows[r, ..., P:]
        return self.group.weigh(J).flatten(0, 2)


def _product(
    matrices: Float[Tensor, "R m n"], vectors: Float[Tensor, "R n"]
) -> Float[Tensor, "R m"]:
    """The matrix of each record times its vector; the threads share the records."""
    if len(matrices) == 1:
        return torch.mv(matrices[0], vectors[0]).unsqueeze(0)
    if len(matrices) > MANY and has_kernels(matrices):
        return torch.from_numpy(np.matmul(matrices.numpy(), vectors.numpy()[..., None])[..., 0])
    out = vectors.new_empty(matrices.shape[:2])

    def one(r: int) -> None:
        torch.mv(matrices[r], vectors[r], out=out[r])

    spread(one, len(out))
    return out
