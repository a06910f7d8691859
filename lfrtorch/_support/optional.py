"""Packages that extras install and that lfrtorch does without."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from lfrtorch._support.errors import InputError


def imported(package: str, extra: str) -> Any:
    """A package, or a ValueError that names the extra which installs it."""
    try:
        return import_module(package)
    except ImportError:
        raise InputError(
            f"the package {package} is not installed: pip install 'lfrtorch[{extra}]'."
        ) from None
