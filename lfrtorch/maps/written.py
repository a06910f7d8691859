"""Static map for exports, as arrays and loops or as a table of operations."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol

from torch import Tensor

from lfrtorch.maps.operations import Formula


class Vectors(Protocol):
    """Vector operations of an export language, which refers to arrays of the map by name."""

    def affine(self, W: str, v: Any, b: str = "") -> Any:
        """Affine map W v + b."""
        ...

    def each(self, sigma: Formula, v: Any) -> Any:
        """Apply a scalar function to every entry of v."""
        ...

    def table(self, formula: Formula, v: Any) -> Any:
        """Apply a table of operations to the entries of v."""
        ...


class Written(NamedTuple):
    """Parts of a map from which every export is made.

    Args:
        template: name of the templates of the map in ``export/templates/maps``, for C, Python and
            MATLAB. The templates use attributes of the map.
        arrays: arrays that the templates use, by name, for a map of arrays and loops.
        of: function (language, z) -> w, for exports that use expressions instead of templates.
        formula: table of operations, for a map that has nothing else.
    """

    template: str
    arrays: Mapping[str, Tensor]
    of: Callable[[Vectors, Any], Any]
    formula: Formula | None = None
