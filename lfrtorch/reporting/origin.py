"""Origin of a run: checksums of its records, the machine, the caller's code."""

from __future__ import annotations

import os
import platform
import subprocess
from hashlib import sha256
from typing import Any

import numpy as np
import torch

from lfrtorch.data.dataset import Dataset
from lfrtorch.data.records import Record


def origin(dataset: Dataset) -> dict[str, Any]:
    """Machine, git state and checksums of the records for ``metrics.json``."""
    records = (*dataset.train, *dataset.validation, *dataset.selection, *dataset.tests)
    return {
        "machine": {
            "platform": platform.platform(),
            "processor": platform.machine(),
            "cpus": os.cpu_count(),
            "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        },
        "git": git_state(),
        "checksums": {record.name: checksum(record) for record in records},
    }


def checksum(record: Record) -> str:
    """SHA-256 of a record's shapes, rate, and signals as float64."""
    found = sha256(f"{record.u.shape} {record.y.shape} {record.fs!r}".encode())
    signals = [record.u, record.y]
    if record.reference is not None:
        signals.append(record.reference)
    for signal in signals:
        found.update(np.ascontiguousarray(signal, dtype="<f8").data)
    return found.hexdigest()


def git_state() -> dict[str, Any] | None:
    """The commit of the working directory, and whether tracked files differ from it."""
    commit = _git("rev-parse", "HEAD")
    if commit is None:
        return None
    changes = _git("status", "--porcelain", "--untracked-files=no")
    return {"commit": commit, "changed": None if changes is None else bool(changes)}


def _git(*words: str) -> str | None:
    """Output of git; None if it fails."""
    try:
        done = subprocess.run(
            ["git", *words], capture_output=True, text=True, check=True, timeout=10
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()
