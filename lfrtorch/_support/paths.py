"""Paths that a user gave."""

from __future__ import annotations

import os
from pathlib import Path

from lfrtorch._support.errors import InputError, brief


def expanded(path: str | Path) -> Path:
    """Expand ``~`` in a path; refuse one that no file can have, too long or of an unknown user."""
    try:
        found = Path(path).expanduser()
        found.is_file()  # an error, unless there may be such a file
        if "\0" in str(found):  # which is none to pathlib
            raise ValueError("it has a zero byte")
    except (OSError, RuntimeError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{brief(repr(str(path)))} is no path ({reason}); correct it.") from None
    return found


def real(path: str | Path) -> Path:
    """Return the path without links, as far as it is there; loops of links stay."""
    return Path(os.path.realpath(path))
