"""Packages that extras install and that lfrtorch does without."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from lfrtorch._support.errors import InputError


def imported(package: str, extra: str, otherwise: str = "") -> Any:
    """Import a package, or name the extra that installs it, and what to do otherwise."""
    try:
        return import_module(package)
    except ImportError:
        raise InputError(
            f"the package {package} is not installed: pip install 'lfrtorch[{extra}]'{otherwise}."
        ) from None
