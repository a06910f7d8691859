"""The size of the package: code that comes in has to let other code go."""

import runpy
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SLACK = 300
"""Lines that the limit may be above the count, before it has to be lowered."""


def test_the_package_keeps_to_its_number_of_code_lines():
    lines = runpy.run_path(str(ROOT / "benchmarks/house.py"))["lines"]
    count = sum(lines(path)["code"] for path in (ROOT / "lfrtorch").rglob("*.py"))
    limit = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["house"]["code"]
    assert limit - SLACK <= count <= limit
