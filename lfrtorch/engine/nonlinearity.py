"""Static nonlinearities z -> w: any torch.nn.Module from (..., nz) to (..., nw) will do."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations_with_replacement
from typing import Any, NamedTuple, TypeGuard, cast

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import Module, Parameter

from lfrtorch._support.checks import integer
from lfrtorch._support.errors import InputError
from lfrtorch._support.memory import check_memory
from lfrtorch._support.types import Integers
from lfrtorch.engine.activations import ACTIVATIONS, Activation
from lfrtorch.engine.direct_sum import DirectSum, DirectSumJacobian
from lfrtorch.engine.known_map import KnownMap
from lfrtorch.engine.operations import Formula, Symbol
from lfrtorch.engine.static_jacobian import (
    ModuleJacobian,
    NetworkJacobian,
    PolynomialJacobian,
    StaticJacobian,
    Weights,
)


class Kernel(NamedTuple):
    """A map as ``simulation_kernel`` takes it: w = last h + offset, h = σ(first z + bias).

    With a growth of monomials h are these instead, see ``Polynomial``.
    """

    first: Tensor
    last: Tensor
    bias: Tensor
    offset: Tensor
    code: int = 0
    growth: Integers = np.zeros((0, 2), np.int64)


class Network(Module):
    """One hidden layer: w = Ww σ(Wz z + bz) + bw.

    Args:
        nz: inputs.
        nw: outputs.
        nn: neurons.
        activation: σ, by its name in ``lfrtorch.engine.activations``: as ``"tanh"``, ``"relu"`` or
            ``"rbf"``, exp(-v²).
        device, dtype: of the weights, as in any torch module.

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
        super().__init__()
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
        """Wz, bz, Ww ~ U(-1, 1) and bw = 0, the draw of Schoukens and Tóth (2020)."""
        with torch.no_grad():
            for weight in (self.Wz, self.bz, self.Ww):
                weight.uniform_(-1.0, 1.0, generator=generator)
            self.bw.zero_()

    def weight_shapes(self, nz: int, nw: int) -> dict[str, tuple[int, ...]]:
        """Shapes of the weights of a map from nz to nw signals with these neurons."""
        nn = self.bz.shape[-1]
        return {"Wz": (nn, nz), "bz": (nn,), "Ww": (nw, nn), "bw": (nw,)}

    def forward(self, z: Float[Tensor, "*axes nz"]) -> Float[Tensor, "*axes nw"]:
        """w of z."""
        return self.sigma.value(z @ self.Wz.mT + self.bz) @ self.Ww.mT + self.bw

    @property
    def sigma(self) -> Activation:
        """σ."""
        return ACTIVATIONS[self.activation]

    @property
    def sizes(self) -> dict[str, int]:
        """nn."""
        return {"nn": self.bz.shape[-1]}

    @property
    def kernel(self) -> Kernel:
        """The map for compiled code."""
        return Kernel(self.Wz.mT, self.Ww, self.bz, self.bw, self.sigma.code)

    def of_symbols(self, z: Sequence[Symbol]) -> list[Any]:
        """w of z for a table of operations."""
        Wz, bz, Ww, bw = (
            weight.detach().double().cpu().tolist()
            for weight in (self.Wz, self.bz, self.Ww, self.bw)
        )
        sigma: Any = self.sigma.value
        if self.activation == "softplus":
            sigma = torch.nn.functional.softplus
        h = [sigma(_combined(row, z, constant)) for row, constant in zip(Wz, bz, strict=True)]
        return [_combined(row, h, constant) for row, constant in zip(Ww, bw, strict=True)]

    def linearised(self, z: Float[Tensor, "R T nz"], weights: Weights) -> StaticJacobian:
        """The map linearised at z, with the given weights."""
        return NetworkJacobian(self.sigma, z, weights)

    def extra_repr(self) -> str:
        """Sizes and activation, for ``print(module)``."""
        (nn, nz), nw = self.Wz.shape, len(self.Ww)
        return f"nz={nz}, nw={nw}, nn={nn}, activation={self.activation!r}"


class Polynomial(Module):
    """All monomials up to a total degree: w = C m(z), m(z) = (1, z1, z2, .., z1², z1 z2, ..).

    Affine maps of z and of w change nothing but C.

    Args:
        nz: inputs.
        nw: outputs.
        degree: highest total degree.
        device, dtype: of the weights, as in any torch module.

    Shape:
        C: (nw, monomials). There are (nz + degree)! / (nz! degree!) monomials by rising degree; the
        constant is column 0.

    Raises:
        ValueError: a degree below 1, or more monomials than there is memory for.

    Example:
        >>> static = lfrtorch.Polynomial(nz=2, nw=1, degree=3)
        >>> static.C.shape  # 1, z1, z2, z1², z1 z2, z2², z1³, ...
        torch.Size([1, 10])
    """

    def __init__(
        self,
        nz: int,
        nw: int,
        degree: int,
        *,
        device: torch.device | None = None,
        dtype: torch.dtype | None = None,
    ) -> None:
        super().__init__()
        for name, size in (("nz", nz), ("nw", nw), ("degree", degree)):
            integer(name, size, 1)
        check_memory(
            nw * math.comb(nz + degree, degree) * 1000,  # bytes of Python's lists, about
            f"a polynomial with nz={nz}, nw={nw} and degree={degree}",
            "give smaller ones",
        )
        self.nz, self.degree = nz, degree
        monomials = [
            factors  # numbers of the z in the product
            for total in range(degree + 1)
            for factors in combinations_with_replacement(range(nz), total)
        ]
        number = {factors: n for n, factors in enumerate(monomials)}
        self.growth = [(number[factors[:-1]], factors[-1]) for factors in monomials[1:]]
        """A pair (m, j) for each monomial but the constant, which is monomial m times z_j."""
        self.slopes: list[tuple[int, int, int, int]] = []
        """Entries (n, j, e, m). The derivative of monomial n by z_j is e times monomial m. It is 0
        without an entry."""
        for n, factors in enumerate(monomials):
            for j in sorted(set(factors)):
                i = factors.index(j)
                self.slopes.append((n, j, factors.count(j), number[factors[:i] + factors[i + 1 :]]))
        self.C = Parameter(torch.empty(nw, len(monomials), device=device, dtype=dtype))
        self.reset_parameters()

    def reset_parameters(self, generator: torch.Generator | None = None) -> None:
        """C ~ U(-1, 1) / monomials, so that |w| <= 1 if all |z| <= 1, and the constant is 0."""
        with torch.no_grad():
            self.C.uniform_(-1.0, 1.0, generator=generator).div_(self.C.shape[-1])
            self.C[:, 0] = 0.0

    def weight_shapes(self, nz: int, nw: int) -> dict[str, tuple[int, ...]]:
        """Shapes of the weights of a map from nz to nw signals of this degree."""
        return {"C": (nw, math.comb(nz + self.degree, self.degree))}

    def forward(self, z: Float[Tensor, "*axes nz"]) -> Float[Tensor, "*axes nw"]:
        """w of z."""
        return self.monomials(z) @ self.C.mT

    @property
    def sizes(self) -> dict[str, int]:
        """The degree."""
        return {"degree": self.degree}

    @property
    def kernel(self) -> Kernel:
        """The map for compiled code."""
        zeros, nw = self.C.new_zeros, self.C.shape[-2]
        return Kernel(zeros(0, 0), self.C, zeros(0), zeros(nw), growth=np.array(self.growth))

    def of_symbols(self, z: Sequence[Symbol]) -> list[Any]:
        """w of z for a table of operations."""
        m: list[Any] = [z[0].constant(1.0)]
        for before, j in self.growth:
            m.append(m[before] * z[j] if before else z[j])
        return [_combined(row, m) for row in self.C.detach().double().cpu().tolist()]

    def linearised(self, z: Float[Tensor, "R T nz"], weights: Weights) -> StaticJacobian:
        """The map linearised at z, with the given weights."""
        return PolynomialJacobian(self.monomials(z), weights["C"], self.slopes, self.nz)

    def monomials(self, z: Float[Tensor, "*axes nz"]) -> Float[Tensor, "*axes monomials"]:
        """m(z)."""
        each = z.unbind(-1)
        m = [torch.ones_like(each[0])]
        for before, j in self.growth:
            m.append(m[before] * each[j])
        return torch.stack(m, dim=-1)

    def extra_repr(self) -> str:
        """Sizes, for ``print(module)``."""
        return f"nz={self.nz}, nw={len(self.C)}, degree={self.degree}"


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


def known(static: Module | None) -> Network | Polynomial | None:
    """The map, if its equations are known: a subclass may have another forward pass."""
    return static if isinstance(static, Network | Polynomial) and type(static) in KNOWN else None


KNOWN = (Network, Polynomial)
"""Maps that have ``sizes``, ``kernel`` and ``linearised``."""


def is_network(static: Module | None) -> TypeGuard[Network]:
    """Whether a map is a ``Network`` itself: some features are for neurons alone."""
    return type(static) is Network


def of_static(weights: dict[str, Tensor]) -> dict[str, Tensor]:
    """The weights of the static nonlinearity among those of the cell, by their own names."""
    prefix = "static."
    return {name.removeprefix(prefix): p for name, p in weights.items() if name.startswith(prefix)}


def linearise_static(
    static: Module | None, z: Float[Tensor, "R T nz"], weights: Weights
) -> StaticJacobian:
    """A map linearised at z, with the given weights instead of its own."""
    if isinstance(static, DirectSum):
        each = z.split([nz for nz, _ in static.sizes_of_parts], dim=-1)
        of_parts = [static.of_part(number, weights) for number in range(len(each))]
        triples = zip(static.parts, each, of_parts, strict=True)
        found = [linearise_static(part, own, weights) for part, own, weights in triples]
        return DirectSumJacobian(found, [sum(w.numel() for w in ws.values()) for ws in of_parts])
    if isinstance(static, KnownMap):
        return static.linearised(z, weights)
    found = known(static)
    return ModuleJacobian(static, z, weights) if found is None else found.linearised(z, weights)


def networks_of(static: Module | None) -> list[tuple[str, Network, int, int]]:
    """The networks in a map: prefix of their weights, network, and its first z and first w."""
    if is_network(static):
        return [("static.", static, 0, 0)]
    found, z, w = [], 0, 0
    if isinstance(static, DirectSum):
        for number, (part, (nz, nw)) in enumerate(
            zip(static.parts, static.sizes_of_parts, strict=True)
        ):
            if is_network(part):
                found.append((f"static.parts.{number}.", part, z, w))
            z, w = z + nz, w + nw
    return found


def known_parts(static: Module | None) -> tuple[KnownMap, Network | Polynomial | None] | None:
    """A known model and what is learned beside it, if the map is these."""
    if isinstance(static, KnownMap):
        return static, None
    if isinstance(static, DirectSum) and len(static.parts) == 2:
        first, second = static.parts
        learned = known(second)
        if isinstance(first, KnownMap) and learned is not None:
            return first, learned
    return None


def formula_of(static: Module) -> Formula:
    """z -> w of a known model and what is learned beside it, as one table of operations."""
    if not isinstance(static, DirectSum):
        return Formula.traced(lambda *z: cast(KnownMap, static).of_symbols(z), cast(Any, static).nz)

    def written(*z: Symbol) -> list[Any]:
        w, first = [], 0
        for part, (size, _) in zip(static.parts, static.sizes_of_parts, strict=True):
            w += cast(KnownMap | Network | Polynomial, part).of_symbols(z[first : first + size])
            first += size
        return w

    return Formula.traced(written, sum(size for size, _ in static.sizes_of_parts))


def _combined(weights: list[float], signals: Sequence[Any], constant: float = 0.0) -> Any:
    """A sum of weighted symbols and a constant."""
    total = signals[0].constant(constant)
    for weight, signal in zip(weights, signals, strict=True):
        total = total + weight * signal
    return total
