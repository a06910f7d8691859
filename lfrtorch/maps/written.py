"""A static map as exports write it: arrays and loops, or a table of operations."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol

from torch import Tensor

from lfrtorch.maps.operations import Formula


class Vectors(Protocol):
    """What a language of vectors computes; it knows the arrays of the map by their names."""

    def affine(self, W: str, v: Any, b: str = "") -> Any:
        """W v + b."""
        ...

    def each(self, sigma: Formula, v: Any) -> Any:
        """A function of one number, of every entry of v."""
        ...

    def table(self, formula: Formula, v: Any) -> Any:
        """A function of the entries of v."""
        ...


class Written(NamedTuple):
    """What every export of a map is made of.

    Args:
        template: which of the texts in ``export/templates/maps`` say the map in C, in Python and in
            MATLAB. They have the attributes of the map.
        arrays: the numbers of those texts by name, for a map of arrays and loops.
        of: a language and z -> w, where there are expressions instead of texts.
        formula: of a map that has nothing but its table of operations.
    """

    template: str
    arrays: Mapping[str, Tensor]
    of: Callable[[Vectors, Any], Any]
    formula: Formula | None = None
