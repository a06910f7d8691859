"""Do the fast tests pass with the oldest versions of what lfrtorch needs, and with the newest?

    python tests/versions.py min|latest [--keep NAME ...] [-- ARGS of pytest]

The lower bounds in pyproject.toml, or what the package index has, are installed beside the tools of
constraints.txt in an environment of their own, .venv-min or .venv-latest. ``--keep torch`` takes
its version of constraints.txt, for an index whose other versions of it are for CUDA alone.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tomllib
import venv
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[1]
PYTEST = ["-m", "pytest", "-q", "-n", "auto", "--maxprocesses", "4", "--dist", "loadfile"]
TOOLS = ("dev", "docs", "mutants")
"""Extras that no user needs."""
UNTESTED = ("bench",)  # it downloads measurements


def needed() -> dict[str, Requirement]:
    """What lfrtorch and its extras need, by name."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    listed = list(project["dependencies"])
    for name in extras:
        listed += extras[name] if name not in (*TOOLS, *UNTESTED) else []
    return {found.name: found for found in map(Requirement, listed)}


def oldest(requirement: Requirement) -> str:
    """The requirement with its lower bound as the version."""
    bounds = [each.version for each in requirement.specifier if each.operator == ">="]
    if len(bounds) != 1:
        raise ValueError(f"pyproject.toml gives no lower bound of {requirement.name}")
    return f"{requirement.name}=={bounds[0]}"


def pinned() -> dict[str, str]:
    """The versions in constraints.txt, by name."""
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    return {line.split("==")[0]: line for line in lines if "==" in line}


def main(given: list[str]) -> int:
    """Install, then test."""
    arguments = given[given.index("--") + 1 :] if "--" in given else []
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("which", choices=["min", "latest"])
    parser.add_argument("--keep", nargs="+", default=[], metavar="NAME")
    asked = parser.parse_args(given[: given.index("--")] if "--" in given else given)
    requirements, versions = needed(), pinned()
    if unknown := sorted(set(asked.keep) - set(requirements)):
        parser.error(f"lfrtorch does not need {', '.join(unknown)}")
    wanted = [
        versions[name]
        if name in asked.keep
        else (oldest(requirement) if asked.which == "min" else str(requirement))
        for name, requirement in requirements.items()
    ]
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    tools = {Requirement(each).name for each in project["optional-dependencies"]["dev"]}
    wanted += [versions[name] for name in sorted(tools - set(requirements))]

    place = ROOT / f".venv-{asked.which}"
    venv.create(place, with_pip=True)
    python = str(place / ("Scripts" if sys.platform == "win32" else "bin") / "python")
    pip = [python, "-m", "pip", "install", "-qq", "--disable-pip-version-check", "--upgrade"]
    subprocess.run([*pip, *wanted], check=True)
    subprocess.run([*pip, "--no-deps", "-e", str(ROOT)], check=True)
    subprocess.run([python, "-m", "pip", "list", "--format=freeze"], check=True)
    # What the oldest versions use of yet newer packages may be deprecated there.
    warned = ["-W", "ignore::DeprecationWarning"] if asked.which == "min" else []
    return subprocess.run([python, *PYTEST, *warned, *arguments], cwd=ROOT, check=False).returncode


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
