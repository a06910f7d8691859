"""Paths given by a user."""

from __future__ import annotations

import os
from pathlib import Path

from lfrtorch._support.errors import InputError, brief


def expanded(path: str | Path) -> Path:
    """Expand ``~`` in a path; refuse a path that no file can have: too long, or an unknown user."""
    try:
        found = Path(path).expanduser()
        found.is_file()  # raises an error if no file can have that name
        if "\0" in str(found):  # pathlib has no error for it
            raise ValueError("it has a zero byte")
    except (OSError, RuntimeError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{brief(repr(str(path)))} is not a path ({reason}); mend it.") from None
    return found


def real(path: str | Path) -> Path:
    """Resolve links as far as the path exists; loops of links stay."""
    return Path(os.path.realpath(path))
