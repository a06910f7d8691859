"""The known models of the guide are fitted."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import lfrtorch
from lfrtorch import Dataset, LevenbergMarquardt, Record

GUIDE = (Path(__file__).resolve().parents[2] / "docs/guide/known.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"```python\n(.*?)```", GUIDE, flags=re.DOTALL)


def test_three_systems_take_fifteen_lines_each():
    assert len(EXAMPLES) == 4
    assert max(len([line for line in text.splitlines() if line]) for text in EXAMPLES[:3]) <= 16


@pytest.mark.parametrize("text", EXAMPLES, ids=["tank", "pendulum", "aircraft", "heater"])
def test_a_model_of_the_guide_is_fitted(text: str):
    names: dict[str, Any] = {"torch": torch, "lfrtorch": lfrtorch, "math": math}
    exec(text, names)
    settings = names["settings"]
    u = np.repeat(np.random.default_rng(0).standard_normal(30), 6)
    u = 2.0 + 0.5 * u if "tank" in names else u  # a pump does not suck
    model = names["known"].map(1, ["y"], 10.0)
    x, y = torch.zeros(model.nx, dtype=torch.float64), []
    for value in torch.from_numpy(np.roll(u, settings.delay)):
        x, output = model(torch.cat([x, value[None]])).detach().split([model.nx, 1])
        y.append(float(output))
    assert np.isfinite(y).all()
    record = Record(u, np.array(y), fs=10.0, start="estimated")
    short = {"trainer": LevenbergMarquardt(max_iter=3), "starts": 1}
    options = {
        name: getattr(settings, name)
        for name in (*("known", "nx", "nz", "nw", "nn", "ridge", "delay"),)
    }
    run = lfrtorch.identify(
        Dataset("guide", [record], [], []), lfrtorch.Settings(**options, **short)
    )
    assert run.parameters is not None
    assert lfrtorch.rmse(record, run.model.simulate(record)) < 0.05 * np.std(y)
