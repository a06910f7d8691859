"""A search on disk: its numbers as JSON and its tensors in one safetensors file, no pickle.

It is no checkpoint, which people keep: a fit replaces this file every few seconds, and only the
same fit reads it again.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from torch import Tensor

from lfrtorch._support.atomic import whole_file
from lfrtorch._support.checkpoint import read_tensors, write_tensors
from lfrtorch._support.errors import InputError, brief

State = TypeVar("State")
Tensors = dict[str, Tensor]
Numbers = dict[str, Any]

_FORMAT = "lfrtorch snapshot 2"


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
    for name, value in vars(state).items():
        if isinstance(value, Tensor):
            tensors[f"state.{name}"] = value
        elif isinstance(value, dict):
            tensors |= {f"state.{name}.{key}": tensor for key, tensor in value.items()}
        else:
            numbers[name] = value
    return numbers, tensors


def unpacked(like: State, numbers: Numbers, tensors: Tensors) -> State:
    """Return a dataclass like the given one with the fields that were packed."""
    values: Numbers = dict(numbers)
    for name, tensor in within("state.", tensors).items():
        field, _, key = name.partition(".")
        if key:
            values.setdefault(field, {})[key] = tensor
        else:
            values[field] = tensor
    return replace(like, **values)  # pyright: ignore[reportArgumentType]


def within(prefix: str, tensors: Tensors) -> Tensors:
    """Return the tensors whose names begin with a prefix, under the rest of their names."""
    found = (name for name in tensors if name.startswith(prefix))
    return {name.removeprefix(prefix): tensors[name] for name in found}
