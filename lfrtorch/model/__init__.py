"""An LFR with its scaling, rate and channels, and online observers of its states."""

from __future__ import annotations

from importlib import import_module as _import_module

_NAMES = {"Model": "model", "Resampled": "model", "load": "loading", "simulate_blocks": "model"}


def __getattr__(name: str) -> object:
    """Import the model at its first use: its observers do not need it."""
    if name in _NAMES:
        return getattr(_import_module(f"lfrtorch.model.{_NAMES[name]}"), name)
    raise AttributeError(f"module 'lfrtorch.model' has no attribute '{name}'")
