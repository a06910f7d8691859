import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pytest

import lfrtorch
from lfrtorch.datasets import boucwen, official

ROOT = Path(__file__).resolve().parents[1]

IMPORT_ALL = """
import importlib, pkgutil, lfrtorch
for module in pkgutil.walk_packages(lfrtorch.__path__, "lfrtorch."):
    importlib.import_module(module.name)
print(lfrtorch.__file__)
"""


def python(*args: object, cwd: Path = ROOT, path: Path | None = None) -> str:
    """Run this interpreter and return what it prints."""
    env = os.environ | ({"PYTHONPATH": str(path)} if path else {})
    run = subprocess.run(
        [sys.executable, *map(str, args)], cwd=cwd, env=env, capture_output=True, text=True
    )
    assert run.returncode == 0, run.stdout + run.stderr
    return run.stdout.strip()


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    for tool in ("build", "hatchling"):
        pytest.importorskip(tool, reason=f"{tool} comes with the extra: pip install -e '.[dev]'")
    out = tmp_path_factory.mktemp("dist")
    python("-m", "build", "--wheel", "--no-isolation", "--outdir", out, ROOT)
    (path,) = out.glob("*.whl")
    return path


def test_wheel_holds_the_package_and_nothing_else(wheel: Path):
    names = {name for name in ZipFile(wheel).namelist() if ".dist-info/" not in name}
    sources = {str(path.relative_to(ROOT)) for path in (ROOT / "lfrtorch").rglob("*.py")}
    assert names == sources | {"lfrtorch/py.typed", "lfrtorch/reporting/templates/report.html"}


@pytest.mark.slow
def test_unpacked_wheel_imports_outside_the_source_tree(wheel: Path, tmp_path: Path):
    target = tmp_path / "target"
    ZipFile(wheel).extractall(target)  # all that installing does with a wheel of Python files
    file = python("-c", IMPORT_ALL, cwd=tmp_path, path=target)
    assert Path(file).is_relative_to(target)


def test_version_is_the_same_everywhere():
    def first(pattern: str, name: str) -> str:
        found = re.search(pattern, (ROOT / name).read_text(encoding="utf-8"), re.MULTILINE)
        assert found, f"no version in {name}"
        return found[1]

    version = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"][
        "version"
    ]
    assert first(r"^version: (\S+)$", "CITATION.cff") == version
    assert first(r"^## \[(\d.*)\]", "CHANGELOG.md") == version


@pytest.mark.numeric
def test_readme_example_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The eight lines of the README, as they stand."""
    text = (ROOT / "README.md").read_text()
    code = text.split("```python\n")[1].split("```")[0]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(official, "cache", lambda: tmp_path)
    monkeypatch.setattr(boucwen, "_SWEEP", 3000)  # a test that the README does not score
    monkeypatch.setattr(boucwen, "_PERIOD", 2048)  # and a quarter of the multisines
    defaults = boucwen.load.__kwdefaults__
    assert defaults is not None
    monkeypatch.setitem(defaults, "samples", 2048)
    names: dict = {}
    exec(code, names)
    record, y_hat = names["data"].tests[0], names["y_hat"]
    # m; 0.5e-5 here, 1.5e-4 of the linear model: what is reached hangs on rounding.
    assert lfrtorch.rmse(record, y_hat) < 3e-5
    assert np.array_equal(names["again"].simulate(record), y_hat)
