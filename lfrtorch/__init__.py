"""Identification of nonlinear LFR state-space models from input-output data.

dataset, settings -> identify -> run: the whole job in one call, or step by step:
records -> estimate_bla -> initialise -> fit -> simulate, save, load
records -> estimate_frf, scan_orders -> estimate_bla -> simulate, save, to_scipy
"""

import typing as _typing
from importlib import import_module as _import_module
from importlib.metadata import version as _version

if _typing.TYPE_CHECKING:
    from lfrtorch._public import *  # noqa: F403
    from lfrtorch._public import __all__ as __all__

__version__ = _version("lfrtorch")


if not _typing.TYPE_CHECKING:  # a checker would take every name for one of these

    def __getattr__(name: str) -> object:
        """Import the public names with the first that is asked for."""
        if name == "__all__" or not name.startswith("_"):
            public = _import_module("lfrtorch._public")
            if name == "__all__" or name in getattr(public, "__all__", ()):
                return getattr(public, name)
        raise AttributeError(f"module 'lfrtorch' has no attribute '{name}'")

    def __dir__() -> list[str]:
        own = (name for name in globals() if name.startswith("__"))
        return sorted({*own, *__getattr__("__all__")})
