"""Every public function and class shows an example of its use, and the examples run."""

import doctest
import importlib
import inspect
import pkgutil
from collections.abc import Callable, Iterator
from copy import deepcopy
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

import lfrtorch
from lfrtorch import FRF, Model, analysis, datasets, distributed, export

REFERENCE = Path(__file__).resolve().parents[1] / "docs" / "api" / "lfrtorch.md"

MODULES = [
    *(getattr(datasets, name) for name in datasets.__all__),
    analysis, distributed, export,
]  # fmt: skip

WITHOUT = {"distributed.ProcessGroup"}
"""``connect`` makes it where torchrun has started several processes."""

FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


def public() -> Iterator[tuple[str, Any]]:
    """What users call, by name."""
    for name in lfrtorch.__all__:
        thing = getattr(lfrtorch, name)
        if not isinstance(thing, ModuleType):
            yield name, thing
    for module in MODULES:
        for name in getattr(module, "__all__", vars(module)):
            thing = getattr(module, name)
            own = hasattr(module, "__all__") or getattr(thing, "__module__", "") == module.__name__
            if own and not name.startswith("_"):
                yield f"{module.__name__.removeprefix('lfrtorch.')}.{name}", thing
    for kind in (Model, FRF):  # the example of LinearModel, a view, has its methods
        for name, thing in vars(kind).items():
            method = inspect.isfunction(thing) or isinstance(thing, classmethod | staticmethod)
            if method and not name.startswith("_"):
                yield f"{kind.__name__}.{name}", getattr(kind, name)


def is_shown(thing: Any) -> bool:
    """Functions and classes, but no exceptions."""
    return callable(thing) and not (inspect.isclass(thing) and issubclass(thing, Exception))


def elsewhere() -> Iterator[tuple[str, Any]]:
    """What else in the package shows an example, by name."""
    for info in pkgutil.walk_packages(lfrtorch.__path__, "lfrtorch."):
        for name, thing in vars(importlib.import_module(info.name)).items():
            own = getattr(thing, "__module__", "") == info.name
            if own and ">>>" in (thing.__doc__ or ""):
                yield f"{info.name.removeprefix('lfrtorch.')}.{name}", thing


PUBLIC = {name: thing for name, thing in public() if is_shown(thing) and name not in WITHOUT}
SHOWN = PUBLIC | {name: thing for name, thing in elsewhere() if thing not in PUBLIC.values()}


@pytest.fixture(scope="module")
def names() -> dict[str, Any]:
    """What the examples know, as the reference says."""
    code = REFERENCE.read_text(encoding="utf-8").split("```python\n")[1].split("```")[0]
    found: dict[str, Any] = {}
    exec(code, found)
    return found


@pytest.mark.numeric
@pytest.mark.parametrize("name", SHOWN)
def test_example_runs(name: str, names: dict[str, Any], tmp_path, monkeypatch):
    known = names | {"model": deepcopy(names["model"])}  # which a fit changes
    finder = doctest.DocTestFinder(recurse=False)
    tests = [test for test in finder.find(SHOWN[name], name, False, known) if test.examples]
    assert tests, f"the docstring of {name} has no example"
    monkeypatch.chdir(tmp_path)
    report: list[str] = []
    write: Callable[[str], Any] = report.append
    for test in tests:
        doctest.DocTestRunner(verbose=False, optionflags=FLAGS).run(test, out=write)
    assert not report, "".join(report)
