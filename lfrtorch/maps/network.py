"""Network with one hidden layer, as a static map."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import Parameter

from lfrtorch._support.checks import integer
from lfrtorch._support.errors import InputError
from lfrtorch._support.threads import to_float64
from lfrtorch._support.types import Array
from lfrtorch.maps.activation_kernel import LANES, dot, hidden
from lfrtorch.maps.activations import ACTIVATIONS, Activation
from lfrtorch.maps.enclosure import Enclosure, Interval, Layer
from lfrtorch.maps.machine_code import PREPARE, SLOPE, Code, address
from lfrtorch.maps.mean_slopes import Neurons
from lfrtorch.maps.static_map import StaticMap, Symmetry, combined
from lfrtorch.maps.written import Vectors, Written


class Network(StaticMap):
    """Network with one hidden layer: w = Ww σ(Wz z + bz) + bw.

    Args:
        nz: number of inputs.
        nw: number of outputs.
        nn: number of neurons.
        activation: σ, by its name in ``lfrtorch.maps.activations``, such as ``"tanh"``, ``"relu"``
            or ``"rbf"``, which is exp(-v²).
        device, dtype: device and dtype of the weights, as in any torch module.

    Shape:
        Wz: (nn, nz), bz: (nn,), Ww: (nw, nn), bw: (nw,).

    Raises:
        ValueError: an unknown activation, or a size below 1.

    Example:
        >>> static = lfrtorch.Network(nz=2, nw=1, nn=15)
        >>> static
        Network(nz=2, nw=1, nn=15, activation='tanh')
        >>> static(torch.zeros(8, 2)).shape
        torch.Size([8, 1])
    """

    def __init__(
        self,
        nz: int,
        nw: int,
        nn: int,
        activation: str = "tanh",
        *,
        device: torch.device | None = None,
        dtype: torch.dtype | None = None,
    ) -> None:
        super().__init__(nz, nw)
        if not (isinstance(activation, str) and activation in ACTIVATIONS):
            raise InputError(
                f"activation is {activation!r}; use one of {', '.join(sorted(ACTIVATIONS))}."
            )
        for name, size in (("nz", nz), ("nw", nw), ("nn", nn)):
            integer(name, size, 1)
        self.activation = activation
        self.Wz = Parameter(torch.empty(nn, nz, device=device, dtype=dtype))
        self.bz = Parameter(torch.empty(nn, device=device, dtype=dtype))
        self.Ww = Parameter(torch.empty(nw, nn, device=device, dtype=dtype))
        self.bw = Parameter(torch.empty(nw, device=device, dtype=dtype))
        self.reset_parameters()

    def reset_parameters(self, generator: torch.Generator | None = None) -> None:
        """Draw Wz, bz, Ww ~ U(-1, 1), and set bw = 0, as in Schoukens and Tóth (2020)."""
        with torch.no_grad():
            for weight in (self.Wz, self.bz, self.Ww):
                weight.uniform_(-1.0, 1.0, generator=generator)
            self.bw.zero_()

    def weight_shapes(self, nz: int, nw: int) -> dict[str, tuple[int, ...]]:
        """Shapes of the weights of a map from nz to nw signals with these neurons."""
        nn = self.bz.shape[-1]
        return {"Wz": (nn, nz), "bz": (nn,), "Ww": (nw, nn), "bw": (nw,)}

    def forward(self, z: Float[Tensor, "*axes nz"]) -> Float[Tensor, "*axes nw"]:
        """Output w of z."""
        return self.sigma.value(z @ self.Wz.mT + self.bz) @ self.Ww.mT + self.bw

    @property
    def sigma(self) -> Activation:
        """Activation σ."""
        return ACTIVATIONS[self.activation]

    @property
    def sizes(self) -> dict[str, int]:
        """Number of neurons nn."""
        return {"nn": self.bz.shape[-1]}

    def equations(self, z: Sequence[Any], phi: Sequence[Any]) -> Sequence[Any]:
        """Output w from z and φ, which are sequences of numbers."""
        nn, sigma = self.bz.shape[-1], self.sigma.of_number or self.sigma.value
        at = iter(phi)
        Wz = [[next(at) for _ in range(self.nz)] for _ in range(nn)]
        h = [sigma(combined(row, z, next(at))) for row in Wz]
        Ww = [[next(at) for _ in range(nn)] for _ in range(self.nw)]
        return [combined(row, h, next(at)) for row in Ww]

    @property
    def code(self) -> Code:
        """The map in machine code."""
        nn = self.bz.shape[-1]
        lanes = LANES * -(-nn // LANES)
        ints = np.array([self.nz, self.nw, nn, self.sigma.code, lanes])
        made = address(_prepare, PREPARE), address(_value), address(_slope, SLOPE)
        return Code(*made, ints, np.zeros(0), (self.nz + self.nw + 4) * lanes)

    @property
    def symmetries(self) -> list[Symmetry]:
        """Changes of coordinates of z and of w."""
        return [
            Symmetry("z", slice(0, self.nz), lambda T, W: {"Wz": -W["Wz"] @ T}),
            Symmetry("w", slice(0, self.nw), lambda T, W: {"Ww": T @ W["Ww"], "bw": T @ W["bw"]}),
        ]

    def across_branches(self) -> dict[str, Bool[Tensor, ...]]:
        """Entries that are 0 if each w depends on one z: those between neurons and other pairs."""
        branch = torch.arange(len(self.Wz)) * self.nz // len(self.Wz)
        across = branch[:, None] != torch.arange(self.nz)
        return {"Wz": across, "Ww": across.mT}

    @property
    def meaning(self) -> str:
        """Equation of f(z)."""
        of_sigma = f", {self.sigma.meaning}" if self.sigma.meaning else ""
        return f"Ww {self.activation}(Wz z + bz) + bw{of_sigma}"

    @property
    def written(self) -> Written:
        """Two affine maps, and σ of every neuron between them."""

        def of(language: Vectors, z: Any) -> Any:
            h = language.each(self.sigma.formula, language.affine("Wz", z, "bz"))
            return language.affine("Ww", h, "bw")

        return Written("network", dict(self.named_parameters()), of)

    @property
    def neurons(self) -> Neurons:
        """The mean slopes of the neurons: Δ = Ww diag(p) Wz."""
        Wz, bz, Ww, _ = (to_float64(p) for p in self.parameters())

        def mean_slopes(z0: Float[Array, " nz"], zeta: Float[Array, "S nz"]) -> Array:
            return self.sigma.mean_slope(Wz @ z0 + bz, zeta @ Wz.T)

        return Neurons(Ww, Wz, np.tile(self.sigma.slope_bounds, (len(Wz), 1)), mean_slopes)

    @property
    def title(self) -> str:
        """Name with the activation."""
        return f"network of {self.activation}"

    def describe(self) -> dict[str, Any]:
        """Neurons and activation."""
        return {"type": "Network", **self.sizes, "activation": self.activation}

    @torch.no_grad()
    def beside(self, others: Sequence[StaticMap]) -> StaticMap | None:
        """Network with the neurons of all maps, if all are networks of the same activation."""
        if any({**(other.describe() or {}), **self.sizes} != self.describe() for other in others):
            return None
        maps = [self, *others]
        sizes = [(each.nz, each.nw, each.sizes["nn"]) for each in maps]
        like = {"device": self.bz.device, "dtype": self.bz.dtype}
        nz, nw, nn = map(sum, zip(*sizes, strict=True))
        found = Network(nz, nw, nn, self.activation, **like)
        for name, weight in found.named_parameters():
            parts = [each.get_parameter(name) for each in maps]
            weight.copy_(torch.block_diag(*parts) if weight.ndim == 2 else torch.cat(parts))
        return found

    def zero_output(self) -> None:
        """Set Ww = 0 and bw = 0."""
        with torch.no_grad():
            self.Ww.zero_()
            self.bw.zero_()

    def redundant(self, fed: int, ny: int | None = None) -> int:
        """Number of redundant parameters: bases of z and w, inputs z not fed, constants of w."""
        nz, nn = min(self.nz, fed), self.bz.shape[-1]
        constant = 0 if ny is None else max(0, self.nw - ny)
        return self.nz * nz + nn * (self.nz - nz) + self.nw**2 + constant

    @property
    def _layer(self) -> Layer:
        return Layer(self.sigma, self.Wz, self.bz, self.Ww, self.bw)

    def enclosure(
        self, z: Interval, a: Interval | None = None, K: Float[Array, "nw nz"] | None = None
    ) -> Enclosure:
        """Bounds of w and its slopes over a box z (nz,)."""
        return self._layer.enclosure(z, a, K)

    def slopes_in(
        self, v: Interval, into: Float[Array, "nz nz"], middle: Float[Array, " nz"]
    ) -> Interval:
        """Bounds of ∂w/∂v (C, nw, nz) over cells of v (C, nz), z = into v + middle."""
        return self._layer.slopes_in(v, into, middle)

    # Closed forms, six times faster than by ``torch.func``: v = Wz z + bz, h = σ(v), s = σ'(v).

    def slope(
        self, z: Float[Tensor, "R T nz"], phi: Float[Tensor, " P"]
    ) -> Float[Tensor, "R T nw nz"]:
        """Slope ∂w/∂z = Ww diag(s) Wz."""
        Wz, bz, Ww, _ = self.named_weights(phi).values()
        v = z @ Wz.mT + bz
        s = self.sigma.slope(v, self.sigma.value(v))
        # A sum over the neurons of s_n Ww[:, n] Wz[n, :]: one product with (nn, nw nz).
        rank_ones = (Ww.mT.unsqueeze(-1) * Wz.unsqueeze(-2)).flatten(-2)
        return (s @ rank_ones).unflatten(-1, (self.nw, self.nz))

    def by_weight(
        self, z: Float[Tensor, "R T nz"], phi: Float[Tensor, " P"]
    ) -> Float[Tensor, "R T nw P"]:
        """Derivatives of w_q: Ww[q, n] s_n z_j (Wz[n, j]), Ww[q, n] s_n (bz[n]), h_n (Ww[q, n])."""
        Wz, bz, Ww, _ = self.named_weights(phi).values()
        v = z @ Wz.mT + bz
        h = self.sigma.value(v)
        by_bz = self.sigma.slope(v, h).unsqueeze(-2) * Ww
        by_Wz = (by_bz.unsqueeze(-1) * z[..., None, None, :]).flatten(-2)
        same = torch.eye(self.nw).to(z)
        by_Ww = torch.einsum("...n,qp->...qpn", h, same).flatten(-2)
        return torch.cat([by_Wz, by_bz, by_Ww, same.expand(*by_Ww.shape[:-1], -1)], dim=-1)

    def extra_repr(self) -> str:
        """Sizes and activation, for ``print(module)``."""
        (nn, nz), nw = self.Wz.shape, len(self.Ww)
        return f"nz={nz}, nw={nw}, nn={nn}, activation={self.activation!r}"


# The scratch array has the weights Wzᵀ, bz and Ww, row by row, padded with zero neurons to a
# multiple of ``LANES``. Then follow v, h = σ(v) and s = σ'(v).


def _prepare(ints, constants, weights, room):
    nz, nw, nn, lanes = ints[0], ints[1], ints[2], ints[4]
    for n in range(lanes):
        own = n < nn
        for j in range(nz):
            room[j * lanes + n] = weights[n * nz + j] if own else 0.0
        for q in range(nw + 1):  # bz is a row before Ww
            room[(nz + q) * lanes + n] = weights[nn * (nz + q) + n] if own else 0.0


def _value(ints, constants, weights, z, w, room):
    nz, nw, nn, lanes = ints[0], ints[1], ints[2], ints[4]
    Ww, v, bw = (nz + 1) * lanes, (nz + 1 + nw) * lanes, nn * (nz + 1 + nw)
    hidden(ints[3], nz, lanes, room, z, v)
    for q in range(nw):
        w[q] = weights[bw + q] + dot(room, Ww + q * lanes, room, v + lanes, lanes)


def _slope(ints, constants, weights, z, J, by_weight, stride, room):
    nz, nw, nn, lanes = ints[0], ints[1], ints[2], ints[4]
    Ww, v, bw = (nz + 1) * lanes, (nz + 1 + nw) * lanes, nn * (nz + 1 + nw)
    h, s = v + lanes, v + 2 * lanes
    hidden(ints[3], nz, lanes, room, z, v)
    for q in range(nw):
        own = q * stride
        by_bz, by_Ww = own + nn * nz, own + nn * (nz + 1)
        for n in range(lanes):
            room[v + n] = room[Ww + q * lanes + n] * room[s + n]
        for j in range(nz):
            J[q * nz + j] = dot(room, j * lanes, room, v, lanes)
        if stride == 0:
            continue
        if nz == 1:  # known strides allow vector instructions
            z0 = z[0]
            for n in range(nn):
                by_weight[own + n] = room[v + n] * z0
                by_weight[by_bz + n] = room[v + n]
        elif nz == 2:
            z0, z1 = z[0], z[1]
            for n in range(nn):
                by_weight[own + 2 * n] = room[v + n] * z0
                by_weight[own + 2 * n + 1] = room[v + n] * z1
                by_weight[by_bz + n] = room[v + n]
        else:
            for n in range(nn):
                for j in range(nz):
                    by_weight[own + n * nz + j] = room[v + n] * z[j]
                by_weight[by_bz + n] = room[v + n]
        for p in range(nw):
            if p == q:
                for n in range(nn):
                    by_weight[by_Ww + p * nn + n] = room[h + n]
            else:
                for n in range(nn):
                    by_weight[by_Ww + p * nn + n] = 0.0
            by_weight[own + bw + p] = 1.0 if p == q else 0.0
