"""Where the parameters of a cell stand: in θ, and in the equations.

With v = [x; u; w] the model is linear in its matrices::

    x+ = [A Bu Bw] v      z = [Cz Dzu 0] v      y = [Cy Dyu Dyw] v      w = f(z; φ)

so the direct term of a parameter is an entry of v, unless it belongs to the static map.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lfrtorch.engine.cell import LFRCell

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
    models = cell.A.numel() // cell.nx**2
    parameters = tuple(
        (name, p.numel() // models, every or p.requires_grad) for name, p in cell.named_parameters()
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
