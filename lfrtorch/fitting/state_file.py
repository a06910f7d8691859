"""A search on disk: its numbers as JSON and its tensors in one safetensors file, no pickle.

It is no checkpoint, which people keep: a fit replaces this file every few seconds, and only the
same fit reads it again.
"""

from __future__ import annotations

import json
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, TypeVar

from torch import Tensor

from lfrtorch._support.atomic import whole_file
from lfrtorch._support.checkpoint import read_tensors, write_tensors
from lfrtorch._support.errors import InputError, brief

State = TypeVar("State")
Tensors = dict[str, Tensor]
Numbers = dict[str, Any]

_FORMAT = "lfrtorch snapshot 3"


def write(path: Path, numbers: Numbers, tensors: Tensors) -> None:
    """Replace the file at once."""
    with whole_file(path) as fresh:
        write_tensors(fresh, tensors, format=_FORMAT, numbers=json.dumps(numbers))


def read(path: Path) -> tuple[Numbers, Tensors]:
    """Return numbers and tensors of a file."""
    try:
        tensors, about = read_tensors(path)
    except OSError as error:
        raise InputError(
            f"'{path}', where a fit stood, is damaged ({brief(error)}); start from the "
            "best model of the run instead: init_from=DIR."
        ) from None
    if about.get("format") != _FORMAT:
        raise InputError(
            f"'{path}' was written by another version ({about.get('format')}); start from the best "
            "model of the run instead: init_from=DIR."
        )
    return json.loads(about["numbers"]), tensors


def packed(state: Any) -> tuple[Numbers, Tensors]:
    """Return numbers and texts of a dataclass, and tensors as state.name or state.name.key."""
    numbers: Numbers = {}
    tensors: Tensors = {}
    for field in fields(state):
        value = getattr(state, field.name)
        if isinstance(value, Tensor | dict | tuple):
            tensors |= leaves(value, f"state.{field.name}")
        else:
            numbers[field.name] = value
    return numbers, tensors


def leaves(value: Any, name: str) -> Tensors:
    """Return the tensors in dictionaries and tuples, by name and key or place."""
    if isinstance(value, Tensor):
        return {name: value}
    keyed = value.items() if isinstance(value, dict) else enumerate(value)
    return {n: t for key, part in keyed for n, t in leaves(part, f"{name}.{key}").items()}


def refilled(like: Any, name: str, tensors: Tensors) -> Any:
    """Return what ``leaves`` took apart; tuples are as many and of the kinds that ``like`` has."""
    if isinstance(like, Tensor):
        return tensors[name]
    if isinstance(like, dict):
        return within(f"{name}.", tensors)
    parts = [refilled(part, f"{name}.{i}", tensors) for i, part in enumerate(like)]
    return type(like)(*parts) if hasattr(like, "_fields") else tuple(parts)


def unpacked(like: State, numbers: Numbers, tensors: Tensors) -> State:
    """Return a dataclass like the given one with the fields that were packed."""
    values: Numbers = dict(numbers)
    for field in fields(like):  # pyright: ignore[reportArgumentType]
        value = getattr(like, field.name)
        if isinstance(value, Tensor | dict | tuple):
            values[field.name] = refilled(value, f"state.{field.name}", tensors)
    return replace(like, **values)  # pyright: ignore[reportArgumentType]


def within(prefix: str, tensors: Tensors) -> Tensors:
    """Return the tensors whose names begin with a prefix, under the rest of their names."""
    found = (name for name in tensors if name.startswith(prefix))
    return {name.removeprefix(prefix): tensors[name] for name in found}
