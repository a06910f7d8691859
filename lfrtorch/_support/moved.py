"""Import paths of modules that have moved: the old path gives the same module."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

MOVED = {
    "records": "data", "dataset": "data", "excitation": "data", "periods": "data",
    "score_window": "data", "metrics": "data", "paired_blocks": "data",
    "data_reach": "model", "state_observer": "model", "extended_kalman_filter": "model",
    "known": "model", "file_simulation": "use",
}  # fmt: skip
"""Names of moved modules below ``lfrtorch``, with their rooms."""


class _Paths(MetaPathFinder, Loader):
    """Finder of the modules by their old paths."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        package, _, name = fullname.rpartition(".")
        return ModuleSpec(fullname, self) if package == "lfrtorch" and name in MOVED else None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        name = spec.name.rpartition(".")[2]
        found = import_module(f"lfrtorch.{MOVED[name]}.{name}")
        spec.loader_state = found.__spec__
        return found

    def exec_module(self, module: ModuleType) -> None:
        assert module.__spec__ is not None
        module.__spec__ = module.__spec__.loader_state


def install() -> None:
    """Make the old paths importable."""
    sys.meta_path.append(_Paths())
