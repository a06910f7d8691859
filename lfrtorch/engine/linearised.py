"""The model linearised along a trajectory: x+ = F x, y = H x."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.nonlinearity import linearise_static, of_static

Weights = Mapping[str, Tensor]
"""Parameters of a cell by name."""

PASS = 1 << 14
"""Most samples, of all records together, that are linearised in one pass."""


class Linearised(NamedTuple):
    """F = ∂x(k+1)/∂x(k) and H = ∂y(k)/∂x(k) at every sample."""

    F: Float[Tensor, "R T nx nx"]
    H: Float[Tensor, "R T ny nx"]


@torch.no_grad()
def linearise(cell: LFRCell, z: Float[Tensor, "R T nz"]) -> Linearised:
    """F and H along a trajectory, which depend on the input z of the static map alone."""
    return linearise_at(dict(cell.named_parameters()), static_slope(cell, z))


@torch.no_grad()
def static_slope(cell: LFRCell, z: Float[Tensor, "R T nz"]) -> Float[Tensor, "R T nw nz"]:
    """∂w/∂z of the static map at every sample."""
    return linearise_static(cell.static, z, of_static(dict(cell.named_parameters()))).J


def linearise_at(weights: Weights, J: Float[Tensor, "R T nw nz"]) -> Linearised:
    """F = A + Bw J Cz and H = Cy + Dyw J Cz, with J = ∂w/∂z.

    Both are linear in J: its entries times one constant matrix give [F; H]. That is one large
    product, twenty times faster than small ones at every sample.
    """
    A, Cz = weights["A"], weights["Cz"]
    # products[(q, j), (i, l)] = [Bw; Dyw][i, q] Cz[j, l]
    left = torch.cat([weights["Bw"], weights["Dyw"]], dim=-2)
    products = torch.einsum("...iq,...jl->...qjil", left, Cz).flatten(-2).flatten(-3, -2)
    constant = torch.cat([A, weights["Cy"]], dim=-2).flatten(-2).unsqueeze(-2)
    nx = A.shape[-1]
    both = (J.flatten(-2) @ products + constant).unflatten(-1, (-1, nx))
    return Linearised(both[..., :nx, :], both[..., nx:, :])


def spectral_radius(matrices: Float[Tensor, "*axes n n"]) -> Float[Tensor, "*axes"]:
    """Largest magnitude of the eigenvalues of each matrix; NaN if an entry is not finite.

    Some builds of LAPACK crash the process on such a matrix, so they never see it.
    """
    finite = torch.isfinite(matrices).all(dim=-1).all(dim=-1)
    radii = torch.linalg.eigvals(torch.where(finite[..., None, None], matrices, 0.0)).abs().amax(-1)
    return torch.where(finite, radii, torch.nan)
