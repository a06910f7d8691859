"""The state of a fit on disk: numbers as JSON and tensors in one safetensors file, no pickle.

The file is not a checkpoint to keep: a fit replaces it every few seconds, and only the same fit
reads it again.
"""

from __future__ import annotations

import json
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

from torch import Tensor

from lfrtorch._support.atomic import whole_file
from lfrtorch._support.checkpoint import read_tensors, write_tensors
from lfrtorch._support.errors import InputError, brief

Tensors = dict[str, Tensor]
Numbers = dict[str, Any]

_FORMAT = "lfrtorch snapshot 4"


def write(path: Path, numbers: Numbers, tensors: Tensors) -> None:
    """Replace the file atomically."""
    with whole_file(path) as fresh:
        write_tensors(fresh, tensors, format=_FORMAT, numbers=json.dumps(numbers))


def read(path: Path) -> tuple[Numbers, Tensors]:
    """Return numbers and tensors of a file."""
    try:
        tensors, about = read_tensors(path)
    except OSError as error:
        raise InputError(
            f"'{path}', the state of a fit, is damaged ({brief(error)}); start from the "
            "best model of the run instead: init_from=DIR."
        ) from None
    if about.get("format") != _FORMAT:
        raise InputError(
            f"'{path}' was written by another version ({about.get('format')}); start from the best "
            "model of the run instead: init_from=DIR."
        )
    return json.loads(about["numbers"]), tensors


def packed(value: Any, name: str = "") -> tuple[Any, Tensors]:
    """Return a value as dictionaries, lists, numbers and texts, and its tensors by name.

    The value is made of dataclasses, tuples, dictionaries, numbers, texts and tensors. Tensors are
    None in the first result. Their names are the names of the fields that lead to them, with dots.
    """
    if isinstance(value, Tensor):
        return None, {name: value}
    if is_dataclass(value):
        items = [(field.name, getattr(value, field.name)) for field in fields(value)]
    elif isinstance(value, dict):
        items = list(value.items())
    elif isinstance(value, tuple):
        items = list(enumerate(value))
    else:
        return value, {}
    parts = {key: packed(part, _below(name, key)) for key, part in items}
    tensors = {n: tensor for _, own in parts.values() for n, tensor in own.items()}
    found = {key: part for key, (part, _) in parts.items()}
    return list(found.values()) if isinstance(value, tuple) else found, tensors


def unpacked(like: Any, value: Any, tensors: Tensors, name: str = "") -> Any:
    """Return what was packed, with the types of ``like``.

    In a tuple longer than that of ``like``, further items have the type of its last item.

    Raises:
        TypeError, KeyError: the packed value had other types.
    """
    if name in tensors:
        return tensors[name]

    def part(key: Any, kind: Any) -> Any:
        return unpacked(kind, value[key], tensors, _below(name, key))

    if is_dataclass(like):
        names = [field.name for field in fields(like)]
        return replace(like, **{n: part(n, getattr(like, n)) for n in names})  # pyright: ignore[reportArgumentType]
    if isinstance(like, dict):
        return {key: part(key, like.get(key)) for key in value}
    if isinstance(like, tuple):
        kinds = [like[min(i, len(like) - 1)] if like else None for i in range(len(value))]
        parts = [part(i, kind) for i, kind in enumerate(kinds)]
        return type(like)(*parts) if hasattr(like, "_fields") else tuple(parts)
    return value


def _below(name: str, key: object) -> str:
    return f"{name}.{key}" if name else str(key)
