"""The model linearised along a trajectory: x+ = F x, y = H x."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.recurrence import linear_recurrence
from lfrtorch.engine.static_jacobian import linearise_static

PASS = 1 << 14
"""Samples of a long record that are linearised together."""


class Linearised(NamedTuple):
    """The model linearised along a trajectory: x+ = F x, y = H x.

    Shape:
        F: (R, T, nx, nx), H: (R, T, ny, nx).
    """

    F: Tensor
    H: Tensor


@torch.no_grad()
def linearise(cell: LFRCell, z: Tensor) -> Linearised:
    """The linearised model at the inputs z (R, T, nz) of its static nonlinearity."""
    weights = {name: p.detach() for name, p in cell.named_parameters()}
    return linearise_at(weights, linearise_static(cell.static, z, of_static(weights)).J)


def linearise_at(weights: dict[str, Tensor], J: Tensor) -> Linearised:
    """F = A + Bw J Cz and H = Cy + Dyw J Cz for J (R, T, nw, nz), by one product with a matrix.

    The product is twenty times faster than as many products of small matrices.
    """
    A, Cz = weights["A"], weights["Cz"]
    left = torch.cat([weights["Bw"], weights["Dyw"]], dim=-2)
    products = torch.einsum("...iq,...jl->...qjil", left, Cz).flatten(-2).flatten(-3, -2)
    constant = torch.cat([A, weights["Cy"]], dim=-2).flatten(-2).unsqueeze(-2)
    nx = A.shape[-1]
    both = (J.flatten(-2) @ products + constant).unflatten(-1, (-1, nx))
    return Linearised(both[..., :nx, :], both[..., nx:, :])


def of_static(weights: dict[str, Tensor]) -> dict[str, Tensor]:
    """The weights of the static nonlinearity among those of the cell, by their own names."""
    start = "static."
    return {name.removeprefix(start): p for name, p in weights.items() if name.startswith(start)}


def spectral_radius(matrices: Tensor) -> Tensor:
    """Largest magnitude of an eigenvalue of each of (..., n, n); NaN where an entry is not finite.

    LAPACK is not asked then: some builds crash the process.
    """
    finite = torch.isfinite(matrices).all(dim=-1).all(dim=-1)
    radii = torch.linalg.eigvals(torch.where(finite[..., None, None], matrices, 0.0)).abs().amax(-1)
    return torch.where(finite, radii, torch.nan)


def monodromy(cell: LFRCell, z: Tensor) -> Tensor:
    """Transition matrix (R, nx, nx) over a record along z (R, T, nz): the product of all F(k)."""
    Phi = torch.eye(cell.nx).to(z).expand(len(z), cell.nx, cell.nx)
    for part in z.split(max(1, PASS // len(z)), dim=1):
        F = linearise(cell, part).F
        Phi = linear_recurrence(F, torch.zeros_like(F), Phi)[:, -1]
    return Phi
