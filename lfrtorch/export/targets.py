"""The exports by the names that the command line has for them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from lfrtorch._support.atomic import refuse_existing, whole_file
from lfrtorch._support.errors import InputError
from lfrtorch.export.c_source import c_source
from lfrtorch.export.equations import check_name
from lfrtorch.linear.model import LinearModel
from lfrtorch.model import Model


class Target(NamedTuple):
    """One kind of export.

    Args:
        extensions: of the files NAME.h, ..
        files: their contents.
        use: a line of a program that uses it, with {name} and the {path} of the first file.
    """

    extensions: tuple[str, ...]
    files: Callable[[Model | LinearModel, str], list[bytes]]
    use: str


def _c(model: Model | LinearModel, name: str) -> list[bytes]:
    return [text.encode() for text in c_source(model, name)]


TARGETS = {
    "c": Target(("h", "c"), _c, "{name}_step(x, u, x_next, y);"),
}
"""All kinds of export."""


def write(
    model: Model | LinearModel,
    to: str,
    folder: str | Path = ".",
    *,
    name: str = "model",
    overwrite: bool = False,
) -> list[Path]:
    """Write a model as files of another tool.

    Args:
        model: what is exported.
        to: ``"c"``: ``NAME.h`` and ``NAME.c``.
        folder: where to; it is made if need be.
        name: of the files, and in them.
        overwrite: whether files that exist may be replaced.

    Returns:
        The files.

    Raises:
        ValueError: an unknown target, a name that is no identifier, a file that exists, or a static
            map of the user's own class.

    Example:
        >>> [path.name for path in lfrtorch.export.write(model, "c", "made", name="actuator")]
        ['actuator.h', 'actuator.c']
    """
    if to not in TARGETS:
        raise InputError(f"to is {to!r}; give one of {', '.join(TARGETS)}.")
    check_name(name)
    target = TARGETS[to]
    paths = [Path(folder) / f"{name}.{extension}" for extension in target.extensions]
    if not overwrite:
        for path in paths:
            refuse_existing(path, "overwrite=True")
    for path, content in zip(paths, target.files(model, name), strict=True):
        with whole_file(path) as fresh:
            fresh.write_bytes(content)
    return paths
