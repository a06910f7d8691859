"""Polynomial as a static map: all monomials up to a total degree."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations_with_replacement
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numba.np.numpy_support import carray
from torch import Tensor
from torch.nn import Parameter

from lfrtorch._support.checks import integer
from lfrtorch._support.memory import check_memory
from lfrtorch.maps.activation_kernel import dot
from lfrtorch.maps.machine_code import SLOPE, Code, address
from lfrtorch.maps.mean_slopes import Quadrature
from lfrtorch.maps.operations import Formula
from lfrtorch.maps.static_map import StaticMap, combined
from lfrtorch.maps.written import Written


class Polynomial(StaticMap):
    """Polynomial of a total degree: w = C m(z), m(z) = (1, z1, z2, .., z1², z1 z2, ..).

    After an affine change of the coordinates of z or w the map is again a polynomial of this
    degree; only C changes.

    Args:
        nz: number of inputs.
        nw: number of outputs.
        degree: highest total degree.
        device, dtype: device and dtype of the weights, as in any torch module.

    Shape:
        C: (nw, monomials). The (nz + degree)! / (nz! degree!) monomials are sorted by rising
        degree; column 0 is the constant.

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
        for name, size in (("nz", nz), ("nw", nw), ("degree", degree)):
            integer(name, size, 1)
        check_memory(
            nw * math.comb(nz + degree, degree) * 1000,  # approximate bytes of Python's lists
            f"a polynomial with nz={nz}, nw={nw} and degree={degree}",
            "give smaller ones",
        )
        super().__init__(nz, nw)
        self.degree = degree
        monomials = [
            factors  # indices of the z in the product
            for total in range(degree + 1)
            for factors in combinations_with_replacement(range(nz), total)
        ]
        number = {factors: n for n, factors in enumerate(monomials)}
        self.growth = [(number[factors[:-1]], factors[-1]) for factors in monomials[1:]]
        """Pairs (m, j), one for each monomial but the constant; it is monomial m times z_j."""
        self.C = Parameter(torch.empty(nw, len(monomials), device=device, dtype=dtype))
        self.reset_parameters()

    def reset_parameters(self, generator: torch.Generator | None = None) -> None:
        """Draw C ~ U(-1, 1) / monomials, so that |w| <= 1 if all |z| <= 1; the constant is 0."""
        with torch.no_grad():
            self.C.uniform_(-1.0, 1.0, generator=generator).div_(self.C.shape[-1])
            self.C[:, 0] = 0.0

    def weight_shapes(self, nz: int, nw: int) -> dict[str, tuple[int, ...]]:
        """Shapes of the weights of a map from nz to nw signals of this degree."""
        return {"C": (nw, math.comb(nz + self.degree, self.degree))}

    def forward(self, z: Float[Tensor, "*axes nz"]) -> Float[Tensor, "*axes nw"]:
        """Output w of z."""
        return self.monomials(z) @ self.C.mT

    @property
    def sizes(self) -> dict[str, int]:
        """Degree of the polynomial."""
        return {"degree": self.degree}

    def describe(self) -> dict[str, Any]:
        """The degree."""
        return {"type": "Polynomial", **self.sizes}

    def zero_output(self) -> None:
        """Set C = 0."""
        with torch.no_grad():
            self.C.zero_()

    def redundant(self, fed: int, ny: int | None = None) -> int:
        """Number of parameters without effect: coordinates of z and w, unused z, affine w."""
        nz = min(self.nz, fed)
        gone = self.C.shape[-1] - math.comb(nz + self.degree, nz)
        affine = 0 if ny is None else self.nw * nz + max(0, self.nw - ny)
        return self.nz * nz + self.nw * gone + self.nw**2 + affine

    def equations(self, z: Sequence[Any], phi: Sequence[Any]) -> Sequence[Any]:
        """Output w from z and φ, which are sequences of numbers."""
        m = self._products(z)
        rows = [phi[q * len(m) : (q + 1) * len(m)] for q in range(self.nw)]
        return [combined(row[1:], m[1:], row[0]) for row in rows]

    def _products(self, z: Sequence[Any]) -> list[Any]:
        """Monomials m(z) from a sequence of numbers z."""
        m: list[Any] = [1.0]
        for before, j in self.growth:
            m.append(m[before] * z[j] if before else z[j])
        return m

    @property
    def meaning(self) -> str:
        """Equation of f(z)."""
        return "C m, m = 1, z1, z2, .., z1 z1, z1 z2, .."

    @property
    def written(self) -> Written:
        """Write C times the monomials; each monomial is an earlier monomial times a z."""
        monomials = Formula.traced(lambda *z: self._products(z), self.nz)
        arrays = {"C": self.C, "growth": torch.tensor(self.growth)}
        return Written("polynomial", arrays, lambda a, z: a.affine("C", a.table(monomials, z)))

    @property
    def quadrature(self) -> Quadrature:
        """An exact rule, as the slope at z0 + t ζ is a polynomial in t."""
        return Quadrature.gauss_legendre((self.degree + 1) // 2, exact=True)

    @property
    def code(self) -> Code:
        """The map in machine code."""
        count = self.C.shape[-1]
        ints = np.array([self.nz, self.nw, count, *np.ravel(self.growth)])
        room = count * (1 + self.nz)
        return Code(0, address(_value), address(_slope, SLOPE), ints, np.zeros(0), room)

    def monomials(self, z: Float[Tensor, "*axes nz"]) -> Float[Tensor, "*axes monomials"]:
        """Monomials m(z)."""
        each = z.unbind(-1)
        m = [torch.ones_like(each[0])]
        for before, j in self.growth:
            m.append(m[before] * each[j])
        return torch.stack(m, dim=-1)

    def extra_repr(self) -> str:
        """Sizes, for ``print(module)``."""
        return f"nz={self.nz}, nw={len(self.C)}, degree={self.degree}"


def _value(ints, constants, weights, z, w, room):
    nw, count = ints[1], ints[2]
    m = carray(room, (count,))
    m[0] = 1.0
    for n in range(1, count):
        m[n] = m[ints[1 + 2 * n]] * z[ints[2 + 2 * n]]
    for q in range(nw):
        w[q] = dot(weights, q * count, room, 0, count)


def _slope(ints, constants, weights, z, J, by_weight, stride, room):
    nz, nw, count = ints[0], ints[1], ints[2]
    all_m = carray(room, (1 + nz, count))
    m, dm = all_m[0], all_m[1:]
    m[0] = 1.0
    for j in range(nz):
        dm[j, 0] = 0.0
    for n in range(1, count):
        before, factor = ints[1 + 2 * n], ints[2 + 2 * n]
        m[n] = m[before] * z[factor]
        for j in range(nz):
            dm[j, n] = dm[j, before] * z[factor]
        dm[factor, n] += m[before]
    P = nw * count
    for q in range(nw):
        for j in range(nz):
            a = 0.0
            for n in range(count):
                a += weights[q * count + n] * dm[j, n]
            J[q * nz + j] = a
        if stride == 0:
            continue
        for n in range(P):
            by_weight[q * stride + n] = 0.0
        for n in range(count):
            by_weight[q * stride + q * count + n] = m[n]
