"""Direct sum of static maps, each with its own inputs and outputs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from numba.np.numpy_support import carray
from torch import Tensor
from torch.nn import Module, ModuleList

from lfrtorch.maps.machine_code import (
    PREPARE,
    SLOPE,
    Code,
    address,
    call_prepare,
    call_slope,
    call_value,
)
from lfrtorch.maps.static_map import StaticMap, Symmetry, as_map


class DirectSum(StaticMap):
    """Direct sum w = [f1(z1); f2(z2); ...] of z = [z1; z2; ...].

    Args:
        parts: f1, f2, ...
        sizes: inputs and outputs of each.

    Shape:
        z: (..., sum of inputs), w: (..., sum of outputs).
    """

    def __init__(self, parts: Sequence[Module], sizes: Sequence[tuple[int, int]]) -> None:
        super().__init__(sum(nz for nz, _ in sizes), sum(nw for _, nw in sizes))
        self.parts, self.sizes_of_parts = ModuleList(parts), [(nz, nw) for nz, nw in sizes]

    @property
    def maps(self) -> list[StaticMap]:
        """The parts as static maps."""
        pairs = zip(self.parts, self.sizes_of_parts, strict=True)
        return [as_map(part, nz, nw) for part, (nz, nw) in pairs]

    def _placed(self) -> Iterator[tuple[StaticMap, slice, slice, slice]]:
        """Parts, each with the positions of its z, w and weights."""
        z = w = P = 0
        for part in self.maps:
            count = sum(p.numel() for p in part.parameters())
            yield part, slice(z, z + part.nz), slice(w, w + part.nw), slice(P, P + count)
            z, w, P = z + part.nz, w + part.nw, P + count

    def weight_shapes(self, nz: int, nw: int) -> dict[str, tuple[int, ...]]:
        """Shapes of the weights of all parts that know them."""
        found: dict[str, tuple[int, ...]] = {}
        for number, (part, size) in enumerate(zip(self.parts, self.sizes_of_parts, strict=True)):
            of_part = getattr(part, "weight_shapes", None)
            own = {} if of_part is None else of_part(*size)
            found |= {f"parts.{number}.{name}": shape for name, shape in own.items()}
        return found

    def forward(self, z: Float[Tensor, "*axes nz"]) -> Float[Tensor, "*axes nw"]:
        """Output w of z."""
        return torch.cat([part(z[..., own]) for part, own, _, _ in self._placed()], dim=-1)

    def equations(self, z: Sequence[Any], phi: Sequence[Any]) -> Sequence[Any]:
        """Output w from z and φ, which are sequences of numbers."""
        return [
            each for part, own, _, weights in self._placed()
            for each in part.equations(z[own], phi[weights])
        ]  # fmt: skip

    @property
    def meaning(self) -> str:
        """Meanings of the parts."""
        return f"[{'; '.join(part.meaning for part in self.maps)}]"

    @property
    def sizes(self) -> dict[str, int]:
        """Sizes of the last part, with the number of neurons of all parts."""
        neurons = sum(part.sizes.get("nn", 0) for part in self.maps)
        return {name: neurons if name == "nn" else n for name, n in self.maps[-1].sizes.items()}

    @property
    def known(self) -> Any:
        """Known model of the first part."""
        return self.maps[0].known

    @property
    def learned(self) -> StaticMap:
        """Part after the known model, or the whole map."""
        return self if self.known is None else self.maps[1]

    def describe(self) -> dict[str, Any]:
        """Describe the parts."""
        parts = [part.describe() for part in self.maps]
        return {"type": "DirectSum", "parts": parts, "sizes": self.sizes_of_parts}

    def zero_output(self) -> None:
        """Zero the output of each part."""
        for part in self.maps:
            part.zero_output()

    def redundant(self, fed: int, ny: int | None = None) -> int:
        """Sum over the parts."""
        return sum(part.redundant(fed, ny) for part in self.maps)

    @property
    def symmetries(self) -> list[Symmetry]:
        """Symmetries of the parts."""
        return [
            Symmetry(
                each.signal,
                slice(
                    (z if each.signal == "z" else w).start + each.place.start,
                    (z if each.signal == "z" else w).start + each.place.stop,
                ),
                _named(f"parts.{number}.", each.changes),
            )
            for number, (part, z, w, _) in enumerate(self._placed())
            for each in part.symmetries
        ]

    def across_branches(self) -> dict[str, Bool[Tensor, ...]]:
        """No entries, if each part is a branch with one z and one w."""
        return {} if set(self.sizes_of_parts) == {(1, 1)} else super().across_branches()

    @property
    def outputs_have_parameters(self) -> bool:
        """True if a part has an output equation with parameters of its own."""
        return any(part.outputs_have_parameters for part in self.maps)

    @property
    def weight_bounds(self) -> Float[Tensor, "P 2"]:
        """Least and largest value of each weight."""
        return torch.cat([part.weight_bounds for part in self.maps])

    def slope(
        self, z: Float[Tensor, "R T nz"], phi: Float[Tensor, " P"]
    ) -> Float[Tensor, "R T nw nz"]:
        """Slopes ∂w/∂z: the parts are blocks of the diagonal."""
        found = z.new_zeros(*z.shape[:-1], self.nw, self.nz)
        for part, own, w, weights in self._placed():
            found[..., w, own] = part.slope(z[..., own], phi[weights])
        return found

    def by_weight(
        self, z: Float[Tensor, "R T nz"], phi: Float[Tensor, " P"]
    ) -> Float[Tensor, "R T nw P"]:
        """Derivatives ∂w/∂φ: the parts are blocks of the diagonal."""
        found = z.new_zeros(*z.shape[:-1], self.nw, len(phi))
        for part, own, w, weights in self._placed():
            found[..., w, weights] = part.by_weight(z[..., own], phi[weights])
        return found

    @property
    def code(self) -> Code | None:
        """The map in machine code, if all parts have some."""
        codes = [part.code for part in self.maps]
        made = [code for code in codes if code is not None]
        if len(made) < len(codes):
            return None
        # The head of a part has its addresses, sizes and number of weights, and where its ints,
        # constants and room begin.
        heads, ints, constants = [], [], []
        first, place = 1 + 9 * len(made), 0
        room = max(part.nw * part.nz for part in self.maps)
        for code, (part, _, _, weights) in zip(made, self._placed(), strict=True):
            sizes = part.nz, part.nw, weights.stop - weights.start
            heads += [code.prepare, code.value, code.slope, *sizes, first, place, room]
            ints, constants = [*ints, code.ints], [*constants, code.constants]
            first, place = first + len(code.ints), place + len(code.constants)
            room += code.room
        numbers = np.concatenate([[len(made), *heads], *ints]).astype(np.int64)
        own = address(_prepare, PREPARE), address(_value), address(_slope, SLOPE)
        return Code(*own, numbers, np.concatenate(constants), room, made)


def _named(prefix: str, changes: Callable[..., dict[str, Tensor]]) -> Callable[..., Any]:
    """Changes of a part's weights, by their names in the sum."""

    def named(T: Tensor, weights: dict[str, Tensor]) -> dict[str, Tensor]:
        own = {n.removeprefix(prefix): w for n, w in weights.items() if n.startswith(prefix)}
        return {prefix + name: change for name, change in changes(T, own).items()}

    return named


# Arrays of unknown length get a length that suffices, as their end is never read.
_LONG = 1 << 30


def _prepare(ints, constants, weights, room):
    every, numbers = carray(ints, (_LONG,)), carray(constants, (_LONG,))
    phi, rooms, at_phi = carray(weights, (_LONG,)), carray(room, (_LONG,)), 0
    for part in range(ints[0]):
        head = 1 + 9 * part
        if ints[head]:
            call_prepare(
                ints[head], every[ints[head + 6] :], numbers[ints[head + 7] :], phi[at_phi:],
                rooms[ints[head + 8] :],
            )  # fmt: skip
        at_phi += ints[head + 5]


def _value(ints, constants, weights, z, w, room):
    every, numbers = carray(ints, (_LONG,)), carray(constants, (_LONG,))
    all_z, all_w = carray(z, (_LONG,)), carray(w, (_LONG,))
    phi, rooms = carray(weights, (_LONG,)), carray(room, (_LONG,))
    at_z = at_w = at_phi = 0
    for part in range(ints[0]):
        head = 1 + 9 * part
        call_value(
            ints[head + 1], every[ints[head + 6] :], numbers[ints[head + 7] :], phi[at_phi:],
            all_z[at_z:], all_w[at_w:], rooms[ints[head + 8] :],
        )  # fmt: skip
        at_z, at_w, at_phi = at_z + ints[head + 3], at_w + ints[head + 4], at_phi + ints[head + 5]


def _slope(ints, constants, weights, z, J, by_weight, stride, room):
    every, numbers = carray(ints, (_LONG,)), carray(constants, (_LONG,))
    all_z, phi, rooms = carray(z, (_LONG,)), carray(weights, (_LONG,)), carray(room, (_LONG,))
    all_by, nz, nw, P = carray(by_weight, (_LONG,)), 0, 0, 0
    for part in range(ints[0]):
        head = 1 + 9 * part
        nz, nw, P = nz + ints[head + 3], nw + ints[head + 4], P + ints[head + 5]
    for q in range(nw):
        for j in range(nz):
            J[q * nz + j] = 0.0
        for n in range(P if stride else 0):
            by_weight[q * stride + n] = 0.0
    at_z = at_w = at_phi = 0
    for part in range(ints[0]):
        head = 1 + 9 * part
        n, m = ints[head + 3], ints[head + 4]
        call_slope(
            ints[head + 2], every[ints[head + 6] :], numbers[ints[head + 7] :], phi[at_phi:],
            all_z[at_z:], rooms, all_by[at_w * stride + at_phi :], stride, rooms[ints[head + 8] :],
        )  # fmt: skip
        for i in range(m):
            for j in range(n):
                J[(at_w + i) * nz + at_z + j] = rooms[i * n + j]
        at_z, at_w, at_phi = at_z + n, at_w + m, at_phi + ints[head + 5]
