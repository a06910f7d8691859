"""A record is looked at as a file is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import lfrtorch

pytestmark = pytest.mark.numeric


def test_it_has_what_the_command_shows_of_a_file():
    rng = np.random.default_rng(0)
    u = rng.standard_normal(800)
    y = np.zeros(800)
    for k in range(799):
        y[k + 1] = 0.95 * y[k] + u[k]
    y += 0.02 * rng.standard_normal(800)
    record = lfrtorch.Record(u, y, fs=50.0)
    good = lfrtorch.preview(record)
    assert good.notes == ()
    assert str(good).endswith("Nothing found that would hurt a model.")
    assert good.figure.axes[-3].get_xlabel().startswith("time")
    valid = np.ones((800, 1), dtype=bool)
    valid[100:120] = False
    begun = replace(record, start="estimated")
    assert lfrtorch.preview(replace(begun, valid=valid)).survey.outputs[0].missing == 20
    moving = lfrtorch.preview(lfrtorch.Record(u[200:], y[200:], fs=50.0))
    assert any("start is estimated, and the record has start" in note for note in moving.notes)
    held = np.repeat(u[::80], 80)
    found = lfrtorch.preview(replace(begun, u=held[:, None]))
    assert found.notes
    assert f"- {found.notes[0][:40]}" in str(found)
