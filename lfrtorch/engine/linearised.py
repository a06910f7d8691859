"""The model linearised along a trajectory: x+ = F x, y = H x."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.weights import Weights
from lfrtorch.maps.linearised import linearise_map

PASS = 1 << 14
"""Largest number of samples, of all records together, that are linearised in one pass."""


class Linearised(NamedTuple):
    """F = ∂x(k+1)/∂x(k) and H = ∂y(k)/∂x(k) at every sample."""

    F: Float[Tensor, "R T nx nx"]
    H: Float[Tensor, "R T ny nx"]


@torch.no_grad()
def linearise(model: LFRCell | Weights, z: Float[Tensor, "R T nz"]) -> Linearised:
    """F and H along a trajectory, which depend on the input z of the static map alone."""
    W = model.weights()
    return linearise_at(W, static_slope(W, z))


@torch.no_grad()
def static_slope(
    model: LFRCell | Weights, z: Float[Tensor, "R T nz"]
) -> Float[Tensor, "R T nw nz"]:
    """Slope ∂w/∂z of the static map at every sample."""
    W = model.weights()
    return linearise_map(W.map, z, W.phi, W.layout.code).J


def linearise_at(W: Weights, J: Float[Tensor, "R T nw nz"]) -> Linearised:
    """F = A + Bw J Cz and H = Cy + Dyw J Cz, with J = ∂w/∂z.

    Both are linear in J: its entries times a constant matrix give [F; H]. This single large product
    is twenty times faster than small products at every sample.
    """
    # products[(q, j), (i, l)] = [Bw; Dyw][i, q] Cz[j, l]
    left = torch.cat([W.Bw, W.Dyw], dim=-2)
    products = torch.einsum("iq,jl->qjil", left, W.Cz).flatten(-2).flatten(-3, -2)
    constant = torch.cat([W.A, W.Cy], dim=-2).flatten(-2).unsqueeze(-2)
    both = (J.flatten(-2) @ products + constant).unflatten(-1, (-1, W.nx))
    return Linearised(both[..., : W.nx, :], both[..., W.nx :, :])


def fed_back(M: Any, J: Any) -> tuple[Any, Any, Any, Any]:
    """A, B, C and D of ``Matrices`` or ``Weights`` whose loop is closed by w = J z."""
    Bw, Dyw = M.Bw @ J, M.Dyw @ J
    return M.A + Bw @ M.Cz, M.Bu + Bw @ M.Dzu, M.Cy + Dyw @ M.Cz, M.Dyu + Dyw @ M.Dzu


def spectral_radius(matrices: Float[Tensor, "*axes n n"]) -> Float[Tensor, "*axes"]:
    """Largest magnitude of the eigenvalues of each matrix; NaN if an entry is not finite.

    Some builds of LAPACK crash the process on such a matrix, so it is never passed to LAPACK.
    """
    finite = torch.isfinite(matrices).all(dim=-1).all(dim=-1)
    radii = torch.linalg.eigvals(torch.where(finite[..., None, None], matrices, 0.0)).abs().amax(-1)
    return torch.where(finite, radii, torch.nan)
