import importlib
import os
import re
import subprocess
import sys
import sysconfig
import tomllib
import venv
from collections.abc import Callable
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pytest
import torch

import lfrtorch
from lfrtorch import _public
from lfrtorch._support.moved import MOVED
from lfrtorch.cli.command import COMMANDS, versions
from lfrtorch.datasets import boucwen, official

ROOT = Path(__file__).resolve().parents[1]

IMPORT_ALL = """
import importlib, pkgutil, lfrtorch
for module in pkgutil.walk_packages(lfrtorch.__path__, "lfrtorch."):
    importlib.import_module(module.name)
print(lfrtorch.__file__)
"""


def python(*args: object) -> None:
    """Run this interpreter at the top of the sources."""
    run = subprocess.run(
        [sys.executable, *map(str, args)], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stdout + run.stderr


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
    settings = {f"lfrtorch/{path.relative_to(ROOT)}" for path in (ROOT / "conf").rglob("*.yaml")}
    folders = (ROOT / "lfrtorch").rglob("templates")
    templates = [path for folder in folders for path in folder.rglob("*") if path.is_file()]
    others = {"lfrtorch/py.typed", "lfrtorch/datasets/published.csv"}
    others |= {str(path.relative_to(ROOT)) for path in templates}
    assert names == sources | settings | others


@pytest.mark.slow
def test_two_builds_are_the_same_bytes(wheel: Path, tmp_path: Path, monkeypatch):
    assert wheel.is_file()  # the tools are there
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1700000000")
    for folder in ("one", "other"):
        python("-m", "build", "--no-isolation", "--outdir", tmp_path / folder, ROOT)
    built = sorted((tmp_path / "one").iterdir())
    assert [path.suffix for path in built] == [".whl", ".gz"]
    for path in built:
        assert path.read_bytes() == (tmp_path / "other" / path.name).read_bytes()


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The bin folder of an environment that has the wheel and its dependencies, not the sources."""
    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder, with_pip=False)
    executables = folder / ("Scripts" if os.name == "nt" else "bin")
    (place,) = folder.rglob("site-packages")
    # A .pth file within is not read: the sources, which one names, stay out.
    (place / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    pip = "-m", "pip", "--python", executables / "python"
    python(*pip, "install", "-qq", "--no-deps", "--no-index", "--ignore-installed", wheel)
    return executables


def command(installed: Path, folder: Path, *words: object) -> str:
    """What the installed ``lfrtorch`` prints in ``folder``."""
    env = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    run = subprocess.run(
        [installed / "lfrtorch", *map(str, words)],
        cwd=folder, env=env, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert run.returncode == 0, run.stdout + run.stderr
    return run.stdout


def test_installed_wheel_has_the_commands_and_their_settings(installed: Path, tmp_path: Path):
    settings = command(installed, tmp_path, "fit", "+bench=boucwen", "--cfg", "job")
    assert "_target_: lfrtorch.datasets.boucwen.load" in settings
    named = command(installed, tmp_path)
    assert [line.split()[1] for line in named.splitlines()[1:-1]] == list(COMMANDS)


@pytest.mark.slow
def test_installed_wheel_runs_from_file_to_new_outputs(installed: Path, tmp_path: Path):
    t = np.arange(400)
    u = np.sin(0.3 * t) + 0.5 * np.sin(0.7 * t + 1.0)
    y = np.zeros_like(u)
    for k in t[1:]:
        y[k] = 0.7 * y[k - 1] + 0.3 * np.tanh(2.0 * u[k - 1])
    np.savetxt(tmp_path / "x.csv", np.c_[u, y], delimiter=",", header="u,y", comments="")
    data = "data=file", "data.path=x.csv", "data.inputs=[u]", "data.outputs=[y]", "data.fs=10"
    preview = command(
        installed, tmp_path, "preview", "x.csv", "data.inputs=[u]", "data.outputs=[y]"
    )
    assert "signal" in preview
    assert "Linear model of order 1" in command(installed, tmp_path, "linear", *data, "nx=1")
    run = "nx=1", "nz=1", "nn=3", "trainer.max_iter=5", "hydra.run.dir=run"
    command(installed, tmp_path, "fit", *data, *run)
    assert (tmp_path / "run" / "report.html").is_file()
    assert "NL-LFR" in command(installed, tmp_path, "evaluate", *data, "checkpoint=run")
    files = "checkpoint=run", "data.path=x.csv", "out=y.csv"
    assert "y.csv: 400 samples" in command(installed, tmp_path, "simulate", *files)


@pytest.mark.slow
def test_every_module_of_an_installed_wheel_imports(installed: Path, tmp_path: Path):
    env = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    found = subprocess.run(
        [installed / "python", "-c", IMPORT_ALL],
        cwd=tmp_path, env=env, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert found.returncode == 0, found.stderr
    assert Path(found.stdout.strip()).is_relative_to(installed.parent)


HEAVY = ("hydra", "matplotlib", "pandas", "jinja2", "scipy.signal", "scipy.io", "scipy.stats")
"""What some functions alone need; together they take more than a second to import."""


LIGHT = ("Record", "Dataset", "multisine", "nrmse", "InputError")
"""Names of what computes no model."""

CELL = """
from lfrtorch.engine.cell import LFRCell
lfrtorch.identify
torch.set_default_device("meta")
LFRCell(1, 1, 2)
"""

STEPS = {
    "the package": "import lfrtorch",
    "light names": "; ".join(f"lfrtorch.{name}" for name in LIGHT),
    "a job": f"import torch\n{CELL}",
    "a fit": "import lfrtorch.cli.fit",
}
"""Code that one process does step by step."""


@pytest.fixture(scope="module")
def loaded() -> dict[str, set[str]]:
    """Modules that there are after each step."""
    code = ["import sys"]
    for step in STEPS.values():
        code += [step, "print(*sys.modules)"]
    run = subprocess.run(
        [sys.executable, "-c", "\n".join(code)],
        cwd=ROOT, capture_output=True, text=True, check=True,
    )  # fmt: skip
    names = (set(line.split()) for line in run.stdout.splitlines())
    return dict(zip(STEPS, names, strict=True))


def test_import_takes_what_it_needs_and_no_more(loaded: dict[str, set[str]]):
    """Nor does a cell without memory, by which that of a fit is checked, the compiler of torch."""
    assert "numpy" not in loaded["the package"]
    assert loaded["a job"].isdisjoint([*HEAVY, "torch._dynamo", "scipy.spatial"])


def test_what_computes_no_model_imports_nothing_that_does(loaded: dict[str, set[str]]):
    others = {"torch", "scipy", "numba", "safetensors", "jaxtyping", *HEAVY}
    assert loaded["light names"].isdisjoint(others)


def test_a_single_fit_imports_no_tables_of_several(loaded: dict[str, set[str]]):
    assert loaded["a fit"].isdisjoint(["pandas", "scipy.signal"])


def test_the_package_shows_its_public_names_and_no_others():
    shown = {name for name in dir(lfrtorch) if not name.startswith("__")}
    assert shown == set(lfrtorch.__all__) == set(_public.__all__)
    for name in shown:
        assert getattr(lfrtorch, name) is getattr(_public, name)
    of_the_library = {"Any", "TYPE_CHECKING", "import_module", "version"}
    assert not [name for name in of_the_library if hasattr(lfrtorch, name)]


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
def test_the_version_names_what_computes():
    said = versions()
    assert said.startswith(f"lfrtorch {lfrtorch.__version__} (torch {torch.__version__}, numba ")
    assert "Python 3." in said


@pytest.mark.usefixtures("coarse")
def test_readme_example_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shorter: Callable[..., None]
) -> None:
    """The eight lines of the README, as they stand."""
    text = (ROOT / "README.md").read_text()
    code = text.split("```python\n")[1].split("```")[0]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(official, "cache", lambda: tmp_path)
    shorter(sweep=3000, period=2048)  # a test that the README does not score, a quarter of others
    defaults = boucwen.load.__kwdefaults__
    assert defaults is not None
    monkeypatch.setitem(defaults, "samples", 2048)
    names: dict = {}
    exec(code, names)
    record, y_hat = names["data"].tests[0], names["y_hat"]
    # m; 0.5e-5 here, 1.5e-4 of the linear model: what is reached hangs on rounding.
    assert lfrtorch.rmse(record, y_hat) < 3e-5
    assert np.array_equal(names["run"].model.simulate(record), y_hat)
    assert (tmp_path / "boucwen" / "report.html").is_file()


@pytest.mark.parametrize("name", MOVED)
def test_a_path_of_before_leads_to_the_module(name: str):
    before, now = (importlib.import_module(f"lfrtorch.{p}{name}") for p in ("", f"{MOVED[name]}."))
    assert before is now
    assert now.__spec__ is not None
    assert now.__spec__.name == now.__name__ == f"lfrtorch.{MOVED[name]}.{name}"


def test_names_of_modules_that_are_packages_now():
    from lfrtorch.distributed import connect  # noqa: F401
    from lfrtorch.known_systems import emps  # noqa: F401
    from lfrtorch.model import Model, Resampled, load, simulate_blocks  # noqa: F401
    from lfrtorch.sklearn import NLLFR  # noqa: F401

    assert Model is lfrtorch.Model
    with pytest.raises(AttributeError, match="has no attribute 'other'"):
        _ = importlib.import_module("lfrtorch.model").other
