"""A static map that is several beside each other: each has inputs and outputs of its own."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from itertools import accumulate

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import Module, ModuleList

from lfrtorch.engine.static_jacobian import StaticJacobian, Weights


class DirectSum(Module):
    """w = [f1(z1); f2(z2); ...] of z = [z1; z2; ...].

    Args:
        parts: f1, f2, ...
        sizes: inputs and outputs of each.

    Shape:
        z: (..., sum of inputs), w: (..., sum of outputs).
    """

    def __init__(self, parts: Sequence[Module], sizes: Sequence[tuple[int, int]]) -> None:
        super().__init__()
        self.parts, self.sizes_of_parts = ModuleList(parts), list(sizes)

    def weight_shapes(self, nz: int, nw: int) -> dict[str, tuple[int, ...]]:
        """Shapes of the weights of all parts that tell them."""
        found: dict[str, tuple[int, ...]] = {}
        for number, (part, size) in enumerate(zip(self.parts, self.sizes_of_parts, strict=True)):
            of_part = getattr(part, "weight_shapes", None)
            own = {} if of_part is None else of_part(*size)
            found |= {f"parts.{number}.{name}": shape for name, shape in own.items()}
        return found

    def forward(self, z: Float[Tensor, "*axes nz"]) -> Float[Tensor, "*axes nw"]:
        """w of z."""
        each = z.split([nz for nz, _ in self.sizes_of_parts], dim=-1)
        return torch.cat([part(own) for part, own in zip(self.parts, each, strict=True)], dim=-1)

    def of_part(self, number: int, weights: Weights) -> Weights:
        """The weights of a part among those of all, by their own names."""
        prefix = f"parts.{number}."
        found = {n.removeprefix(prefix): w for n, w in weights.items() if n.startswith(prefix)}
        return found


class DirectSumJacobian:
    """The Jacobians of the parts, in the blocks of the diagonal."""

    def __init__(self, parts: Sequence[StaticJacobian], weights: Sequence[int]) -> None:
        self._parts, self._weights = list(parts), list(weights)
        shapes = [part.J.shape[2:] for part in self._parts]
        self._nw = [nw for nw, _ in shapes]
        first = self._parts[0].J
        self.J = first.new_zeros(*first.shape[:2], sum(self._nw), sum(nz for _, nz in shapes))
        row = column = 0
        for part, (nw, nz) in zip(self._parts, shapes, strict=True):
            self.J[..., row : row + nw, column : column + nz] = part.J
            row, column = row + nw, column + nz

    def part(self, records: slice, time: slice) -> StaticJacobian:
        """The same for some of the records and samples."""
        part = copy.copy(self)
        part._parts = [each.part(records, time) for each in self._parts]
        part.J = self.J[records, time]
        return part

    def by_weight(self) -> Float[Tensor, "R T nw weights"]:
        """∂w/∂φ."""
        found = self.J.new_zeros(*self.J.shape[:3], sum(self._weights))
        rows, columns = (accumulate([0, *sizes]) for sizes in (self._nw, self._weights))
        for part, row, column in zip(self._parts, rows, columns, strict=False):
            own = part.by_weight()
            found[..., row : row + own.shape[2], column : column + own.shape[3]] = own
        return found

    def tangent(self, d_weights: Float[Tensor, " weights"]) -> Float[Tensor, "R T nw"]:
        """(∂w/∂φ) dφ."""
        each = d_weights.split(self._weights, dim=-1)
        pairs = zip(self._parts, each, strict=True)
        return torch.cat([part.tangent(own) for part, own in pairs], dim=-1)

    def adjoint(self, d_w: Float[Tensor, "R T nw"]) -> Float[Tensor, "R weights"]:
        """Σ_k (∂w/∂φ)ᵀ d_w(k)."""
        pairs = zip(self._parts, d_w.split(self._nw, dim=-1), strict=True)
        return torch.cat([part.adjoint(own) for part, own in pairs], dim=-1)
