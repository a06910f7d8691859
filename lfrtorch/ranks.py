"""How processes share the records of one fit: sums over them, and the one process that is alone."""

from __future__ import annotations

from types import TracebackType
from typing import Self, TypeVar

from torch import Tensor

Shared = TypeVar("Shared")

LOST = "a process was lost"


class ProcessLost(RuntimeError):
    """Another process ended, or did not answer in time; the message begins with ``LOST``."""


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

    def first(self, part: Tensor) -> Tensor:
        """The part of the first process, whatever its shape, on each of them."""
        return part

    def close(self) -> None:
        """Leave the other processes: what they share from now on ends in a ``ProcessLost``."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()
