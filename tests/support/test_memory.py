"""What memory there is."""

from __future__ import annotations

import math
import subprocess
import sys
from pathlib import Path

import pytest

from lfrtorch._support.memory import limit_of, memory_of


@pytest.mark.parametrize(
    ("groups", "folder", "name"),
    [
        ("0::/job_7/step_0\n", "job_7", "memory.max"),
        ("0::/\n", ".", "memory.max"),
        ("9:cpu:/x\n8:memory,cpuset:/docker/a\n", "memory/docker/a", "memory.limit_in_bytes"),
    ],
)
def test_a_container_takes_what_its_groups_leave(tmp_path, groups: str, folder: str, name: str):
    listed, mounted = tmp_path / "cgroup", tmp_path / "mounted"
    listed.write_text(groups)
    assert limit_of(listed, mounted) == math.inf
    (mounted / folder).mkdir(parents=True)
    for text, limit in (("max\n", math.inf), ("2000000000\n", 2e9)):
        (mounted / folder / name).write_text(text)
        assert limit_of(listed, mounted) == limit


def test_groups_above_limit_those_in_them(tmp_path: Path):
    (tmp_path / "cgroup").write_text("0::/a/b\n")
    (tmp_path / "a/b").mkdir(parents=True)
    (tmp_path / "a/b/memory.max").write_text("max\n")
    (tmp_path / "a/memory.max").write_text("5\n")
    (tmp_path / "memory.max").write_text("7\n")
    assert limit_of(tmp_path / "cgroup", tmp_path) == 5


def test_this_machine_has_memory():
    assert memory_of() > 1e8


@pytest.mark.skipif(sys.platform != "linux", reason="other systems set no such limit")
def test_a_limit_of_the_process_counts():
    told = "from lfrtorch._support.memory import memory_of; print(memory_of())"
    limited = f"import resource; resource.setrlimit(resource.RLIMIT_AS, (2**31, 2**31)); {told}"
    said = subprocess.run([sys.executable, "-c", limited], capture_output=True, check=True)
    assert float(said.stdout) <= 2**31
