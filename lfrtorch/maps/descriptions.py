"""Static maps of checkpoints, made from the descriptions that ``StaticMap.describe`` returns."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from typing import Any

import torch
from torch.nn import Module

from lfrtorch.maps.direct_sum import DirectSum
from lfrtorch.maps.known_map import KnownEquations, KnownModel
from lfrtorch.maps.network import Network
from lfrtorch.maps.polynomial import Polynomial


def made(
    description: Any, nz: int, nw: int, dtype: torch.dtype, own: Module | None
) -> Module | None:
    """Map from a description, before its weights are loaded; ``own`` is the user's module."""
    maker = MAKERS.get(description["type"]) if description else None
    return own if maker is None else maker(description, nz, nw, dtype, own)


def foreign(description: Any) -> str | None:
    """Class of the user's map in a description; None if there is none."""
    match description:
        case {"type": "DirectSum", "parts": list(parts)}:
            return next((name for name in map(foreign, parts) if name), None)
        case dict() if description.get("type") not in [*MAKERS]:
            return str(description.get("class"))
    return None


def _sum(description: Any, nz: int, nw: int, dtype: torch.dtype, own: Module | None) -> DirectSum:
    sizes = description["sizes"]
    pairs = zip(description["parts"], sizes, strict=True)
    parts = [made(part, nz, nw, dtype, deepcopy(own)) for part, (nz, nw) in pairs]
    return DirectSum([part for part in parts if part is not None], sizes)


MAKERS: dict[str, Callable[[Any, int, int, torch.dtype, Module | None], Module]] = {
    "Network": lambda d, nz, nw, dtype, _: Network(nz, nw, d["nn"], d["activation"], dtype=dtype),
    "Polynomial": lambda d, nz, nw, dtype, _: Polynomial(nz, nw, d["degree"], dtype=dtype),
    "Known": lambda d, nz, nw, dtype, _: KnownModel(
        KnownEquations.of(d["equations"]), float(d["sample_time"]), dtype=dtype
    ),
    "DirectSum": _sum,
}
"""Constructors by type; any other map is the user's."""
