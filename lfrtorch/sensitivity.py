"""Jacobian of the simulated output with respect to every parameter of the cell.

With v = [x; u; w] the model is linear in its matrices::

    x+ = [A Bu Bw] v      z = [Cz Dzu 0] v      y = [Cy Dyu Dyw] v      w = f(z; φ)

so the direct terms of a parameter are entries of v, but for those of the static map, which come
from ``torch.func``. The indirect ones, through the state, are one linear recurrence for all
parameters at once::

    S(k+1) = F(k) S(k) + G(k),    dy(k)/dθ = H(k) S(k) + E(k)

The start state gets nx columns of its own (S(0) = I, no direct terms); they close the periodic
boundary.
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


@torch.no_grad()
def output_jacobian(
    cell: LFRCell, u: Tensor, trajectory: Trajectory, *, periodic: bool = False
) -> Tensor:
    """dy/dθ along a trajectory, columns in the order of ``cell.named_parameters()``.

    Args:
        cell: the model; parameters with ``requires_grad=False`` get no column.
        u: input of the trajectory.
        trajectory: from a start state that does not depend on θ, or in periodic steady state.
        periodic: the start state is the end state, whatever the parameters.

    Shape:
        u: (R, T, nu) -> (R, T, ny, P).
    """
    terms = _terms(cell, u, trajectory)
    rows, end = (_rows_compiled if u.device.type == "cpu" else _rows_generic)(cell, terms)
    P = rows.shape[-1] - cell.nx
    if not periodic:
        return rows[..., :P]
    # The start state moves with θ so that S(0) = S(T): S(T) = end + Φ S(0).
    identity = torch.eye(cell.nx, dtype=u.dtype, device=u.device)
    start = torch.linalg.solve(identity - end[..., P:], end[..., :P])
    return rows[..., :P] + rows[..., P:] @ start.unsqueeze(1)


class _Column(NamedTuple):
    """Where columns of the Jacobian take their direct terms from.

    Entry c says: parameter ``column[c]`` multiplies ``v[regressor[c]]`` in row ``row[c]``.
    """

    column: list[int]
    row: list[int]
    regressor: list[int]


class _Terms(NamedTuple):
    """All that the recurrence needs at every sample.

    Shape:
        v: (R, T, nx + nu + nw), J: (R, T, nw, nz), d_static: (R, T, nw, columns of the static map).
    """

    slopes: Slopes
    v: Tensor
    J: Tensor
    d_static: Tensor
    x: _Column
    y: _Column
    z: _Column
    static_columns: list[int]
    parameters: int


def _terms(cell: LFRCell, u: Tensor, trajectory: Trajectory) -> _Terms:
    v = torch.cat([trajectory.x[:, :-1], u, trajectory.w], dim=-1)
    first = {"x": 0, "u": cell.nx, "w": cell.nx + cell.nu}
    groups = {
        "A": ("x", "x"), "Bu": ("x", "u"), "Bw": ("x", "w"),
        "Cz": ("z", "x"), "Dzu": ("z", "u"),
        "Cy": ("y", "x"), "Dyu": ("y", "u"), "Dyw": ("y", "w"),
    }  # fmt: skip
    J, by_weight = static_jacobians(cell, trajectory.z, parameters=True)
    columns = {left: _Column([], [], []) for left in "xyz"}
    static, static_columns = [J.new_zeros(*J.shape[:3], 0)], []
    P = 0
    for name, parameter in cell.named_parameters():
        if not parameter.requires_grad:
            continue
        mine = range(P, P := P + parameter.numel())
        if name in groups:
            left, right = groups[name]
            rows, width = parameter.shape
            columns[left].column.extend(mine)
            columns[left].row.extend(i for i in range(rows) for _ in range(width))
            columns[left].regressor.extend(list(range(first[right], first[right] + width)) * rows)
        else:
            static.append(by_weight[name.removeprefix("static.")])
            static_columns.extend(mine)
    return _Terms(
        slopes(cell, J), v, J, torch.cat(static, dim=-1), **columns,
        static_columns=static_columns, parameters=P,
    )  # fmt: skip


def _rows_generic(cell: LFRCell, t: _Terms) -> tuple[Tensor, Tensor]:
    """Rows (R, T, ny, P + nx) and end (R, nx, P + nx) by the recurrence primitive, any device."""
    R, T = t.v.shape[:2]
    dw = t.v.new_zeros(R, T, cell.nw, t.parameters + cell.nx)
    dw[..., t.z.column] = t.J[..., t.z.row] * t.v[..., t.z.regressor].unsqueeze(2)
    dw[..., t.static_columns] = t.d_static
    G, E = cell.Bw @ dw, cell.Dyw @ dw
    G[..., t.x.row, t.x.column] = t.v[..., t.x.regressor]
    E[..., t.y.row, t.y.column] = t.v[..., t.y.regressor]
    S = linear_recurrence(t.slopes.F, G, _start(G, cell.nx))
    return t.slopes.H @ S[:, :-1] + E, S[:, -1]


def _start(like: Tensor, nx: int) -> Tensor:
    """S(0): zero for the parameters, the identity for the start state."""
    S = like.new_zeros(len(like), nx, like.shape[-1])
    S[:, :, -nx:] = torch.eye(nx, dtype=like.dtype, device=like.device)
    return S


def _rows_compiled(cell: LFRCell, t: _Terms) -> tuple[Tensor, Tensor]:
    """The same in machine code, without ever storing S over time."""
    R, T = t.v.shape[:2]
    rows = t.v.new_empty(R, T, cell.ny, t.parameters + cell.nx)
    end = _start(rows[:, 0], cell.nx)
    tensors = (t.slopes.F, t.slopes.H, t.v, t.J, t.d_static, cell.Bw, cell.Dyw)
    lists = (*t.x, *t.y, *t.z, t.static_columns)
    chunks = max(1, torch.get_num_threads() // R)
    indices = (np.asarray(entries, dtype=np.int64) for entries in lists)
    arguments = [*map(to_numpy, tensors), *indices, chunks, rows.numpy(), end.numpy()]
    spread(_emit, R * chunks, *arguments)
    return rows, end


@njit(cache=True, nogil=True, error_model="numpy")
def _emit(
    job,
    F, H, v, J, d_static, Bw, Dyw,
    x_column, x_row, x_regressor, y_column, y_row, y_regressor, z_column, z_row, z_regressor,
    static_column, chunks, rows, end,
):  # fmt: skip
    _, T, ny, C = rows.shape
    nx, nw = Bw.shape
    r, chunk = job // chunks, job % chunks
    c0, c1 = C * chunk // chunks, C * (chunk + 1) // chunks
    # Entries of each list that fall into this job's columns (the lists are ascending).
    x0, x1 = np.searchsorted(x_column, c0), np.searchsorted(x_column, c1)
    y0, y1 = np.searchsorted(y_column, c0), np.searchsorted(y_column, c1)
    z0, z1 = np.searchsorted(z_column, c0), np.searchsorted(z_column, c1)
    s0, s1 = np.searchsorted(static_column, c0), np.searchsorted(static_column, c1)
    S = end[r, :, c0:c1].copy()
    S_next = np.empty_like(S)
    for k in range(T):
        for i in range(ny):
            row = rows[r, k, i, c0:c1]
            row[:] = 0
            for j in range(nx):
                h = H[r, k, i, j]
                for c in range(c1 - c0):
                    row[c] += h * S[j, c]
        for n in range(y0, y1):
            rows[r, k, y_row[n], y_column[n]] += v[r, k, y_regressor[n]]
        for i in range(nx):
            S_next[i, :] = 0
            for j in range(nx):
                f = F[r, k, i, j]
                for c in range(c1 - c0):
                    S_next[i, c] += f * S[j, c]
        for n in range(x0, x1):
            S_next[x_row[n], x_column[n] - c0] += v[r, k, x_regressor[n]]
        for q in range(nw):
            for n in range(z0, z1):
                dw = J[r, k, q, z_row[n]] * v[r, k, z_regressor[n]]
                for i in range(nx):
                    S_next[i, z_column[n] - c0] += Bw[i, q] * dw
                for i in range(ny):
                    rows[r, k, i, z_column[n]] += Dyw[i, q] * dw
            for n in range(s0, s1):
                dw = d_static[r, k, q, n]
                for i in range(nx):
                    S_next[i, static_column[n] - c0] += Bw[i, q] * dw
                for i in range(ny):
                    rows[r, k, i, static_column[n]] += Dyw[i, q] * dw
        S, S_next = S_next, S
    end[r, :, c0:c1] = S
