"""A file that is written whole or not at all."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from lfrtorch._support.errors import InputError


def refuse_existing(path: str | Path, option: str) -> None:
    """Refuse a path that exists with a ValueError that names the option to replace it."""
    if Path(path).exists():
        raise InputError(f"'{path}' exists; give another name, or {option} to replace it.")


@contextmanager
def whole_file(path: str | Path) -> Iterator[Path]:
    """A path beside ``path`` to write to, of the same extension; it takes the place of ``path``.

    If the block raises, nothing is left, and what was at ``path`` stays as it was.
    """
    path = Path(path).resolve()  # a link's target is replaced, not the link
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=f".{path.stem}-", suffix=path.suffix, dir=path.parent)
    os.close(handle)
    fresh = Path(name)
    try:
        yield fresh
        os.chmod(fresh, 0o666 & ~umask())  # a temporary file is its owner's alone
        os.replace(fresh, path)
    finally:
        fresh.unlink(missing_ok=True)


def umask() -> int:
    """The permissions that new files do not get."""
    mask = os.umask(0)
    os.umask(mask)
    return mask
