"""Atomic writes: a file or folder is written whole or not at all."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path

from lfrtorch._support.errors import InputError
from lfrtorch._support.paths import real

TEMPORARY = ".lfrtorch-"
"""Prefix of the names of unfinished files and folders."""


def refuse_existing(path: str | Path, option: str) -> None:
    """Refuse a path that exists; the message names the option to replace it."""
    if Path(path).exists():
        raise InputError(f"'{path}' exists; give another name, or {option} to replace it.")


@contextmanager
def whole_file(path: str | Path) -> Iterator[Path]:
    """Give a path beside ``path`` to write to; when the block ends, it takes the place of ``path``.

    If the block raises, nothing is left, and what was at ``path`` stays as it was.
    """
    path = real(path)  # a link's target is replaced, not the link
    with _writing_to(path.parent):
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=TEMPORARY, suffix=path.suffix, dir=path.parent)
        os.close(handle)
        fresh = Path(name)
        try:
            yield fresh
            _put(fresh, path)
        finally:
            fresh.unlink(missing_ok=True)


@contextmanager
def _writing_to(folder: Path) -> Iterator[None]:
    """Name the folder in errors of the operating system."""
    try:
        yield
    except OSError as error:
        named = folder if error.filename is None else real(os.fsdecode(error.filename))
        ours = folder == named or folder in named.parents or named in folder.parents
        if error.strerror is None or not ours:  # the error says more, or names another file
            raise
        raise OSError(f"'{folder}' cannot be written to: {error.strerror}") from error


@contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """Give a folder beside ``path`` to write files to; it becomes ``path``, new or empty."""
    with _writing_to(path.parent):
        path.parent.mkdir(parents=True, exist_ok=True)
        fresh = Path(tempfile.mkdtemp(prefix=TEMPORARY, dir=path.parent))
        try:
            yield fresh
            for file in fresh.iterdir():
                _flush(file)
            _put(fresh, path)
        finally:
            shutil.rmtree(fresh, ignore_errors=True)


def _put(fresh: Path, path: Path) -> None:
    """Move a finished file or folder to its place, flushed to the disk first: power may fail."""
    full = 0o777 if fresh.is_dir() else 0o666
    _flush(fresh)
    os.chmod(fresh, full & ~_umask())  # files of tempfile are readable by their owner alone
    os.replace(fresh, path)
    _flush(path.parent)


def _flush(path: Path) -> None:
    """Have the system write a file, or the names in a folder, to the disk."""
    with suppress(OSError) if path.is_dir() else nullcontext():  # some systems open no folder
        handle = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def remove_leftovers(folder: Path) -> None:
    """Remove unfinished files of a killed program, in a folder that no other program writes to."""
    for path in list(folder.glob(f"{TEMPORARY}*")):
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def _umask() -> int:
    """Return the umask: permissions that new files do not get."""
    mask = os.umask(0)
    os.umask(mask)
    return mask
