"""Vector of all numbers of a model, and the position of each matrix and weight in it.

Simulations and derivatives are functions of these numbers. Compiled loops use the vector itself;
torch uses matrices, which are views of it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from lfrtorch._support.threads import has_kernels, to_float64
from lfrtorch._support.types import Array, Integers
from lfrtorch.maps.static_map import StaticMap

MATRICES = {
    "A": ("x", "x"), "Bu": ("x", "u"), "Bw": ("x", "w"), "Cz": ("z", "x"), "Dzu": ("z", "u"),
    "Cy": ("y", "x"), "Dyu": ("y", "u"), "Dyw": ("y", "w"),
}  # fmt: skip
"""Matrices in their order, each with the signal it adds to and the signal it multiplies."""


Held = Mapping[str, tuple[Tensor, Tensor]]
"""Entries that a fit holds: masks and values by parameter, which broadcast to its shape."""


class DirectTerms(NamedTuple):
    """Direct terms of some columns of derivatives.

    A triple (column, row, regressor) in ``x``, ``z`` or ``y``: the column's parameter multiplies
    ``v[regressor]``, v = [x; u; w], in that row of the equation. Columns of the static map come
    after these; ``static`` has their positions among all weights of the map.
    """

    x: Int[Integers, "n_x 3"]
    z: Int[Integers, "n_z 3"]
    y: Int[Integers, "n_y 3"]
    static: Int[Integers, " n_static"]


_NOTHING = np.zeros((0, 3), np.int64)
_NO_TERMS = DirectTerms(_NOTHING, _NOTHING, _NOTHING, np.zeros(0, np.int64))


@lru_cache(maxsize=64)
def _places(
    sizes: tuple[int, int, int, int, int],
) -> tuple[dict[str, tuple[slice, tuple[int, int]]], int]:
    """Positions of the matrices of a model of these sizes, and their total length."""
    size, found, at = dict(zip("xuyzw", sizes, strict=True)), {}, 0
    for name, (left, right) in MATRICES.items():
        shape = size[left], size[right]
        found[name], at = (slice(at, at + shape[0] * shape[1]), shape), at + shape[0] * shape[1]
    return found, at


class Layout:
    """The order of a model's numbers: eight matrices, then the weights φ of the static map.

    Args:
        nx, nu, ny, nz, nw: sizes.
        static: the map.
        parameters: names, sizes and masks of free entries, in the order of the vector.
        state_covariance: E x xᵀ over the training data, (nx, nx); the identity before a fit.
    """

    def __init__(
        self,
        sizes: tuple[int, int, int, int, int],
        static: StaticMap,
        parameters: Sequence[tuple[str, int, bool]],
        state_covariance: Tensor,
    ) -> None:
        self.state_covariance = state_covariance
        self.sizes, self.static = sizes, static
        self.code = static.code if has_kernels(state_covariance) else None
        self.compiled = self.code is not None
        """Whether machine code simulates the model on its device."""
        self._parameters = parameters
        self.places, end = _places(sizes)
        """Position and shape of each matrix."""
        self.phi = slice(end, None)
        self._terms: dict[bytes, DirectTerms] = {}

    # The following is for derivatives alone; a simulation does not need it.

    @cached_property
    def spans(self) -> dict[str, slice]:
        """Position of each parameter."""
        found, at = {}, 0
        for name, count, _ in self._parameters:
            found[name], at = slice(at, at + count), at + count
        return found

    @cached_property
    def free(self) -> Integers:
        """Positions of the free numbers, which are θ."""
        each = [np.full(count, is_free) for _, count, is_free in self._parameters]
        return np.flatnonzero(np.concatenate(each))

    @cached_property
    def table(self) -> Integers:
        """Equation and row of each number, and the signal in v that it multiplies.

        The equations of x, z and y are 0, 1 and 2, and v = [x; u; w]. Weights of the map have
        equation 3 and their position in φ.
        """
        nx, nu = self.sizes[:2]
        first_in_v, tables = {"x": 0, "u": nx, "w": nx + nu}, []
        for name, (left, right) in MATRICES.items():
            rows, columns = np.indices(self.places[name][1]).reshape(2, -1)
            equation = np.full_like(rows, "xzy".index(left))
            tables.append(np.stack([equation, rows, first_in_v[right] + columns]))
        count = sum(count for _, count, _ in self._parameters) - self.phi.start
        positions = np.arange(count)
        tables.append(np.stack([np.full_like(positions, 3), positions, positions]))
        return np.concatenate(tables, axis=1)

    def direct_terms(self, positions: Integers) -> DirectTerms:
        """The direct terms of columns for numbers at these positions, ascending."""
        if not len(positions):
            return _NO_TERMS
        key = positions.tobytes()
        if key not in self._terms:
            equation, row, _ = table = self.table[:, positions]
            entries = np.stack([np.arange(len(row)), *table[1:]], axis=1)
            x, z, y = (entries[equation == e] for e in range(3))
            self._terms[key] = DirectTerms(x, z, y, row[equation == 3])
        return self._terms[key]

    def place(self, name: str) -> slice:
        """Position of a parameter; weights of the map go by their own names."""
        return self.spans[name] if name in MATRICES else self.spans[f"static.{name}"]


class Weights:
    """Numbers of a model, as simulations and derivatives take them.

    ``A``, ``Bu``, ... and ``phi`` are views of ``flat``.
    """

    def __init__(self, layout: Layout, flat: Float[Tensor, " P"]) -> None:
        self.layout, self.flat = layout, flat
        self.nx, self.nu, self.ny, self.nz, self.nw = layout.sizes
        self.map = layout.static

    def weights(self) -> Weights:
        """Weights: this object, as a cell has its own."""
        return self

    def __getattr__(self, name: str) -> Tensor:
        if name == "phi":
            return self.flat[self.layout.phi]
        if name not in MATRICES:
            raise AttributeError(name)
        place, shape = self.layout.places[name]
        return self.flat[place].view(shape)

    @property
    def state_covariance(self) -> Float[Tensor, "nx nx"]:
        """Second moment E x xᵀ over the training data; the identity before a fit."""
        return self.layout.state_covariance

    @property
    def arguments(self) -> tuple[Any, Array, Any]:
        """Sizes, numbers and code of the map, as compiled loops take them."""
        layout, flat = self.layout, self.flat
        assert layout.code is not None
        numbers = flat.numpy() if flat.dtype == torch.float64 else to_float64(flat)
        return layout.sizes, numbers, layout.code.arguments

    def internal(
        self, u: Float[Tensor, "*axes nu"], x: Float[Tensor, "*axes nx"]
    ) -> tuple[Float[Tensor, "*axes nz"], Float[Tensor, "*axes nw"]]:
        """Input z and output w of the static map."""
        z = x @ self.Cz.mT + u @ self.Dzu.mT
        return z, self.map.of_weights(z, self.phi)

    def step(
        self, u: Float[Tensor, "*axes nu"], x: Float[Tensor, "*axes nx"]
    ) -> Float[Tensor, "*axes nx"]:
        """The next state."""
        _, w = self.internal(u, x)
        return x @ self.A.mT + u @ self.Bu.mT + w @ self.Bw.mT
