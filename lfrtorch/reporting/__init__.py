"""Scores, figures, advice and the report of a run."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lfrtorch.reporting.console import Console
    from lfrtorch.reporting.run_files import write

__all__ = ["Console", "write"]

_MODULES = {"Console": "console", "write": "run_files"}


def __getattr__(name: str) -> Any:
    """Import functions that draw or print on first use: matplotlib and TensorBoard are slow."""
    if name in _MODULES:
        return getattr(import_module(f"lfrtorch.reporting.{_MODULES[name]}"), name)
    raise AttributeError(f"module 'lfrtorch.reporting' has no attribute '{name}'")
