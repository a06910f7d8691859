"""What a run was made from and where."""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np
import pytest

from lfrtorch.data.records import Record
from lfrtorch.reporting.origin import checksum, git_state

U = np.random.default_rng(0).standard_normal(50)


def test_checksum_is_of_samples_and_rate():
    record = Record(U, 2 * U, 10.0)
    assert checksum(record) == checksum(Record(U.copy(), 2 * U, 10.0, skip=5))
    others = [Record(U, 3 * U, 10.0), Record(2 * U, 2 * U, 10.0), Record(U, 2 * U, 20.0)]
    others += [Record(U, 2 * U, 10.0, reference=r) for r in (U, 4 * U)]
    assert len({checksum(one) for one in (record, *others)}) == 6


def test_git_state_of_the_working_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path.parent))
    try:
        subprocess.run(["git", "init", "-q"], check=True)
    except OSError:
        pytest.skip("needs git")
    assert git_state() is None  # no commit yet
    Path("x").write_text("1")
    who = ["-c", "user.name=x", "-c", "user.email=x@example.com"]
    for words in (["add", "x"], [*who, "commit", "-q", "--no-gpg-sign", "-m", "first"]):
        subprocess.run(["git", *words], check=True)
    state = git_state()
    assert state is not None
    assert state["changed"] is False
    Path("x").write_text("2")
    assert git_state() == {**state, "changed": True}
