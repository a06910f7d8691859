"""Tests of what follows a fit."""

from dataclasses import replace

import numpy as np
import pytest
import scipy
import torch

import lfrtorch
from lfrtorch.fitting.last_fits import without_poor_starts


@pytest.mark.parametrize(
    ("runs_away", "kept"), [((), [0, 1, 2]), ((0,), [1, 2]), ((0, 2), [1]), ((0, 1, 2), [0, 1, 2])]
)
def test_a_start_whose_simulation_runs_away_is_in_no_mean(
    runs_away: tuple[int, ...], kept: list[int]
):
    u = np.random.default_rng(0).standard_normal(200)
    record = lfrtorch.Record(u, np.tanh(scipy.signal.lfilter([0.0, 0.5], [1.0, -0.7], u)), fs=1.0)
    bla = lfrtorch.estimate_bla(record, nx=1)
    models = [lfrtorch.initialise(bla, record, nz=1, nw=1, nn=3, seed=k) for k in range(3)]
    result = lfrtorch.fit(models[0], record, trainer=lfrtorch.LevenbergMarquardt(max_iter=1))
    for k in runs_away:
        with torch.no_grad():
            models[k].lfr.cell.A.fill_(torch.nan)
    found = without_poor_starts(replace(result, members=tuple(models), averaged=3), [record])
    assert found.averaged == len(kept)
    if len(kept) == 1:
        assert found.model is models[kept[0]]
    else:
        assert {*map(id, found.members)} == {id(models[k]) for k in kept}
