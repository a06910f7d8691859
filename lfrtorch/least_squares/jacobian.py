"""Jacobian of the residual: its least-squares system and its products with vectors.

With the columns of gauge directions left out (``gauge``), rows come in blocks and are folded into
a running factor. Where they are few they are kept, and products with vectors are products with
them; where they are not, memory does not grow with the records, and such a product is a recurrence.
"""

from __future__ import annotations

import math
import weakref
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from lfrtorch._threads import spread
from lfrtorch.distributed import Ranks
from lfrtorch.engine.sensitivity import Linearisation, closed, output_jacobian
from lfrtorch.least_squares.gauge import Reduction
from lfrtorch.least_squares.linear_systems import Agreed, Gram, Normal, Orthogonal, System, Triangle
from lfrtorch.least_squares.record_groups import EVERY, Batch

NORMAL = 1e4
"""Relative damping, in rounding errors, above which the normal equations are as good as QR."""

KEPT_BYTES = 1 << 27
"""Rows up to this size, of all batches, are kept."""


class Jacobian:
    """J (M, P) of a residual at one θ.

    Args:
        parts: of each batch.
        reduced: the columns that are computed.
        ridge: factors (P,) of θ - θ_start in the residual of the first process, after the batches.
        penalty: θ - θ_start (P,).
        ranks: the processes that hold the parts.
        fixed: entries (P,) of θ that are constants: columns of zeros, none where left out.
    """

    def __init__(
        self,
        parts: list[Part],
        reduced: Reduction,
        ridge: Tensor,
        penalty: Tensor,
        ranks: Ranks,
        fixed: Tensor | None = None,
    ) -> None:
        self.parts, self._reduced, self._ranks = parts, reduced, ranks
        self._fixed = torch.zeros_like(ridge, dtype=torch.bool) if fixed is None else fixed
        self._ridge, self._penalty = ridge.masked_fill(self._fixed, 0.0), penalty
        self._penalised = bool(ridge.any())  # its rows are there, whatever is fixed
        self._own_penalty = self._penalised and ranks.rank == 0

    def system(self, damping: float, truncation: float) -> tuple[System, Tensor]:
        """The least-squares system of J and its gradient Jᵀr (P,).

        Args:
            damping: that of the next trial relative to the largest eigenvalue of JᵀJ.
            truncation: relative size of singular values that are left out.
        """
        kept, expand = self._reduced
        precise = damping <= NORMAL * torch.finfo(expand.dtype).eps
        factor = Triangle() if precise else Gram()
        room = KEPT_BYTES
        for part in self.parts:
            room -= part.fold(kept, factor, room)  # [J r] in the kept columns
        factor.combine(self._ranks)
        if isinstance(factor, Triangle):
            R, r = self._reduced.columns(factor.R[:, :-1]), factor.R[:, -1]
            R = R.masked_fill(self._fixed, 0.0)
            gradient = R.mT @ r
            rows = [R, torch.diag(self._ridge)] if self._penalised else [R]
            system = Orthogonal(torch.cat(rows), truncation)
        else:
            gradient = (expand.mT @ factor.G[:-1, -1]).masked_fill(self._fixed, 0.0)
            G = self._reduced.columns(self._reduced.columns(factor.G[:-1, :-1]).mT)
            G = G.masked_fill(self._fixed | self._fixed.unsqueeze(1), 0.0)
            rank = int((~self._fixed[kept]).sum())
            system = Normal(G + torch.diag(self._ridge.square()), rank)
        gradient = gradient + self._ridge.square() * self._penalty
        if self._ranks.world == 1:
            return system, gradient
        return Agreed(system, self._ranks), self._ranks.first(gradient)

    def tangent(self, d_theta: Tensor) -> Tensor:
        """J d_theta (M,)."""
        d_theta = d_theta.masked_fill(self._fixed, 0.0)
        reduced = self._reduced.expand @ d_theta
        parts = [part.tangent(d_theta, reduced).flatten() for part in self.parts]
        return torch.cat([*parts, *([self._ridge * d_theta] if self._own_penalty else [])])

    def adjoint(self, residual: Tensor) -> Tensor:
        """Jᵀ residual (P,)."""
        gradient = torch.zeros_like(self._ridge)
        reduced = gradient.new_zeros(len(self._reduced.kept))
        first = 0
        for part in self.parts:
            shape = part.batch.residual_shape
            own = residual[first : first + shape.numel()].reshape(shape)
            first += own.numel()
            part.adjoint(own, gradient, reduced)
        gradient = gradient + self._reduced.expand.mT @ reduced
        if self._own_penalty:
            gradient = gradient + self._ridge * residual[first:]
        return self._ranks.sum(gradient.masked_fill(self._fixed, 0.0))

    def whole(self) -> Tensor:
        """J (M, P): for a look at it, and for small problems."""
        parts = [part.whole(len(self._ridge)).flatten(0, 2) for part in self.parts]
        J = torch.cat([*parts, *([torch.diag(self._ridge)] if self._own_penalty else [])])
        return J.masked_fill(self._fixed, 0.0)


class Memory:
    """Where rows are kept, handed on from one Jacobian to the next that asks for the same size.

    To map large blocks anew took a fifth of an iteration at parallel Wiener-Hammerstein size.
    """

    def __init__(self) -> None:
        self._free: dict[int, list[Tensor]] = {}

    def take(self, owner: object, shape: Sequence[int], like: Tensor) -> Tensor:
        """Room of that shape until the owner is gone."""
        size = math.prod(shape)
        if self._free.get(size):
            buffer = self._free[size].pop()
        else:
            self._free.clear()  # other sizes than before
            buffer = like.new_empty(size)
        weakref.finalize(owner, self._give, buffer)
        return buffer.view(*shape)

    def _give(self, buffer: Tensor) -> None:
        self._free.setdefault(buffer.numel(), []).append(buffer)


class _Kept(NamedTuple):
    """Weighted rows, where their columns stand among the kept ones, and what mixes them before.

    Shape:
        rows: (R, m ny, C), places: (R, n), mix: (R, C, n) or none for n = C.
    """

    rows: Tensor
    places: Tensor
    mix: Tensor | None


class Part:
    """The rows of one batch.

    Args:
        batch: the records.
        linearisation: the model along them.
        x0: where the start state (nx) of each record stands in θ, if they are parameters.
        memory: where rows are kept.

    Shape:
        x0: (R, nx).
    """

    def __init__(
        self, batch: Batch, linearisation: Linearisation, x0: Tensor | None, memory: Memory
    ) -> None:
        self.batch, self.linearisation, self.x0, self._memory = batch, linearisation, x0, memory
        self._rows: Tensor | None = None
        self._kept: _Kept | None = None
        self.computed: tuple[Tensor, Tensor] | None = None
        """All rows (R, T, ny, P [+ nx] + 1) and the end state's, where another computed them."""

    @property
    def has_start(self) -> bool:
        """Whether the rows have columns of the start state."""
        return self.linearisation.periodic or self.x0 is not None

    def fold(self, kept: Tensor, total: Triangle | Gram, room: int) -> int:
        """Add the rows [J r], in the kept columns (K,), to the factor.

        Rows are kept where they fit into so many bytes, which are returned.
        """
        batch, linearisation = self.batch, self.linearisation
        own = kept[kept < linearisation.parameters]
        K, nx = len(own), linearisation.state.shape[1]
        start = self.has_start
        errors = linearisation.trajectory.y - batch.y
        R, T, ny = errors.shape
        columns = K + nx * start + 1
        whole = R * T * ny * columns * errors.element_size() <= room
        computed, self.computed = self.computed, None  # they are weighted in place, once
        if computed is not None:
            rows = computed[0]
        else:
            kind = torch.Size((R, T, ny, columns))
            if (whole or batch.spectral) and (self._rows is None or self._rows.shape != kind):
                self._rows = self._memory.take(self, kind, errors)
            rows = self._rows if whole or batch.spectral else None
        # The start state's columns become others in each record's own way.
        factors = [type(total)() for _ in batch.u] if start else [type(total)()]

        def visit(records: slice, time: slice, block: Tensor) -> None:
            block[..., -1] = errors[records, time]
            if batch.spectral:
                if time.stop < T:
                    return
                assert rows is not None
                block, time = rows[records], EVERY
            weighted = batch.weigh(block, records, time)
            if rows is not None and not batch.plain and not batch.spectral:
                block.copy_(weighted)
            if start:
                for factor, of_record in zip(factors[records], weighted, strict=True):
                    factor.fold(of_record.flatten(0, 1))
            else:
                factors[0].fold(weighted.flatten(0, 2))

        if computed is not None:
            visit(slice(0, R), slice(0, T), computed[0])
            end = computed[1]
        else:
            end = linearisation.rows(own, visit, start=start, spare=1, out=rows)
        # In periodic steady state the start's columns go over into the others, which then stand at
        # these places among the kept ones; estimated starts have places of their own.
        width = len(kept) + 1
        places = torch.arange(K, device=end.device).expand(R, K)
        mix = None
        if linearisation.periodic:
            identity = torch.eye(K).to(end).expand(R, K, K)
            mix = torch.cat([identity, closed(end[:, :, K:], end[:, :, :K])], dim=1)
        elif self.x0 is not None:
            own_places = self.x0.to(end.device) - linearisation.parameters + K
            places = torch.cat([places, own_places], dim=1)
        last = places.new_full((R, 1), width - 1)
        for r, factor in enumerate(factors):
            with_residual = None if mix is None else torch.block_diag(mix[r], end.new_ones(1, 1))
            total.absorb(factor, torch.cat([places, last], dim=1)[r], width, with_residual)
        if whole and rows is not None and not batch.spectral:
            self._kept = _Kept(rows[..., :-1].flatten(1, 2), places, mix)
            return rows.numel() * rows.element_size()
        return 0

    def tangent(self, d_theta: Tensor, reduced: Tensor) -> Tensor:
        """Weighted changes (R, m, ny) of the outputs with θ (P,), or its kept columns (K,)."""
        if self._kept is not None:
            rows, places, mix = self._kept
            by_column = reduced[places]
            if mix is not None:
                by_column = (mix @ by_column.unsqueeze(-1)).squeeze(-1)
            d_y = rows.new_empty(rows.shape[:2])
            spread(_product, len(rows), rows, by_column, d_y)
            return d_y.reshape(self.batch.residual_shape)
        linearisation = self.linearisation
        d_x0 = None if self.x0 is None else d_theta[self.x0]
        d_y = linearisation.tangent(d_theta[: linearisation.parameters], d_x0)
        return self.batch.weigh(d_y)

    def adjoint(self, residual: Tensor, gradient: Tensor, reduced: Tensor) -> None:
        """Add Jᵀ residual (R, m, ny) to the one by θ (P,), or by its kept columns (K,)."""
        if self._kept is not None:
            rows, places, mix = self._kept
            by_column = rows.new_empty(len(rows), rows.shape[2])
            spread(_product, len(rows), rows.mT, residual.reshape(len(rows), -1), by_column)
            if mix is not None:
                by_column = (mix.mT @ by_column.unsqueeze(-1)).squeeze(-1)
            reduced.index_add_(0, places.flatten(), by_column.flatten())
            return
        adjoint = self.linearisation.adjoint(self.batch.unweigh(residual))
        gradient[: self.linearisation.parameters] += adjoint.theta.sum(0)
        if self.x0 is not None:
            gradient[self.x0] += adjoint.x0

    def whole(self, parameters: int) -> Tensor:
        """All weighted rows (R, m, ny, P)."""
        rows, P = output_jacobian(self.linearisation), self.linearisation.parameters
        J = rows.new_zeros(*rows.shape[:3], parameters)
        J[..., :P] = rows[..., :P]
        if self.x0 is not None:
            for r, own_columns in enumerate(self.x0):
                J[r][..., own_columns] = rows[r, ..., P:]
        return self.batch.weigh(J)


def _product(r: int, matrices: Tensor, vectors: Tensor, out: Tensor) -> None:
    torch.mv(matrices[r], vectors[r], out=out[r])
