"""A static map without a linear part, which the linear block holds in its place."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import Module

from lfrtorch.engine.cell import LFRCell


class Beyond(Module):
    """What a map f is beyond a linear one, in other coordinates: w = W (f(Z z) - L Z z).

    The buffers ``slope``, ``into`` and ``out`` are L, Z and W.
    """

    slope: Tensor
    into: Tensor
    out: Tensor

    def __init__(
        self,
        base: Module,
        slope: Float[Tensor, "nw nz"],
        into: Float[Tensor, "nz nz"],
        out: Float[Tensor, "nw nw"],
    ) -> None:
        super().__init__()
        self.base = base
        self.register_buffer("slope", slope)
        self.register_buffer("into", into)
        self.register_buffer("out", out)

    def weight_shapes(self, nz: int, nw: int) -> dict[str, tuple[int, ...]]:
        """Shapes of L, Z, W and the weights of f for nz and nw signals."""
        of_base = getattr(self.base, "weight_shapes", None)
        own = {} if of_base is None else of_base(nz, nw)
        shapes: dict[str, tuple[int, ...]] = {"slope": (nw, nz), "into": (nz, nz), "out": (nw, nw)}
        return shapes | {f"base.{name}": shape for name, shape in own.items()}

    def forward(self, z: Float[Tensor, "*axes nz"]) -> Float[Tensor, "*axes nw"]:
        """w of z."""
        z = z @ self.into.mT
        return (self.base(z) - z @ self.slope.mT) @ self.out.mT

    def __repr__(self) -> str:
        return f"{self.base!r} less a linear map"


def base_of(static: Module | None) -> Module | None:
    """A map, or f of a ``Beyond``."""
    return base_of(static.base) if isinstance(static, Beyond) else static


@torch.no_grad()
def folded(cell: LFRCell) -> LFRCell:
    """The cell with f itself in the place of its ``Beyond``; any other cell as it is.

    L, Z and W go into the linear block. x, u and y stay; z and w are those of f.
    """
    beyond = cell.static
    if not isinstance(beyond, Beyond):
        return cell
    sizes = cell.nu, cell.ny, cell.nx, cell.nz, cell.nw
    found = LFRCell(*sizes, beyond.base, device=cell.A.device, dtype=cell.A.dtype)
    L, Z, W = beyond.slope, beyond.into, beyond.out
    Cz, Dzu, Bw, Dyw = Z @ cell.Cz, Z @ cell.Dzu, cell.Bw @ W, cell.Dyw @ W
    found.state_covariance.copy_(cell.state_covariance)
    found.A.copy_(cell.A - Bw @ L @ Cz)
    found.Bu.copy_(cell.Bu - Bw @ L @ Dzu)
    found.Bw.copy_(Bw)
    found.Cz.copy_(Cz)
    found.Dzu.copy_(Dzu)
    found.Cy.copy_(cell.Cy - Dyw @ L @ Cz)
    found.Dyu.copy_(cell.Dyu - Dyw @ L @ Dzu)
    found.Dyw.copy_(Dyw)
    return folded(found)
