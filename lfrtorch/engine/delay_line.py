"""The cell of a model whose inputs act later, with its delays as states.

The states s_1 to s_d hold the last d samples of an input u, and the last one acts in the place of
u::

    x+ = A x + Bu s_d + Bw w,    z = Cz x + Dzu s_d,    y = Cy x + Dyu s_d + Dyw w,
    s_1+ = u,    s_i+ = s_(i-1)
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy

import torch
from torch import Tensor

from lfrtorch.engine.cell import LFRCell


@torch.no_grad()
def delay_line_cell(cell: LFRCell, delay: Sequence[int]) -> LFRCell:
    """The cell with the states (x, s), s for each input in turn; a fit holds what delays."""
    nx, line = cell.nx, sum(delay)
    found = LFRCell(
        cell.nu, cell.ny, nx + line, cell.nz, cell.nw, deepcopy(cell.static),
        device=cell.A.device, dtype=cell.A.dtype, random=False,
    )  # fmt: skip
    later = torch.tensor([d > 0 for d in delay])
    ends = nx + torch.tensor(delay).cumsum(0)[later] - 1  # the last state of each line
    begins = ends + 1 - torch.tensor(delay)[later]

    def by_states(of_x: Tensor, of_u: Tensor, rest: float | bool) -> Tensor:
        """Columns of x and s: a delayed input acts through the last state of its line."""
        columns = of_x.new_full((len(of_x), nx + line), rest)
        columns[:, :nx], columns[:, ends] = of_x, of_u[:, later]
        return columns

    def in_rows(of_x: Tensor, rest: float | bool) -> Tensor:
        """Rows of x and s."""
        rows = of_x.new_full((nx + line, of_x.shape[1]), rest)
        rows[:nx] = of_x
        return rows

    def written(of: Mapping[str, Tensor], rest: float | bool) -> dict[str, Tensor]:
        """All matrices, or masks; ``rest`` fills the entries that the cell does not have."""
        pairs = {"A": "Bu", "Cz": "Dzu", "Cy": "Dyu"}
        whole = {x: by_states(of[x], of[u], rest) for x, u in pairs.items()}
        whole |= {u: torch.where(later, rest, of[u]) for u in pairs.values()}
        whole |= {"Bw": of["Bw"], "Dyw": of["Dyw"]}
        return whole | {name: in_rows(whole[name], rest) for name in ("A", "Bu", "Bw")}

    own = dict(cell.named_parameters(recurse=False))
    for name, value in written(own, 0.0).items():
        found.get_parameter(name).copy_(value)
        found.get_parameter(name).requires_grad_(own[name].requires_grad)
    shifts = torch.ones(line - 1)
    shifts[ends[:-1] - nx] = 0.0  # the end of a line does not lead to the next line
    found.A[nx:, nx:] = torch.diag(shifts, -1).to(cell.A)
    found.Bu[begins, later.nonzero()[:, 0]] = 1.0
    found.state_covariance[:nx, :nx] = cell.state_covariance
    none = {name: torch.zeros(p.shape, dtype=torch.bool) for name, p in own.items()}
    masks = written({name: cell.held.get(name, mask) for name, mask in none.items()}, True)
    found.held = {name: mask for name, mask in cell.held.items() if name not in masks}
    found.held |= {name: mask for name, mask in masks.items() if mask.any()}
    return found
