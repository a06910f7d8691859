"""Derivatives of the simulated output with respect to every parameter of the cell.

With v = [x; u; w] the model is linear in its matrices::

    x+ = [A Bu Bw] v      z = [Cz Dzu 0] v      y = [Cy Dyu Dyw] v      w = f(z; φ)

so the direct terms of a parameter are entries of v, but for those of the static map. The indirect
ones, through the state, are one linear recurrence::

    S(k+1) = F(k) S(k) + G(k),    dy(k)/dθ = H(k) S(k) + E(k)

in three ways: for all parameters at once (``rows``), for one direction dθ (``tangent``) and, back
in time, for one combination of outputs (``adjoint``). Time is passed in blocks, so that memory
does not grow with the length of a record.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from lfrtorch._threads import spread, workers
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.jacobian_kernel import emit
from lfrtorch.engine.linearised import PASS, Slopes, of_static, slopes_at
from lfrtorch.engine.parameter_layout import Columns, layout
from lfrtorch.engine.recurrence import (
    adjoint_recurrence,
    has_kernels,
    linear_recurrence,
    to_numpy,
)
from lfrtorch.engine.simulate import Trajectory
from lfrtorch.engine.static_jacobian import NetworkSlopes, StaticSlopes, static_slopes

FADED = 1e-18
"""What is left of a start state, relative to it, that counts as nothing."""

BLOCK = 8192
"""Samples of all records together in a block of rows on the CPU."""


class Adjoint(NamedTuple):
    """Derivatives of Σ e(k) · y(k).

    Shape:
        theta: (R, P), each record's own; u: (R, T, nu); x0: (R, nx).
    """

    theta: Tensor
    u: Tensor
    x0: Tensor


class _Block:
    """The model linearised at neighbouring samples of some records.

    Shape:
        v: (R, B, nx + nu + nw).
    """

    def __init__(
        self, time: slice, v: Tensor, static: StaticSlopes, weights: dict[str, Tensor]
    ) -> None:
        self.time, self.v, self.static, self.weights = time, v, static, weights

    @cached_property
    def slopes(self) -> Slopes:
        """x+ = F x, y = H x."""
        return slopes_at(self.weights, self.static.J)


class Linearisation:
    """The model linearised along a trajectory.

    Args:
        cell: the model; parameters with ``requires_grad=False`` are no part of θ. Its weights are
            copied. They may have a leading axis of length R: one model a record.
        u: input of the trajectory.
        trajectory: of this cell.
        periodic: the start state is the end state, whatever the parameters. Otherwise it does not
            depend on them.
        weights: of the cell in the order of its parameters where they are not those that it holds
            now; all of them are θ then.

    Shape:
        u: (R, T, nu).
    """

    @torch.no_grad()
    def __init__(
        self,
        cell: LFRCell,
        u: Tensor,
        trajectory: Trajectory,
        *,
        periodic: bool = False,
        weights: Sequence[Tensor] | None = None,
    ) -> None:
        self.u, self.trajectory, self.periodic = u, trajectory, periodic
        self.static = cell.static
        own = cell.parameters() if weights is None else weights
        names = [name for name, _ in cell.named_parameters()]
        self.weights = {n: p.detach().clone() for n, p in zip(names, own, strict=True)}
        self.layout = layout(cell, every=weights is not None)
        self.state = cell.A.new_zeros(len(u), cell.nx)
        self._ny = cell.ny

    @property
    def parameters(self) -> int:
        """P."""
        return self.layout.table.shape[1]

    @cached_property
    def _whole(self) -> _Block | None:
        """All samples, kept from one pass to the next where they are few."""
        R, T = self.u.shape[:2]
        if R * T > PASS:
            return None
        return self._at(slice(0, R), slice(0, T))

    @torch.no_grad()
    def rows(
        self,
        kept: Tensor,
        visit: Callable[[slice, slice, Tensor], None],
        *,
        start: bool,
        spare: int = 0,
        out: Tensor | None = None,
    ) -> Tensor:
        """Rows of dy/dθ, from a start state that is held, block by block.

        Args:
            kept: which parameters get a column, ascending.
            visit: called with the records, the samples and the rows of every block.
            start: whether the columns of the start state follow those of the parameters.
            spare: columns without a value at the end of the rows, for the visitor to fill.
            out: all rows (R, T, ny, K [+ nx] [+ spare]), where they are to be kept.

        Returns:
            Derivatives of the end state.

        Shape:
            kept: (K,), rows: (records, samples, ny, K [+ nx] [+ spare]) -> (R, nx, K [+ nx]).
        """
        columns = self.layout.columns(kept)
        R, nx = self.state.shape
        compiled = has_kernels(self.u)
        samples = BLOCK if compiled else PASS
        # Blocks do not depend on the number of threads, and so neither do sums over them.
        together = 1 if compiled else R
        ends = []
        for records in _slices(R, max(together, samples // self.u.shape[1])):
            S = self.state.new_zeros(len(self.u[records]), nx, len(kept) + (nx if start else 0))
            if start:
                S[:, :, len(kept) :] = torch.eye(nx).to(S)
            # A part of rows that are kept must be contiguous: whole records.
            length = self.u.shape[1] if out is not None else max(1, samples // len(S))
            for time in _slices(self.u.shape[1], length):
                block = self._block(records, time)
                if out is None:
                    rows = S.new_empty(*block.v.shape[:2], self._ny, S.shape[-1] + spare)
                else:
                    rows = out[records, time]
                write = self._rows_compiled if compiled else self._rows_generic
                S = write(block, columns, S, rows)
                visit(records, time, rows)
            ends.append(S)
        return torch.cat(ends)

    @torch.no_grad()
    def tangent(self, d_theta: Tensor, d_x0: Tensor | None = None) -> Tensor:
        """dy (R, T, ny) of a change d_theta (P,) or (R, P) and of the start state, (R, nx)."""
        d_x, d_z, d_y, d_static = self.layout.matrices(d_theta)
        Bw, Dyw = self.weights["Bw"], self.weights["Dyw"]
        R, nx = self.state.shape
        s = (self.state if d_x0 is None else d_x0).unsqueeze(-1)
        if self.periodic:  # beside it the response to the start state
            s = torch.cat([s, torch.eye(nx).to(s).expand(R, nx, nx)], dim=-1)
        outputs = []
        for block in self._blocks():
            d_w = _apply(block.static.J, block.v @ d_z.mT) + block.static.tangent(d_static)
            g = d_w.new_zeros(*d_w.shape[:2], nx, s.shape[-1])
            g[..., 0] = block.v @ d_x.mT + d_w @ Bw.mT
            states = linear_recurrence(block.slopes.F, g, s)
            s = states[:, -1]
            d_out = (block.slopes.H.unsqueeze(-1) * states[:, :-1].unsqueeze(2)).sum(3)
            d_out[..., 0] += block.v @ d_y.mT + d_w @ Dyw.mT
            outputs.append(d_out)
        d_out = torch.cat(outputs, dim=1)
        if not self.periodic:
            return d_out.squeeze(-1)
        start = closed(s[..., 1:], s[..., :1])
        return d_out[..., 0] + (d_out[..., 1:] @ start.unsqueeze(1)).squeeze(-1)

    @torch.no_grad()
    def adjoint(self, e: Tensor) -> Adjoint:
        """Derivatives of Σ e(k) · y(k), for e (R, T, ny)."""
        W = self.weights
        end = self._closed_costate(e) if self.periodic else self.state
        parts, by_u = [], []
        for block in self._blocks(backwards=True):
            e_block = e[:, block.time]
            costates = self._costates(block, e, end)
            ahead, end = costates[:, 1:], costates[:, 0]
            d_w = ahead @ W["Bw"] + e_block @ W["Dyw"]
            d_z = _apply(block.static.J.mT, d_w)
            linear = (signal.mT @ block.v for signal in (ahead, d_z, e_block))
            by_x, by_z, by_y = linear
            parts.append(self.layout.vector(by_x, by_z, by_y, block.static.adjoint(d_w)))
            by_u.append(ahead @ W["Bu"] + e_block @ W["Dyu"] + d_z @ W["Dzu"])
        return Adjoint(torch.stack(parts).sum(0), torch.cat(by_u[::-1], dim=1), end)

    def _closed_costate(self, e: Tensor) -> Tensor:
        """λ(T) = λ(0) (R, nx), which is what the start state does to the outputs until it fades."""
        Phi, blocks = torch.eye(self.state.shape[1]).to(self.state).expand(len(e), -1, -1), []
        for block in self._blocks():
            blocks.append(block.time)
            F = block.slopes.F
            Phi = linear_recurrence(F, torch.zeros_like(F), Phi)[:, -1]
            if Phi.abs().amax() < FADED:
                break
        end = self.state
        for time in reversed(blocks):
            block = self._whole or self._block(slice(0, len(e)), time)
            end = self._costates(block, e, end)[:, 0]
        return closed(Phi.mT, end.unsqueeze(-1)).squeeze(-1)

    def _costates(self, block: _Block, e: Tensor, end: Tensor) -> Tensor:
        """λ(k) = F(k)ᵀ λ(k+1) + H(k)ᵀ e(k) (R, B + 1, nx) from λ behind the block."""
        Dyw, Cz = self.weights["Dyw"], self.weights["Cz"]
        e = e[:, block.time]
        g = e @ self.weights["Cy"] + _apply(block.static.J.mT, e @ Dyw) @ Cz  # Hᵀ e
        return adjoint_recurrence(block.slopes.F, g.unsqueeze(-1), end.unsqueeze(-1)).squeeze(-1)

    def _blocks(self, *, backwards: bool = False) -> Iterator[_Block]:
        """All records, at once where that is kept, else block by block in time."""
        everything = slice(0, len(self.u))
        T = self.u.shape[1]
        times = list(_slices(T, T if self._whole else max(1, PASS // len(self.u))))
        for time in reversed(times) if backwards else times:
            yield self._whole or self._block(everything, time)

    def _block(self, records: slice, time: slice) -> _Block:
        if self._whole is None:
            return self._at(records, time)
        v, static = self._whole.v[records, time], self._whole.static.part(records, time)
        return _Block(time, v, static, self._of(records))

    def _at(self, records: slice, time: slice) -> _Block:
        t = self.trajectory
        z, w, x, u = (signal[records, time] for signal in (t.z, t.w, t.x, self.u))
        static = static_slopes(self.static, z, of_static(self._of(records)))
        return _Block(time, torch.cat([x, u, w], dim=-1), static, self._of(records))

    def _of(self, records: slice) -> dict[str, Tensor]:
        """The weights of some of the records."""
        one = self.weights["A"].ndim == 2
        return self.weights if one else {name: p[records] for name, p in self.weights.items()}

    def _by_weight(self, block: _Block, columns: Columns) -> Tensor:
        by_weight = block.static.by_weight()
        if len(columns.static) == self.layout.weights:
            return by_weight
        return by_weight[..., columns.static.to(by_weight.device)]

    def _rows_generic(self, block: _Block, columns: Columns, S: Tensor, rows: Tensor) -> Tensor:
        """Write the rows of a block; the next S. By the recurrence primitive, any device."""
        J, v, by_weight = block.static.J, block.v, self._by_weight(block, columns)
        C = S.shape[-1]
        d_w = v.new_zeros(*v.shape[:2], J.shape[2], C)
        x, z, y = (entries.to(v.device) for entries in columns[:3])
        d_w[..., z[:, 0]] = J[..., z[:, 1]] * v[..., z[:, 2]].unsqueeze(2)
        d_w[..., columns.first : columns.first + by_weight.shape[-1]] = by_weight
        G = block.weights["Bw"].unsqueeze(-3) @ d_w
        E = block.weights["Dyw"].unsqueeze(-3) @ d_w
        G[..., x[:, 1], x[:, 0]] += v[..., x[:, 2]]
        E[..., y[:, 1], y[:, 0]] += v[..., y[:, 2]]
        states = linear_recurrence(block.slopes.F, G, S)
        rows[..., :C] = block.slopes.H @ states[:, :-1] + E
        return states[:, -1]

    def _rows_compiled(self, block: _Block, columns: Columns, S: Tensor, rows: Tensor) -> Tensor:
        """The same in machine code, without ever storing S over time."""
        R = len(S)
        W = [block.weights[name] for name in ("A", "Bw", "Cz", "Cy", "Dyw")]
        W = [m if m.ndim == 3 else m.unsqueeze(0) for m in W]
        chunks = 1 if R % workers() == 0 else workers()
        static, none = block.static, S.new_zeros(R, len(block.v[0]), 0)
        if isinstance(static, NetworkSlopes) and len(columns.static) == self.layout.weights:
            network = (static.Ww if static.Ww.ndim == 3 else static.Ww.unsqueeze(0), static.z)
            by_weight = (none.unsqueeze(2), static.slope, static.h, *network)
        else:
            by_weight = (self._by_weight(block, columns), none, none, none[:1], none)
        tensors = (*W, static.J, block.v, *by_weight, *columns[:3])
        arguments = (*map(to_numpy, tensors), columns.first, chunks, S.numpy(), rows.numpy())
        spread(emit, R * chunks, *arguments)
        return S


def output_jacobian(linearisation: Linearisation) -> Tensor:
    """dy/dθ (R, T, ny, P) as a whole; from a start state that is held, its nx columns follow."""
    everything = torch.arange(linearisation.parameters)
    groups: dict[int, list[Tensor]] = defaultdict(list)
    end = linearisation.rows(
        everything, lambda records, _, rows: groups[records.start].append(rows), start=True
    )
    rows = torch.cat([torch.cat(blocks, dim=1) for blocks in groups.values()])
    if not linearisation.periodic:
        return rows
    P = len(everything)
    start = closed(end[:, :, P:], end[:, :, :P])
    return rows[..., :P] + rows[..., P:] @ start.unsqueeze(1)


def _apply(matrices: Tensor, vectors: Tensor) -> Tensor:
    """(R, T, n, m) times (R, T, m): (R, T, n)."""
    return (matrices * vectors.unsqueeze(-2)).sum(-1)


def _slices(length: int, size: int) -> Iterator[slice]:
    return (slice(first, min(first + size, length)) for first in range(0, length, size))


def closed(transition: Tensor, end: Tensor) -> Tensor:
    """The start S (R, nx, m) that returns to itself, S = Φ S + end; not finite where none does."""
    identity = torch.eye(end.shape[1]).to(end)
    return torch.linalg.solve_ex(identity - transition, end).result
