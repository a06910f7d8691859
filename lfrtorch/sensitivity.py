"""Jacobian of the simulated output with respect to every parameter of the cell.

With v = [x; u; w] the model is linear in its matrices::

    x+ = [A Bu Bw] v      z = [Cz Dzu 0] v      y = [Cy Dyu Dyw] v      w = f(z; φ)

so the direct terms of a parameter are entries of v, but for those of the static map, which come
from ``torch.func``. The indirect ones, through the state, are one linear recurrence for all
parameters at once::

    S(k+1) = F(k) S(k) + G(k),    dy(k)/dθ = H(k) S(k) + E(k)
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numba import njit
from torch import Tensor

from lfrtorch.cell import LFRCell
from lfrtorch.recurrence import linear_recurrence, to_numpy
from lfrtorch.simulate import Slopes, Trajectory, slopes, static_jacobians
from lfrtorch.threads import spread

CLOSED = 1e-18
"""What the start state still moves of an output, relative to the start, that counts as nothing."""


@torch.no_grad()
def output_jacobian(
    cell: LFRCell,
    u: Tensor,
    trajectory: Trajectory,
    *,
    periodic: bool = False,
    out: Tensor | None = None,
) -> Tensor:
    """dy/dθ along a trajectory, columns in the order of ``cell.named_parameters()``.

    Args:
        cell: the model; parameters with ``requires_grad=False`` get no column.
        u: input of the trajectory.
        trajectory: from a start state that does not depend on θ, or in periodic steady state.
        periodic: the start state is the end state, whatever the parameters.
        out: where to write the result, contiguous.

    Shape:
        u: (R, T, nu) -> (R, T, ny, P).
    """
    terms = _terms(cell, u, trajectory)
    rows = u.new_empty(*u.shape[:2], cell.ny, terms.parameters) if out is None else out
    end = (_rows_compiled if u.device.type == "cpu" else _rows_generic)(cell, terms, rows)
    if periodic:
        _close(terms.slopes, rows, end)
    return rows


def _close(slope: Slopes, rows: Tensor, end: Tensor) -> None:
    """Add what the start state contributes when it moves with θ so that S(0) = S(T).

    S(T) = end + Φ S(0); the rows of the start state fade, and are added as far as they reach.
    """
    identity = torch.eye(end.shape[1], dtype=end.dtype, device=end.device).expand_as(slope.F[:, 0])
    states = linear_recurrence(slope.F, torch.zeros_like(slope.F), identity)
    start = torch.linalg.solve(identity - states[:, -1], end)
    free = slope.H @ states[:, :-1]  # (R, T, ny, nx)
    reach = torch.nonzero(~(free.abs().amax(dim=(0, 2, 3)) <= CLOSED))  # NaN reaches, too
    length = int(reach[-1]) + 1 if len(reach) else 0
    rows[:, :length] += free[:, :length] @ start.unsqueeze(1)


class _Entries(NamedTuple):
    """Direct terms of neighbouring columns, from ``first`` on.

    Column first + c is that of a parameter that multiplies ``v[regressor[c]]`` in row ``row[c]``.
    """

    first: int
    row: list[int]
    regressor: list[int]

    @property
    def columns(self) -> slice:
        """The columns."""
        return slice(self.first, self.first + len(self.row))


class _Terms(NamedTuple):
    """All that the recurrence needs at every sample; columns of x, z, y and static map in turn.

    Shape:
        v: (R, T, nx + nu + nw), J: (R, T, nw, nz), d_static: (R, T, nw, columns of the static map).
    """

    slopes: Slopes
    v: Tensor
    J: Tensor
    d_static: Tensor
    x: _Entries
    z: _Entries
    y: _Entries
    parameters: int


_MATRICES = {
    "x": {"A": "x", "Bu": "u", "Bw": "w"},
    "z": {"Cz": "x", "Dzu": "u"},
    "y": {"Cy": "x", "Dyu": "u", "Dyw": "w"},
}
"""What each matrix multiplies, by the equation it stands in, in the order of the parameters."""


def _terms(cell: LFRCell, u: Tensor, trajectory: Trajectory) -> _Terms:
    v = torch.cat([trajectory.x[:, :-1], u, trajectory.w], dim=-1)
    offset = {"x": 0, "u": cell.nx, "w": cell.nx + cell.nu}
    entries, P = {}, 0
    for left, matrices in _MATRICES.items():
        row, regressor = [], []
        for name, right in matrices.items():
            matrix: Tensor = getattr(cell, name)
            if matrix.requires_grad:
                rows, width = matrix.shape
                row += [i for i in range(rows) for _ in range(width)]
                regressor += list(range(offset[right], offset[right] + width)) * rows
        entries[left] = _Entries(P, row, regressor)
        P += len(row)
    J, by_weight = static_jacobians(cell, trajectory.z, parameters=True)
    static = [by_weight[name] for name, p in _static_parameters(cell) if p.requires_grad]
    d_static = torch.cat([J.new_zeros(*J.shape[:3], 0), *static], dim=-1)
    return _Terms(slopes(cell, J), v, J, d_static, **entries, parameters=P + d_static.shape[-1])


def _static_parameters(cell: LFRCell) -> list[tuple[str, Tensor]]:
    return [] if cell.static is None else list(cell.static.named_parameters())


def _rows_generic(cell: LFRCell, t: _Terms, rows: Tensor) -> Tensor:
    """Write the rows (R, T, ny, P) by the recurrence primitive, any device; S(T) (R, nx, P)."""
    R, T = t.v.shape[:2]
    dw = t.v.new_zeros(R, T, cell.nw, t.parameters)
    dw[..., t.z.columns] = t.J[..., t.z.row] * t.v[..., t.z.regressor].unsqueeze(2)
    dw[..., t.parameters - t.d_static.shape[-1] :] = t.d_static
    G, E = cell.Bw @ dw, cell.Dyw @ dw
    for target, entries in ((G, t.x), (E, t.y)):
        columns = torch.arange(entries.first, entries.columns.stop)
        target[..., entries.row, columns] += t.v[..., entries.regressor]
    S = linear_recurrence(t.slopes.F, G, torch.zeros_like(G[:, 0]))
    torch.add(t.slopes.H @ S[:, :-1], E, out=rows)
    return S[:, -1]


def _rows_compiled(cell: LFRCell, t: _Terms, rows: Tensor) -> Tensor:
    """The same in machine code, without ever storing S over time."""
    R = len(rows)
    end = rows.new_empty(R, cell.nx, t.parameters)
    tensors = (t.slopes.F, t.slopes.H, t.v, t.J, t.d_static, cell.Bw, cell.Dyw)
    entries = []
    for group in (t.x, t.z, t.y):
        entries += [group.first, *(np.array(e, dtype=np.int64) for e in group[1:])]
    chunks = max(1, torch.get_num_threads() // R)
    arguments = [*map(to_numpy, tensors), *entries, chunks, rows.numpy(), end.numpy()]
    spread(_emit, R * chunks, *arguments)
    return end


@njit(cache=True, nogil=True, error_model="numpy")
def _emit(
    job, F, H, v, J, d_static, Bw, Dyw,
    x_first, x_row, x_regressor, z_first, z_row, z_regressor, y_first, y_row, y_regressor,
    chunks, rows, end,
):  # fmt: skip
    _, T, ny, P = rows.shape
    nx, nw = Bw.shape
    r, chunk = job // chunks, job % chunks
    c0, c1 = P * chunk // chunks, P * (chunk + 1) // chunks
    width = c1 - c0
    # The entries of each group that fall into this job's columns c0 .. c1.
    x0, x1 = max(c0 - x_first, 0), min(c1 - x_first, len(x_row))
    z0, z1 = max(c0 - z_first, 0), min(c1 - z_first, len(z_row))
    y0, y1 = max(c0 - y_first, 0), min(c1 - y_first, len(y_row))
    s_first = P - d_static.shape[3]
    s0 = max(c0 - s_first, 0)
    s1 = max(c1 - s_first, s0)
    s_first += s0 - c0
    z_column, x_column, y_column = z_first - c0, x_first - c0, y_first
    S = np.zeros((nx, width), rows.dtype)
    S_next = np.empty_like(S)
    for k in range(T):
        for i in range(ny):
            for c in range(width):
                rows[r, k, i, c0 + c] = H[r, k, i, 0] * S[0, c]
            for j in range(1, nx):
                h = H[r, k, i, j]
                for c in range(width):
                    rows[r, k, i, c0 + c] += h * S[j, c]
            for q in range(nw):
                d = Dyw[i, q]
                for n in range(z0, z1):
                    rows[r, k, i, z_first + n] += d * J[r, k, q, z_row[n]] * v[r, k, z_regressor[n]]
                for n in range(s1 - s0):
                    rows[r, k, i, c0 + s_first + n] += d * d_static[r, k, q, s0 + n]
        for n in range(y0, y1):
            rows[r, k, y_row[n], y_column + n] += v[r, k, y_regressor[n]]
        for i in range(nx):
            f = F[r, k, i, 0]
            for c in range(width):
                S_next[i, c] = f * S[0, c]
            for j in range(1, nx):
                f = F[r, k, i, j]
                for c in range(width):
                    S_next[i, c] += f * S[j, c]
            for q in range(nw):
                b = Bw[i, q]
                for n in range(z0, z1):
                    S_next[i, z_column + n] += b * J[r, k, q, z_row[n]] * v[r, k, z_regressor[n]]
                for n in range(s1 - s0):
                    S_next[i, s_first + n] += b * d_static[r, k, q, s0 + n]
        for n in range(x0, x1):
            S_next[x_row[n], x_column + n] += v[r, k, x_regressor[n]]
        S, S_next = S_next, S
    end[r, :, c0:c1] = S
