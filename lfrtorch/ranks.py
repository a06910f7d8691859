"""How processes share the records of one fit: sums over them, and the one process that is alone."""

from __future__ import annotations

from typing import TypeVar

from torch import Tensor

Shared = TypeVar("Shared")


class Ranks:
    """One process that holds all records. ``distributed`` has several."""

    rank, world = 0, 1

    def share(self, items: list[Shared]) -> list[Shared]:
        """The items that this process holds: every ``world``-th."""
        return items[self.rank :: self.world]

    def sum(self, part: Tensor) -> Tensor:
        """The sum of all processes' parts, on each of them."""
        return part

    def stack(self, part: Tensor) -> Tensor:
        """The rows of all processes' parts, which may differ in number, on each of them."""
        return part
