"""Fixtures of the command line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hydra._internal import utils as hydra_utils


@pytest.fixture
def untraced(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hydra raises its errors where it sees a debugger, and takes coverage for one."""
    monkeypatch.setattr(hydra_utils, "is_under_debugger", lambda: False)


@pytest.fixture(scope="module")
def csv(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short record of a saturating first-order system with offsets."""
    rng = np.random.default_rng(0)
    u = 2.0 + rng.standard_normal(600)
    x, y = 0.0, []
    for u_k in u:
        y.append(5.0 + np.tanh(x))
        x = 0.7 * x + 0.4 * (u_k - 2.0)
    path = tmp_path_factory.mktemp("csv") / "x.csv"
    rows = "\n".join(f"{a:.17g},{b:.17g}" for a, b in zip(u, y, strict=True))
    path.write_text(f"u,y\n{rows}\n")
    return path
