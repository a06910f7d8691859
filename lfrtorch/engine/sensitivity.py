"""Derivatives of the simulated output with respect to every parameter of the cell.

A weight changes the output in two ways. Directly: it multiplies a signal in its own equation.
Indirectly: it changes the next state, and the model hands that change on from sample to sample.
The derivative S(k) of the state with respect to all parameters is therefore simulated along with
the model, by the model linearised at every sample. That is a linear recurrence with one column for
each parameter, and the output's derivative follows from it. A product of this Jacobian with one
vector needs one column: forwards in time for J dθ, backwards in time for Jᵀ e (backpropagation
through time).

With v = [x; u; w] the model is linear in its matrices::

    x+ = [A Bu Bw] v      z = [Cz Dzu 0] v      y = [Cy Dyu Dyw] v      w = f(z; φ)

The direct terms of a parameter are entries of v, or derivatives of f for those of the static map.
With these terms in G and E, and the linearised model F and H::

    S(k+1) = F(k) S(k) + G(k),    dy(k)/dθ = H(k) S(k) + E(k)

``rows`` computes all columns, ``tangent`` one direction dθ, ``adjoint`` one combination of outputs.
They pass over time in blocks, so that memory does not grow with the length of a record.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property, lru_cache
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lfrtorch._support.threads import has_kernels, spread, to_numpy, workers
from lfrtorch.engine.blocked_kernel import blocked_rows
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.feedback_recurrence import states, transition
from lfrtorch.engine.jacobian_kernel import jacobian_rows
from lfrtorch.engine.linear_recurrence import linear_recurrence
from lfrtorch.engine.linearised import PASS, Linearised, linearise_at
from lfrtorch.engine.nonlinearity import is_network, known_parts, linearise_static, of_static
from lfrtorch.engine.simulation import Trajectory
from lfrtorch.engine.static_jacobian import NetworkJacobian, StaticJacobian

_FADED = 1e-18
"""An initial state is forgotten when less than this fraction of it is left."""

BLOCK, _BLOCK_BYTES = 8192, 1 << 24
"""Most samples, of all records together, and bytes in a block of rows on the CPU: a block that
leaves the cache before it is used takes up to 15 % longer."""

KEPT = 1 << 16
"""Most samples at which a network is linearised once for all passes of an iteration: of 20 neurons
and 30 states, 50 MB."""

MANY_STATES = 8
"""Number of states from which ``blocked_rows`` is the faster kernel."""


_EQUATIONS = {
    "x": {"A": "x", "Bu": "u", "Bw": "w"},
    "z": {"Cz": "x", "Dzu": "u"},
    "y": {"Cy": "x", "Dyu": "u", "Dyw": "w"},
}
"""For each equation its matrices, in the order of the parameters, and what each multiplies."""


class DirectTerms(NamedTuple):
    """Direct terms of some columns.

    A triple (column, row, regressor) in ``x``, ``z`` or ``y``: the column's parameter multiplies
    ``v[regressor]`` in that row of the equation. Columns of the static map begin at ``first``;
    ``static`` has their positions among all weights of the map.
    """

    x: Int[Tensor, "n_x 3"]
    z: Int[Tensor, "n_z 3"]
    y: Int[Tensor, "n_y 3"]
    static: Int[Tensor, " n_static"]
    first: int


def layout(cell: LFRCell, *, every: bool = False) -> Layout:
    """Layout of the free parameters, or of every one; cells of one structure share the object."""
    parameters = tuple(
        (name, p.numel(), every or p.requires_grad) for name, p in cell.named_parameters()
    )
    return _layout(cell.nx, cell.nu, cell.ny, cell.nz, cell.nw, parameters)


class Layout:
    """Where parameters (name, size, whether free) stand: in θ (the free), and in the equations."""

    def __init__(
        self,
        nx: int,
        nu: int,
        ny: int,
        nz: int,
        nw: int,
        parameters: tuple[tuple[str, int, bool], ...],
    ) -> None:
        self.rows = {"x": nx, "z": nz, "y": ny}
        self.width = nx + nu + nw
        first_in_v, size = {"x": 0, "u": nx, "w": nx + nu}, {"x": nx, "u": nu, "w": nw}
        places = {
            name: (e, self.rows[left], first_in_v[right], size[right])
            for e, (left, matrices) in enumerate(_EQUATIONS.items())
            for name, right in matrices.items()
        }
        # For every element of θ: equation, row, regressor. Those of the static map have equation 3,
        # and their position in the map for the other two.
        table = []
        self.weights = 0
        for name, count, free in parameters:
            if name in places:
                e, n, first, m = places[name]
                row = torch.arange(n).repeat_interleave(m)
                entries = torch.stack(
                    [torch.full_like(row, e), row, first + torch.arange(m).repeat(n)]
                )
            else:
                position = self.weights + torch.arange(count)
                entries = torch.stack([torch.full_like(position, 3), position, position])
                self.weights += count
            if free:
                table.append(entries)
        self.table = torch.cat([torch.zeros(3, 0, dtype=torch.int64), *table], dim=1)

    def columns(self, kept: Int[Tensor, " K"]) -> DirectTerms:
        """The direct terms of the kept parameters, given by ascending positions in θ."""
        equation, row, regressor = self.table[:, kept.cpu()]
        column = torch.arange(len(equation))
        entries = torch.stack([column, row, regressor], dim=1)
        x, z, y = (entries[equation == e] for e in range(3))
        static = row[equation == 3]
        return DirectTerms(x, z, y, static, len(column) - len(static))

    def matrices(self, theta: Float[Tensor, "*axes P"]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """[A Bu Bw], [Cz Dzu 0], [Cy Dyu Dyw] and the weights of the static map in θ."""
        equation, row, regressor = self.table.to(theta.device)
        parts = []
        for e, rows in enumerate(self.rows.values()):
            own = equation == e
            matrix = theta.new_zeros(*theta.shape[:-1], rows, self.width)
            matrix[..., row[own], regressor[own]] = theta[..., own]
            parts.append(matrix)
        static = theta.new_zeros(*theta.shape[:-1], self.weights)
        static[..., row[equation == 3]] = theta[..., equation == 3]
        return *parts, static

    def vector(
        self,
        x: Float[Tensor, "R nx v"],
        z: Float[Tensor, "R nz v"],
        y: Float[Tensor, "R ny v"],
        static: Float[Tensor, "R weights"],
    ) -> Float[Tensor, "R P"]:
        """θ from such matrices: the inverse of ``matrices``."""
        equation, row, regressor = self.table.to(x.device)
        theta = x.new_empty(len(x), len(equation))
        for e, matrix in enumerate((x, z, y)):
            own = equation == e
            theta[:, own] = matrix[:, row[own], regressor[own]]
        theta[:, equation == 3] = static[:, row[equation == 3]]
        return theta


_layout = lru_cache(maxsize=64)(Layout)


class Rows(NamedTuple):
    """Rows dy/dθ of some records and samples, columns of the initial state and spare ones."""

    records: slice
    time: slice
    rows: Float[Tensor, "R B ny columns"]
    end: Float[Tensor, "R nx C"]


class Adjoint(NamedTuple):
    """Derivatives of Σ e(k) · y(k); ``theta`` is each record's own."""

    theta: Float[Tensor, "R P"]
    u: Float[Tensor, "R T nu"]
    x0: Float[Tensor, "R nx"]


class _Block:
    """The model linearised at neighbouring samples of some records, with v = [x; u; w]."""

    def __init__(
        self,
        time: slice,
        v: Float[Tensor, "R B v"],
        static: StaticJacobian,
        weights: dict[str, Tensor],
    ) -> None:
        self.time, self.v, self.static, self._weights = time, v, static, weights

    @cached_property
    def linearised(self) -> Linearised:
        """x+ = F x, y = H x."""
        return linearise_at(self._weights, self.static.J)


class Linearisation:
    """The model linearised along a trajectory.

    Args:
        cell: the model; parameters with ``requires_grad=False`` are no part of θ. Its weights are
            copied.
        u, trajectory: input and signals of this cell.
        periodic: whether the initial state is the end state, whatever the parameters. Otherwise it
            does not depend on them.
        weights: to use instead of the cell's own, in their order; all of them are θ then.
    """

    @torch.no_grad()
    def __init__(
        self,
        cell: LFRCell,
        u: Float[Tensor, "R T nu"],
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
        self.parameters = self.layout.table.shape[1]
        """P."""
        self.state = u.new_zeros(len(u), cell.nx)
        self._ny = cell.ny
        self._known_transition: tuple[Tensor, list[slice]] | None = None

    def signals(self, records: slice, time: slice) -> Float[Tensor, "R B v"]:
        """v = [x; u; w]."""
        t = self.trajectory
        return torch.cat([s[records, time] for s in (t.x, self.u, t.w)], dim=-1)

    @cached_property
    def _whole(self) -> _Block | None:
        """All samples, kept from one pass to the next if they are few."""
        R, T = self.u.shape[:2]
        fast = is_network(self.static) or known_parts(self.static) is not None
        few = KEPT if has_kernels(self.u) and fast else PASS
        if few < R * T:
            return None
        return self._at(slice(0, R), slice(0, T))

    @torch.no_grad()
    def rows(
        self,
        kept: Int[Tensor, " K"],
        *,
        initial_state: bool,
        spare: int = 0,
        out: Float[Tensor, "R T ny columns"] | None = None,
    ) -> Iterator[Rows]:
        """Rows of dy/dθ with the initial state held, block by block.

        Args:
            kept: which parameters get a column, ascending.
            initial_state: whether nx columns for the initial state follow.
            spare: columns without a value at the end of the rows, for the caller to fill.
            out: all rows, if they are to be kept; a block is then all samples of its records.
        """
        columns = self.layout.columns(kept)
        R, nx = self.state.shape
        compiled = has_kernels(self.u)
        samples = PASS
        if compiled:
            row = self._ny * (len(kept) + nx * initial_state + spare) * self.u.element_size()
            samples = min(BLOCK, max(1, _BLOCK_BYTES // max(1, row)))
        Phi = self.state.new_empty(R, nx, nx * initial_state)
        # Blocks do not depend on the number of threads, and so neither do sums over them.
        together = 1 if compiled else R
        for records in _slices(R, max(together, samples // self.u.shape[1])):
            S = self.state.new_zeros(len(self.u[records]), nx, len(kept) + nx * initial_state)
            if initial_state:
                S[:, :, len(kept) :] = torch.eye(nx).to(S)
            # The kernel writes to contiguous memory: of `out` only whole records are that.
            length = self.u.shape[1] if out is not None else max(1, samples // len(S))
            for time in _slices(self.u.shape[1], length):
                block = self._block(records, time)
                if out is None:
                    rows = S.new_empty(*block.v.shape[:2], self._ny, S.shape[-1] + spare)
                else:
                    rows = out[records, time]
                write = self._rows_compiled if compiled else self._rows_generic
                S = write(block, columns, S, rows)
                if initial_state and time.stop == self.u.shape[1]:
                    Phi[records] = S[:, :, len(kept) :]
                    # If it has faded, fewer blocks are enough.
                    if records.stop == R and Phi.abs().amax() >= _FADED:
                        self._known_transition = Phi, self._times
                yield Rows(records, time, rows, S)

    def tangent(
        self, d_theta: Float[Tensor, " P"], d_x0: Float[Tensor, "R nx"] | None = None
    ) -> Float[Tensor, "R T ny"]:
        """dy of a change dθ and of the initial state, which follows if a record is periodic."""
        return self.tangent_with_end(d_theta, d_x0)[0]

    @torch.no_grad()
    def tangent_with_end(
        self,
        d_theta: Float[Tensor, " P"],
        d_x0: Float[Tensor, "R nx"] | None = None,
        d_u: Float[Tensor, "R T nu"] | None = None,
    ) -> tuple[Float[Tensor, "R T ny"], Float[Tensor, "R nx"]]:
        """dy and the change of the last state, of dθ, of the initial state and of the input."""
        start = self.state if d_x0 is None else d_x0
        if self.periodic and d_x0 is None:
            *_, (_, end) = self._changes(d_theta, start, d_u)
            Phi, _ = self._transition
            start = fixed_point(Phi, end.unsqueeze(-1)).squeeze(-1)
        d_y, ends = zip(*self._changes(d_theta, start, d_u), strict=True)
        return torch.cat(d_y, dim=1), ends[-1]

    def _changes(
        self,
        d_theta: Float[Tensor, " P"],
        s: Float[Tensor, "R nx"],
        d_u: Float[Tensor, "R T nu"] | None = None,
    ) -> Iterator[tuple[Float[Tensor, "R _ ny"], Float[Tensor, "R nx"]]]:
        """Changes of the outputs in each block, and of the state after it."""
        d_x, d_z, d_y, d_static = self.layout.matrices(d_theta)
        W = self.weights
        for block in self._blocks():
            J, v = block.static.J, block.v
            by_x, by_z, by_y = v @ d_x.mT, v @ d_z.mT, v @ d_y.mT
            if d_u is not None:
                part = d_u[:, block.time]
                by_x += part @ W["Bu"].mT
                by_z += part @ W["Dzu"].mT
                by_y += part @ W["Dyu"].mT
            d_w = _apply(J, by_z) + block.static.tangent(d_static)
            every = states(W, J, by_x + d_w @ W["Bw"].mT, s)
            s, d_states = every[:, -1], every[:, :-1]
            d_w += _apply(J, d_states @ W["Cz"].mT)
            yield d_states @ W["Cy"].mT + by_y + d_w @ W["Dyw"].mT, s

    @torch.no_grad()
    def adjoint(
        self, e: Float[Tensor, "R T ny"], end: Float[Tensor, "R nx"] | None = None
    ) -> Adjoint:
        """Derivatives of Σ e(k) · y(k), and of end · x(T) unless a record is periodic."""
        W = self.weights
        end = self._periodic_costate(e) if self.periodic else self.state if end is None else end
        parts, by_u = [], []
        for block in self._blocks(backwards=True):
            e_block = e[:, block.time]
            costates = self._costates(block, e, end)
            ahead, end = costates[:, 1:], costates[:, 0]
            # λ(k+1) and e(k) are the weights of x(k+1) and y(k): pass them back to w, z and θ.
            d_w = ahead @ W["Bw"] + e_block @ W["Dyw"]
            d_z = _apply(block.static.J.mT, d_w)
            linear = (signal.mT @ block.v for signal in (ahead, d_z, e_block))
            by_x, by_z, by_y = linear
            parts.append(self.layout.vector(by_x, by_z, by_y, block.static.adjoint(d_w)))
            by_u.append(ahead @ W["Bu"] + e_block @ W["Dyu"] + d_z @ W["Dzu"])
        return Adjoint(torch.stack(parts).sum(0), torch.cat(by_u[::-1], dim=1), end)

    def _periodic_costate(self, e: Float[Tensor, "R T ny"]) -> Float[Tensor, "R nx"]:
        """λ(T) = λ(0) in periodic steady state.

        λ(0) is what a change of the initial state does to the outputs. It takes the samples up to
        where that change has faded, and no more.
        """
        Phi, times = self._transition
        end = self.state
        for time in reversed(times):
            block = self._whole or self._block(slice(0, len(e)), time)
            end = self._costates(block, e, end)[:, 0]
        return fixed_point(Phi.mT, end.unsqueeze(-1)).squeeze(-1)

    @property
    def _transition(self) -> tuple[Float[Tensor, "R nx nx"], list[slice]]:
        """Φ over a whole record, and the blocks in which an initial state fades."""
        if self._known_transition is not None:
            return self._known_transition
        R, nx = self.state.shape
        Phi, times = torch.eye(nx).to(self.state).expand(R, nx, nx), []
        for block in self._blocks():
            times.append(block.time)
            Phi = transition(self.weights, block.static.J, Phi)
            if Phi.abs().amax() < _FADED:
                break
        self._known_transition = Phi, times
        return Phi, times

    def _costates(
        self, block: _Block, e: Float[Tensor, "R T ny"], end: Float[Tensor, "R nx"]
    ) -> Float[Tensor, "R _ nx"]:
        """λ(k) = F(k)ᵀ λ(k+1) + H(k)ᵀ e(k) in a block, from λ at its end."""
        W, J = self.weights, block.static.J
        e = e[:, block.time]
        g = e @ W["Cy"] + _apply(J.mT, e @ W["Dyw"]) @ W["Cz"]  # Hᵀ e
        return states(W, J, g, end, backwards=True)

    def _blocks(self, *, backwards: bool = False) -> Iterator[_Block]:
        """All records, block by block in time, or at once if they are few."""
        everything = slice(0, len(self.u))
        for time in reversed(self._times) if backwards else self._times:
            yield self._whole or self._block(everything, time)

    @property
    def _times(self) -> list[slice]:
        """The blocks of samples."""
        T = self.u.shape[1]
        return list(_slices(T, T if self._whole else max(1, PASS // len(self.u))))

    def _block(self, records: slice, time: slice) -> _Block:
        if self._whole is None:
            return self._at(records, time)
        v, static = self._whole.v[records, time], self._whole.static.part(records, time)
        return _Block(time, v, static, self.weights)

    def _at(self, records: slice, time: slice) -> _Block:
        of_map = of_static(self.weights)
        static = linearise_static(self.static, self.trajectory.z[records, time], of_map)
        return _Block(time, self.signals(records, time), static, self.weights)

    def _by_weight(self, block: _Block, columns: DirectTerms) -> Tensor:
        by_weight = block.static.by_weight()
        if len(columns.static) == self.layout.weights:
            return by_weight
        return by_weight[..., columns.static.to(by_weight.device)]

    def _rows_generic(self, block: _Block, columns: DirectTerms, S: Tensor, rows: Tensor) -> Tensor:
        """Write the rows of a block and return the next S: in torch, on any device."""
        J, v, by_weight = block.static.J, block.v, self._by_weight(block, columns)
        C = S.shape[-1]
        d_w = v.new_zeros(*v.shape[:2], J.shape[2], C)
        x, z, y = (entries.to(v.device) for entries in columns[:3])
        d_w[..., z[:, 0]] = J[..., z[:, 1]] * v[..., z[:, 2]].unsqueeze(2)
        d_w[..., columns.first : columns.first + by_weight.shape[-1]] = by_weight
        G, E = self.weights["Bw"] @ d_w, self.weights["Dyw"] @ d_w
        G[..., x[:, 1], x[:, 0]] += v[..., x[:, 2]]
        E[..., y[:, 1], y[:, 0]] += v[..., y[:, 2]]
        every = linear_recurrence(block.linearised.F, G, S)
        rows[..., :C] = block.linearised.H @ every[:, :-1] + E
        return every[:, -1]

    def _rows_compiled(
        self, block: _Block, columns: DirectTerms, S: Tensor, rows: Tensor
    ) -> Tensor:
        """The same in machine code; S is never stored over time, and is changed in place."""
        R = len(S)
        W = [self.weights[name] for name in ("A", "Bw", "Cz", "Cy", "Dyw")]
        chunks = 1 if R % workers() == 0 else workers()
        static, none = block.static, S.new_zeros(R, len(block.v[0]), 0)
        whole = len(columns.static) == self.layout.weights
        if isinstance(static, NetworkJacobian) and whole:
            by_weight = (none.unsqueeze(2), static.slope, static.h, static.Ww, static.z)
        else:
            by_weight = (self._by_weight(block, columns), none, none, none[0], none)
        tensors = (*W, static.J, block.v, *by_weight, *columns[:3])
        arguments = (*map(to_numpy, tensors), columns.first, chunks, S.numpy(), rows.numpy())
        kernel = blocked_rows if S.shape[1] >= MANY_STATES else jacobian_rows
        spread(kernel, R * chunks, *arguments)
        return S


def output_jacobian(linearisation: Linearisation) -> Float[Tensor, "R T ny columns"]:
    """dy/dθ as a whole; unless the record is periodic, nx columns of the initial state follow."""
    everything = torch.arange(linearisation.parameters)
    P, nx = len(everything), linearisation.state.shape[1]
    y = linearisation.trajectory.y
    rows, end = y.new_empty(*y.shape, P + nx), y.new_empty(len(y), nx, P + nx)
    for block in linearisation.rows(everything, initial_state=True):
        rows[block.records, block.time] = block.rows
        end[block.records] = block.end
    if not linearisation.periodic:
        return rows
    initial = fixed_point(end[:, :, P:], end[:, :, :P])
    return rows[..., :P] + rows[..., P:] @ initial.unsqueeze(1)


def _apply(
    matrices: Float[Tensor, "R T n m"], vectors: Float[Tensor, "R T m"]
) -> Float[Tensor, "R T n"]:
    """A matrix times a vector at every sample."""
    return (matrices * vectors.unsqueeze(-2)).sum(-1)


def _slices(length: int, size: int) -> Iterator[slice]:
    return (slice(first, min(first + size, length)) for first in range(0, length, size))


def fixed_point(
    transition: Float[Tensor, "R nx nx"], end: Float[Tensor, "R nx m"]
) -> Float[Tensor, "R nx m"]:
    """The S with S = Φ S + end: the initial state of a period; not finite if there is none."""
    identity = torch.eye(end.shape[1]).to(end)
    return torch.linalg.solve_ex(identity - transition, end).result
