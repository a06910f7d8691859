"""Jacobian of the residual: its least-squares system and its products with vectors.

A step of the search solves a least-squares problem with J, which has a row for every sample and
output and a column for every parameter. For long records J is too large to hold, and the step does
not need it: a small matrix with the same JᵀJ will do. So the rows are computed block by block, each
block is folded into an accumulator (``linear_systems``), and is then dropped. Columns that are
combinations of others (``gauge``) are not computed at all.

If the rows take little memory they are cached, and J dθ and Jᵀ e are products with them. Otherwise
each product is a recurrence over the records (``sensitivity``).
"""

from __future__ import annotations

import math
import weakref
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lfrtorch._support.threads import spread
from lfrtorch.distributed import Ranks
from lfrtorch.engine.sensitivity import Linearisation, Rows, fixed_point, output_jacobian
from lfrtorch.least_squares.gauge import Reduction, everything
from lfrtorch.least_squares.linear_systems import (
    BroadcastSystem,
    CholeskySystem,
    GramAccumulator,
    QRAccumulator,
    ReducedSystem,
    SVDSystem,
    System,
)
from lfrtorch.least_squares.output_columns import OutputColumns
from lfrtorch.least_squares.record_groups import RecordGroup
from lfrtorch.least_squares.start_states import EliminatedSystem, Eliminator, StartStates
from lfrtorch.least_squares.term import PenaltyRows, TermRows

NORMAL = 1e4
"""Relative damping, in rounding errors, above which the normal equations are as good as QR."""

SPECTRA = 16
"""Columns that are turned into spectra at once, which need copies."""

CACHED_BYTES = 1 << 27
"""Rows are cached up to this size, all groups together."""


class Jacobian:
    """J (M, P) of a residual at one θ."""

    # ``fixed`` columns are zeros. ``reduced`` is of the shared parameters alone if the parts
    # eliminate start states.

    def __init__(
        self,
        parts: Sequence[TermRows | PenaltyRows],
        reduced: Reduction,
        fixed: Bool[Tensor, " P"],
        ranks: Ranks,
        bounded: Callable[[System], System] = lambda system: system,
    ) -> None:
        self.parts, self._reduced, self._fixed = parts, reduced, fixed
        self.ranks, self._bounded = ranks, bounded
        self._zeros = reduced.expand.new_zeros(len(fixed))
        self._shared = reduced.expand.shape[1]
        """Number of parameters whose columns all records have."""

    def system(self, damping: float, truncation: float) -> tuple[System, Float[Tensor, " P"]]:
        """The least-squares system of J and its gradient Jᵀr; see the search's ``Jacobian``."""
        gram = damping > NORMAL * torch.finfo(self._zeros.dtype).eps
        total = GramAccumulator() if gram else QRAccumulator()
        # Rows [J r] of outputs in the kept columns. Those of a penalty are added to all columns:
        # they are no combinations.
        penalty, slope, states, room = self._zeros, self._zeros, [], CACHED_BYTES
        for part in self.parts:
            if isinstance(part, PenaltyRows):
                penalty = penalty + part.diagonal.square()
                slope = slope + part.diagonal * part.residual
            else:
                room -= part.fold(self._reduced.kept, total, room)
                states += [] if part.states is None else [part.states]
        total.combine(self.ranks)
        penalty = penalty.masked_fill(self._fixed, 0.0)
        if states:
            system, gradient = self._eliminated(total, states, penalty, truncation)
        elif isinstance(total, GramAccumulator):
            system, gradient = self._normal(total.G, penalty)
        else:
            system, gradient = self._orthogonal(total.R, penalty, truncation)
        gradient = (gradient + slope).masked_fill(self._fixed, 0.0)
        system = self._bounded(system)
        if self.ranks.world == 1:
            return system, gradient
        return BroadcastSystem(system, self.ranks), self.ranks.first(gradient)

    def _normal(
        self, G: Float[Tensor, "columns columns"], penalty: Float[Tensor, " P"]
    ) -> tuple[System, Float[Tensor, " P"]]:
        """The system and the gradient, by the normal equations."""
        kept, expand = self._reduced
        G, gradient = G[:-1, :-1], expand.mT @ G[:-1, -1]
        free = penalty[~self._fixed]
        if bool((free == free[0]).all()) and not self._fixed[kept].any():
            return ReducedSystem(G, expand, float(free[0])), gradient
        # JᵀJ = expandᵀ G expand: the columns first, then the rows of a symmetric matrix.
        G = self._reduced.columns(self._reduced.columns(G).mT)
        G = G.masked_fill(self._fixed | self._fixed.unsqueeze(1), 0.0)
        rank = int((~self._fixed[kept]).sum())
        return CholeskySystem(G + torch.diag(penalty), rank), gradient

    def _orthogonal(
        self, R: Float[Tensor, "k columns"], penalty: Float[Tensor, " P"], truncation: float
    ) -> tuple[System, Float[Tensor, " P"]]:
        """The system and the gradient, by singular values."""
        R, r = self._reduced.columns(R[:, :-1]).masked_fill(self._fixed, 0.0), R[:, -1]
        rows = torch.cat([R, penalty.sqrt().diag()]) if penalty.any() else R
        return SVDSystem(rows, truncation), R.mT @ r

    def _eliminated(
        self,
        total: QRAccumulator | GramAccumulator,
        found: Sequence[StartStates],
        penalty: Float[Tensor, " P"],
        truncation: float,
    ) -> tuple[System, Float[Tensor, " P"]]:
        """The system and the gradient, the start states eliminated."""
        states = StartStates(*map(torch.cat, zip(*found, strict=True)))
        fixed = self._fixed[: self._shared]
        states = states._replace(A=states.A.masked_fill(fixed, 0.0))
        gram = isinstance(total, GramAccumulator)
        if gram:
            left, gradient = total.G[:-1, :-1], total.G[:-1, -1]
            left = left.masked_fill(fixed | fixed.unsqueeze(1), 0.0)
        else:
            left = total.R[:, :-1].masked_fill(fixed, 0.0)
            gradient = left.mT @ total.R[:, -1]
        whole = self._zeros.clone()
        whole[: self._shared] = gradient + torch.einsum("rij,ri->j", states.A, states.r)
        whole[states.place] = torch.einsum("rij,ri->rj", states.Vh, states.s * states.r)
        return EliminatedSystem(left, states, penalty, gram=gram, truncation=truncation), whole

    def tangent(self, d_theta: Float[Tensor, " P"]) -> Float[Tensor, " M"]:
        """J dθ."""
        d_theta = d_theta.masked_fill(self._fixed, 0.0)
        reduced = self._reduced.expand @ d_theta[: self._shared]
        return torch.cat([part.tangent(d_theta, reduced) for part in self.parts])

    def adjoint(self, residual: Float[Tensor, " M"]) -> Float[Tensor, " P"]:
        """Jᵀ residual."""
        gradient = self._zeros.clone()
        reduced = gradient.new_zeros(len(self._reduced.kept))
        each = residual.split([part.count for part in self.parts])
        for part, own in zip(self.parts, each, strict=True):
            part.adjoint(own, gradient, reduced)
        gradient[: self._shared] += self._reduced.expand.mT @ reduced
        return self.ranks.sum(gradient.masked_fill(self._fixed, 0.0))

    def whole(self) -> Float[Tensor, "M P"]:
        """J as one matrix, for small problems."""
        J = torch.cat([part.whole(len(self._fixed)) for part in self.parts])
        return J.masked_fill(self._fixed, 0.0)


class Memory:
    """Buffers for rows, handed on from one Jacobian to the next that asks for the same size."""

    # A fresh allocation took a fifth of an iteration on the parallel Wiener-Hammerstein benchmark.

    def __init__(self) -> None:
        self._free: dict[int, list[Tensor]] = {}

    def take(self, owner: object, shape: Sequence[int], like: Tensor) -> Tensor:
        """A buffer of that shape, until the owner is garbage."""
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


class _Cached(NamedTuple):
    """Weighted rows of each record, and where their first n columns stand among the kept ones."""

    # If the initial state of a record follows from the other parameters, its columns are the last
    # nx; otherwise C = n.

    rows: Float[Tensor, "R T*ny C"]
    places: Int[Tensor, "R n"]
    initial: Float[Tensor, "R nx n"] | None


class OutputRows:
    """The rows of one group of records."""

    # ``x0``: where the initial state of each record stands in θ, if they are parameters.

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
        """Kept parameters, those of them that move the initial state, and how."""

    def fold(
        self, kept: Int[Tensor, " K"], total: QRAccumulator | GramAccumulator, room: int
    ) -> int:
        """Add the weighted rows [J r] in the kept columns; bytes cached, at most ``room``."""
        group, linearisation = self.group, self.linearisation
        own = kept[kept < linearisation.parameters]
        nx = linearisation.state.shape[1]
        errors = linearisation.trajectory.y - group.y
        shape = (*errors.shape, len(own) + nx * self.has_initial_state + 1)
        size = math.prod(shape) * errors.element_size()
        cache = size <= room
        among_kept = torch.arange(len(own), device=own.device)
        direct = None
        plain = group.plain and not self._eliminate
        if isinstance(total, GramAccumulator) and plain and not cache:
            direct = OutputColumns(linearisation, own)
            own, among_kept = direct.without(own), direct.without(among_kept)
            shape = (*errors.shape, shape[-1] - len(direct.place))
        # A spectrum is taken of whole records, too.
        blocks = self._blocks(own, shape if cache or group.spectral else None)

        # The columns of the initial state turn into others, for each record in its own way. So each
        # record has an accumulator of its own then.
        each = self.has_initial_state
        accumulators = [type(total)() for _ in (group.u if each else group.u[:1])]
        eliminator = None
        if self._eliminate and self.x0 is not None:
            eliminator = Eliminator(self.x0, group.u.shape[1], total)
        end = errors.new_empty(len(errors), nx, shape[-1] - 1)
        for block in blocks:
            rows, records = block.rows, block.records
            rows[..., -1] = errors[records, block.time]
            if group.spectral:
                for columns in rows.split(SPECTRA, -1):
                    columns.copy_(group.weigh(columns, records))
            weighted = rows if group.spectral else group.weigh(rows, records, block.time)
            if cache and not group.plain and not group.spectral:
                rows.copy_(weighted)
            if eliminator is not None:
                eliminator.fold(weighted.flatten(1, 2), block.time)
            elif each:
                for accumulator, of_record in zip(accumulators[records], weighted, strict=True):
                    accumulator.fold(of_record.flatten(0, 1))
            else:
                accumulators[0].fold(weighted.flatten(0, 2))
            if direct is not None:
                for r, of_record in zip(range(len(errors))[records], rows, strict=True):
                    direct.fold(r if each else 0, r, block.time, of_record)
            end[records] = block.end

        places, initial = self._columns(kept, among_kept, end)
        self._tied = None if initial is None else (kept, places, initial)
        # The residual is the last column before and after.
        last = places.new_full((len(places), 1), len(kept))
        if eliminator is not None:
            self.states, accumulators = eliminator.found(), []
        for r, accumulator in enumerate(accumulators):
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

    def _blocks(self, own: Int[Tensor, " K"], shape: tuple[int, ...] | None) -> Iterable[Rows]:
        """The rows in those columns, written to a buffer if it has a shape."""
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
        among_kept: Int[Tensor, " K"],
        end: Float[Tensor, "R nx C"],
    ) -> tuple[Int[Tensor, "R n"], Float[Tensor, "R nx n"] | None]:
        """Where the columns of each record stand among the kept ones, and dx0/dθ if it is tied."""
        # The first K are the same for all. An initial state that is a parameter has places of its
        # own. That of a periodic record depends on the other parameters, dx0/dθ = (I - Φ)⁻¹ end.
        K = len(among_kept)
        places = among_kept.to(end.device).expand(len(end), K)
        if self.linearisation.periodic:
            return places, fixed_point(end[:, :, K:], end[:, :, :K])
        if self.x0 is not None and not self._eliminate:
            before = (kept < self.linearisation.parameters).sum()
            own = self.x0.to(end.device) - self.linearisation.parameters + before
            places = torch.cat([places, own], dim=1)
        return places, None

    def tangent(
        self, d_theta: Float[Tensor, " P"], reduced: Float[Tensor, " K"]
    ) -> Float[Tensor, " count"]:
        """Weighted changes of the outputs: J dθ, given as well in the kept columns."""
        if self._cached is not None:
            rows, places, initial = self._cached
            by_column = reduced[places]
            if initial is not None:
                d_x0 = (initial @ by_column.unsqueeze(-1)).squeeze(-1)
                by_column = torch.cat([by_column, d_x0], dim=1)
            elif self._eliminate:
                by_column = torch.cat([by_column, d_theta[self.x0]], dim=1)
            d_y = rows.new_empty(rows.shape[:2])
            spread(_product, len(rows), rows, by_column, d_y)
            return d_y.flatten()
        linearisation = self.linearisation
        d_x0 = None if self.x0 is None else d_theta[self.x0]
        if self._tied is not None:
            # Another change with the same outputs: of the kept parameters alone.
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
        """Add Jᵀ residual to the gradient, or to the one in the kept columns if there are rows."""
        if self._cached is not None:
            rows, places, initial = self._cached
            by_column = rows.new_empty(len(rows), rows.shape[2])
            spread(_product, len(rows), rows.mT, residual.reshape(len(rows), -1), by_column)
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


class MappedRows:
    """w J_φ dφ/dθ: weighted rows for parameters φ that follow from θ; they eliminate no states."""

    states: StartStates | None = None

    def __init__(self, rows: OutputRows, change: Float[Tensor, "Q P"], weight: float) -> None:
        self._rows, self._change, self._weight = rows, weight * change, weight
        self._every, self.count = everything(change[:, 0]), rows.count

    def fold(
        self, kept: Int[Tensor, " K"], total: QRAccumulator | GramAccumulator, room: int
    ) -> int:
        """Add the rows [J r], in the kept columns, to the accumulator; see ``TermRows``."""
        own = type(total)()
        cached = self._rows.fold(self._every.kept, own, room)
        change = self._change[:, kept]
        total.absorb_mapped(own, torch.block_diag(change, change.new_tensor([[self._weight]])))
        return cached

    def tangent(
        self, d_theta: Float[Tensor, " P"], reduced: Float[Tensor, " K"]
    ) -> Float[Tensor, " count"]:
        """J dθ."""
        d_phi = self._change @ d_theta
        return self._rows.tangent(d_phi, d_phi)

    def adjoint(
        self,
        residual: Float[Tensor, " count"],
        gradient: Float[Tensor, " P"],
        reduced: Float[Tensor, " K"],
    ) -> None:
        """Add Jᵀ residual to the gradient."""
        by_phi = residual.new_zeros(len(self._change))
        self._rows.adjoint(residual, by_phi, by_phi)
        gradient += self._change.mT @ by_phi

    def whole(self, parameters: int) -> Float[Tensor, "count P"]:
        """All rows."""
        return self._rows.whole(len(self._change)) @ self._change


def _product(
    r: int,
    matrices: Float[Tensor, "R m n"],
    vectors: Float[Tensor, "R n"],
    out: Float[Tensor, "R m"],
) -> None:
    """A job of ``spread``: the matrix of one record times its vector."""
    torch.mv(matrices[r], vectors[r], out=out[r])
