"""Derivatives of the simulated output with respect to every parameter of the cell.

A weight changes the output in two ways. The direct way is its own equation, where it multiplies a
signal. The indirect way is the next state, whose change the model propagates from sample to sample.
So the derivative S(k) of the state with respect to all parameters is simulated along with the
model, by the model linearised at every sample. This is a linear recurrence with one column for each
parameter, and it determines the derivative of the output. A product of this Jacobian with one
vector needs one column: forwards in time for J dθ, backwards in time for Jᵀ e (backpropagation
through time).

The model is linear in its matrices; with v = [x; u; w]::

    x+ = [A Bu Bw] v      z = [Cz Dzu 0] v      y = [Cy Dyu Dyw] v      w = f(z; φ)

The direct terms of a parameter are entries of v or, for parameters of the static map, derivatives
of f. They are the entries of G and E. F and H are the linearised model::

    S(k+1) = F(k) S(k) + G(k),    dy(k)/dθ = H(k) S(k) + E(k)

``rows`` computes all columns, ``tangent`` one direction dθ, ``adjoint`` one combination of outputs.
They process time in blocks, so memory does not grow with the length of a record.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from lfrtorch._support.threads import fast_paths, spread_loop, workers
from lfrtorch._support.types import Integers
from lfrtorch.engine.blocked_kernel import blocked_rows
from lfrtorch.engine.feedback_recurrence import states, transition
from lfrtorch.engine.jacobian_kernel import jacobian_rows
from lfrtorch.engine.linear_recurrence import linear_recurrence
from lfrtorch.engine.linearised import PASS, linearise_at
from lfrtorch.engine.simulation import Numbers, Trajectory
from lfrtorch.engine.weights import DirectTerms, Weights
from lfrtorch.maps.linearised import LinearisedMap, linearise_map

_FADED = 1e-18
"""An initial state counts as forgotten when this part of it is left."""

BLOCK = 8192
"""Largest number of samples, of all records together, in a block of rows on the CPU."""

_BLOCK_BYTES = 1 << 24
"""Largest size of a block of rows on the CPU: rows beyond the cache take up to 15 % more time."""

KEPT = 1 << 16
"""Largest number of samples for which slopes of a compiled map are kept during an iteration."""

MANY_STATES = 8
"""Number of states from which ``blocked_rows`` is faster than ``jacobian_rows``."""


class Rows(NamedTuple):
    """Rows dy/dθ of some records and samples; initial states and spare columns come last."""

    records: slice
    time: slice
    rows: Float[Tensor, "R B ny columns"]
    end: Float[Tensor, "R nx C"]


class Adjoint(NamedTuple):
    """Derivatives of Σ e(k) · y(k); ``theta`` has a row for each record."""

    theta: Float[Tensor, "R P"]
    u: Float[Tensor, "R T nu"]
    x0: Float[Tensor, "R nx"]


class _Block(NamedTuple):
    """The model linearised at neighbouring samples of some records."""

    records: slice
    time: slice
    static: LinearisedMap


class Linearisation:
    """The model linearised along a trajectory.

    Args:
        model: the numbers; numbers of parameters with ``requires_grad=False`` are not part of θ.
        u, trajectory: input and signals of this model.
        periodic: True if the initial state equals the end state, whatever the parameters are.
            Otherwise the initial state does not depend on the parameters.
        every: True if all numbers are part of θ, including frozen ones.
    """

    @torch.no_grad()
    def __init__(
        self,
        model: Numbers,
        u: Float[Tensor, "R T nu"],
        trajectory: Trajectory,
        *,
        periodic: bool = False,
        every: bool = False,
    ) -> None:
        self.weights = W = model.weights()
        self.u, self.trajectory, self.periodic = u, trajectory, periodic
        self._every = every
        self._compiled = W.layout.compiled and u.dtype == torch.float64
        self._known_transition: tuple[Tensor, list[slice]] | None = None

    @cached_property
    def free(self) -> Integers:
        """Positions of θ in the vector of all numbers."""
        W = self.weights
        return np.arange(len(W.flat)) if self._every else W.layout.free

    @property
    def parameters(self) -> int:
        """P."""
        return len(self.free)

    @property
    def state(self) -> Float[Tensor, "R nx"]:
        """Zero states of all records."""
        return self.u.new_zeros(len(self.u), self.weights.nx)

    def columns(self, kept: Int[Tensor, " K"]) -> DirectTerms:
        """The direct terms of the kept parameters, given by ascending positions in θ."""
        if not len(kept):
            return self.weights.layout.direct_terms(np.zeros(0, np.int64))
        return self.weights.layout.direct_terms(self.free[kept.cpu().numpy()])

    def signals(self, records: slice, time: slice) -> Float[Tensor, "R B v"]:
        """Signals v = [x; u; w]."""
        t = self.trajectory
        return torch.cat([s[records, time] for s in (t.x, self.u, t.w)], dim=-1)

    def rows(
        self,
        kept: Int[Tensor, " K"],
        *,
        initial_state: bool,
        spare: int = 0,
        out: Float[Tensor, "R T ny columns"] | None = None,
        faded: float = 0.0,
    ) -> Iterator[Rows]:
        """Rows of dy/dθ for a fixed initial state, block by block.

        Args:
            kept: parameters that get a column, in ascending order.
            initial_state: True if nx columns for the initial state follow.
            spare: number of uninitialised columns at the end of the rows, for the caller to fill.
            out: array that keeps all rows; a block then has all samples of its records.
            faded: the rest of a record is left out when the derivatives of the state are smaller.
        """
        columns, W = self.columns(kept), self.weights
        (R, T), nx, ny = self.u.shape[:2], W.nx, W.ny
        width, samples = len(kept) + nx * initial_state, PASS
        if self._compiled:
            row = ny * (width + spare) * self.u.element_size()
            samples = min(BLOCK, max(1, _BLOCK_BYTES // max(1, row)))
        Phi = self.u.new_empty(R, nx, nx * initial_state)
        # Blocks, and so the sums over them, do not depend on the number of threads.
        together = 1 if self._compiled else R
        for records in _slices(R, max(together, samples // T)):
            S = self.u.new_zeros(records.stop - records.start, nx, width)
            if initial_state:
                S[:, :, len(kept) :] = torch.eye(nx).to(S)
            # The kernel writes to contiguous memory: only whole records of `out` are contiguous.
            length = T if out is not None else max(1, samples // len(S))
            for time in _slices(T, length):
                if out is None:
                    rows = S.new_empty(len(S), time.stop - time.start, ny, width + spare)
                else:
                    rows = out[records, time]
                write = self._rows_compiled if self._compiled else self._rows_generic
                S = write(records, time, columns, S, rows)
                if initial_state and self.periodic and time.stop == T:
                    Phi[records] = S[:, :, len(kept) :]
                    # Blocks after the initial state has decayed are not needed.
                    if records.stop == R and Phi.abs().amax() >= _FADED:
                        self._known_transition = Phi, self._times
                yield Rows(records, time, rows, S)
                if faded and time.stop < T and S.abs().amax() < faded:
                    break

    def tangent(
        self, d_theta: Float[Tensor, " P"], d_x0: Float[Tensor, "R nx"] | None = None
    ) -> Float[Tensor, "R T ny"]:
        """Change dy of the output by dθ and d_x0; if periodic, dθ determines the initial state."""
        return self.tangent_with_end(d_theta, d_x0)[0]

    @torch.no_grad()
    def tangent_with_end(
        self,
        d_theta: Float[Tensor, " P"],
        d_x0: Float[Tensor, "R nx"] | None = None,
        d_u: Float[Tensor, "R T nu"] | None = None,
    ) -> tuple[Float[Tensor, "R T ny"], Float[Tensor, "R nx"]]:
        """Change of the output and of the last state by dθ, the initial state and the input."""
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
        W, t = self.weights, self.trajectory
        whole = torch.zeros_like(W.flat)
        whole[torch.from_numpy(self.free)] = d_theta
        d = Weights(W.layout, whole)
        for block in self._blocks():
            J, time = block.static.J, block.time
            x, u, w = t.x[:, :-1][:, time], self.u[:, time], t.w[:, time]
            by_x = x @ d.A.mT + u @ d.Bu.mT + w @ d.Bw.mT
            by_z = x @ d.Cz.mT + u @ d.Dzu.mT
            by_y = x @ d.Cy.mT + u @ d.Dyu.mT + w @ d.Dyw.mT
            if d_u is not None:
                part = d_u[:, time]
                by_x += part @ W.Bu.mT
                by_z += part @ W.Dzu.mT
                by_y += part @ W.Dyu.mT
            d_w = _apply(J, by_z) + block.static.tangent(d.phi)
            every = states(W, J, by_x + d_w @ W.Bw.mT, s)
            s, d_states = every[:, -1], every[:, :-1]
            d_w += _apply(J, d_states @ W.Cz.mT)
            yield d_states @ W.Cy.mT + by_y + d_w @ W.Dyw.mT, s

    @torch.no_grad()
    def adjoint(
        self, e: Float[Tensor, "R T ny"], end: Float[Tensor, "R nx"] | None = None
    ) -> Adjoint:
        """Gradient of Σ e(k) · y(k), plus end · x(T) unless the records are periodic."""
        W, t = self.weights, self.trajectory
        end = self._periodic_costate(e) if self.periodic else self.state if end is None else end
        theta, by_u = 0.0, []
        for block in self._blocks(backwards=True):
            time = block.time
            e_block = e[:, time]
            costates = self._costates(block, e, end)
            ahead, end = costates[:, 1:], costates[:, 0]
            # λ(k+1) and e(k) are the derivatives by x(k+1) and y(k): pass them on to w, z and θ.
            d_w = ahead @ W.Bw + e_block @ W.Dyw
            d_z = _apply(block.static.J.mT, d_w)
            x, u, w = t.x[:, :-1][:, time], self.u[:, time], t.w[:, time]
            pairs = (ahead, x), (ahead, u), (ahead, w), (d_z, x), (d_z, u)
            pairs += (e_block, x), (e_block, u), (e_block, w)
            parts = [(left.mT @ right).flatten(1) for left, right in pairs]
            theta = theta + torch.cat([*parts, block.static.adjoint(d_w)], dim=1)
            by_u.append(ahead @ W.Bu + e_block @ W.Dyu + d_z @ W.Dzu)
        assert isinstance(theta, Tensor)
        own = theta[:, torch.from_numpy(self.free)]
        return Adjoint(own, torch.cat(by_u[::-1], dim=1), end)

    def _periodic_costate(self, e: Float[Tensor, "R T ny"]) -> Float[Tensor, "R nx"]:
        """Costate λ(T) = λ(0) of a periodic steady state.

        λ(0) is the effect of the initial state on the outputs. Samples after this effect has
        decayed are not needed.
        """
        Phi, times = self._transition
        end = self.state
        for time in reversed(times):
            block = self._block(slice(0, len(e)), time)
            end = self._costates(block, e, end)[:, 0]
        return fixed_point(Phi.mT, end.unsqueeze(-1)).squeeze(-1)

    @property
    def _transition(self) -> tuple[Float[Tensor, "R nx nx"], list[slice]]:
        """Transition Φ over a whole record, and the blocks until an initial state has decayed."""
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
        """Costates λ(k) = F(k)ᵀ λ(k+1) + H(k)ᵀ e(k) in a block, from λ at its end."""
        W, J = self.weights, block.static.J
        e = e[:, block.time]
        g = e @ W.Cy + _apply(J.mT, e @ W.Dyw) @ W.Cz  # Hᵀ e
        return states(W, J, g, end, backwards=True)

    def _blocks(self, *, backwards: bool = False) -> Iterator[_Block]:
        """Linearised blocks of all records in time; a single block if samples are few."""
        everything = slice(0, len(self.u))
        for time in reversed(self._times) if backwards else self._times:
            yield self._block(everything, time)

    @cached_property
    def _whole(self) -> _Block | None:
        """Linearised model at all samples, kept between passes if there are few samples."""
        R, T = self.u.shape[:2]
        return self._at(slice(0, R), slice(0, T)) if self._few else None

    @property
    def _times(self) -> list[slice]:
        """The blocks of samples."""
        R, T = self.u.shape[:2]
        return list(_slices(T, T if self._few else max(1, PASS // R)))

    @property
    def _few(self) -> bool:
        """Tell if samples are few enough to be linearised at once."""
        R, T = self.u.shape[:2]
        return fast_paths() and (KEPT if self._compiled else PASS) >= R * T

    def _block(self, records: slice, time: slice) -> _Block:
        whole = self._whole
        same = whole is not None and (records, time) == (whole.records, whole.time)
        return whole if whole is not None and same else self._at(records, time)

    def _at(self, records: slice, time: slice) -> _Block:
        W, z = self.weights, self.trajectory.z[records, time]
        return _Block(records, time, linearise_map(W.map, z, W.phi, W.layout.code))

    def _rows_generic(
        self, records: slice, time: slice, columns: DirectTerms, S: Tensor, rows: Tensor
    ) -> Tensor:
        """Write the rows of a block and return the next S: in torch, on any device."""
        W, static, v = self.weights, self._at(records, time).static, self.signals(records, time)
        J, C, device = static.J, S.shape[-1], S.device
        x, z, y, own = (torch.from_numpy(part).to(device) for part in columns)
        first = len(x) + len(z) + len(y)
        d_w = v.new_zeros(*v.shape[:2], W.nw, C)
        d_w[..., z[:, 0]] = J[..., z[:, 1]] * v[..., z[:, 2]].unsqueeze(2)
        d_w[..., first : first + len(own)] = static.by_weight()[..., own]
        G, E = W.Bw @ d_w, W.Dyw @ d_w
        G[..., x[:, 1], x[:, 0]] += v[..., x[:, 2]]
        E[..., y[:, 1], y[:, 0]] += v[..., y[:, 2]]
        F, H = linearise_at(W, J)
        every = linear_recurrence(F, G, S)
        rows[..., :C] = H @ every[:, :-1] + E
        return every[:, -1]

    def _rows_compiled(
        self, records: slice, time: slice, columns: DirectTerms, S: Tensor, rows: Tensor
    ) -> Tensor:
        """Write the same rows in machine code; S is changed in place and never stored over time."""
        R, t = len(S), self.trajectory
        chunks = 1 if R % workers() == 0 else workers()
        signals = (np.ascontiguousarray(s.numpy()) for s in (self.u, t.x, t.z, t.w))
        kernel = blocked_rows if S.shape[1] >= MANY_STATES else jacobian_rows
        at = records.start, time.start, *columns, chunks
        spread_loop(
            kernel, R * chunks, *self.weights.arguments, *signals, *at, S.numpy(), rows.numpy()
        )
        return S


def output_jacobian(linearisation: Linearisation) -> Float[Tensor, "R T ny columns"]:
    """Jacobian dy/dθ of all samples; unless periodic, nx columns of the initial state follow."""
    everything = torch.arange(linearisation.parameters)
    P, nx = len(everything), linearisation.weights.nx
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
    """Solution of S = Φ S + end, the initial state of a period; not finite without a solution."""
    identity = torch.eye(end.shape[1]).to(end)
    return torch.linalg.solve_ex(identity - transition, end).result
