"""A search on disk: its numbers as JSON and its tensors in one safetensors file, no pickle.

It is no checkpoint, which is a folder that people read and keep: a fit replaces this file every few
seconds, whole or not at all, and only the same fit reads it again.
"""

from __future__ import annotations

import json
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor

from lfrtorch._support.atomic import whole_file
from lfrtorch._support.checkpoint import read_tensors, write_tensors
from lfrtorch._support.errors import InputError, brief

State = TypeVar("State")
Tensors = dict[str, Tensor]
Numbers = dict[str, Any]

FORMAT = "lfrtorch snapshot 2"


def write(path: Path, numbers: Numbers, tensors: Tensors) -> None:
    """Replace the file at once."""
    with whole_file(path) as fresh:
        write_tensors(fresh, tensors, format=FORMAT, numbers=json.dumps(numbers))


def read(path: Path) -> tuple[Numbers, Tensors]:
    """Numbers and tensors of a file."""
    try:
        tensors, about = read_tensors(path)
    except OSError as error:
        raise InputError(
            f"'{path}', where a fit stood, is damaged ({brief(error)}); start from the "
            "best model of the run instead: init_from=DIR."
        ) from None
    if about.get("format") != FORMAT:
        raise InputError(
            f"'{path}' was written by another version ({about.get('format')}); start from the best "
            "model of the run instead: init_from=DIR."
        )
    return json.loads(about["numbers"]), tensors


def packed(state: Any) -> tuple[Numbers, Tensors]:
    """The fields of a dataclass: numbers and texts, and tensors (those of dicts as name.key)."""
    numbers: Numbers = {}
    tensors: Tensors = {}
    for field in fields(state):
        value = getattr(state, field.name)
        if isinstance(value, Tensor):
            tensors[field.name] = value
        elif isinstance(value, dict):
            tensors |= {f"{field.name}.{key}": tensor for key, tensor in value.items()}
        else:
            numbers[field.name] = value
    return numbers, tensors


def unpacked(like: State, numbers: Numbers, tensors: Tensors) -> State:
    """A dataclass like the given one with the fields that were packed."""
    values: Numbers = dict(numbers)
    for name, tensor in tensors.items():
        field, _, key = name.partition(".")
        if key:
            values.setdefault(field, {})[key] = tensor
        else:
            values[field] = tensor
    return replace(like, **values)  # pyright: ignore[reportArgumentType]


def within(prefix: str, tensors: Tensors, device: torch.device | str = "cpu") -> Tensors:
    """The tensors whose names begin with ``prefix``, under the rest of their names."""
    return {
        name.removeprefix(prefix): tensor.to(device)
        for name, tensor in tensors.items()
        if name.startswith(prefix)
    }
