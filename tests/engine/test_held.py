"""A model that is made of blocks stays so: in a fit, in a file, and in what it computes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from reference import measure, random_cell, random_model

import lfrtorch
from lfrtorch.data.records import Record
from lfrtorch.engine.held import IN_SERIES, structure
from lfrtorch.maps.network import Network
from lfrtorch.model.model import Model

pytestmark = pytest.mark.numeric

KINDS = ("wiener", "hammerstein", "wiener_hammerstein", "parallel")


def begun(kind: str, record: Record, *, nx: int = 2, seed: int = 0, **sizes: Any) -> Model:
    bla = lfrtorch.estimate_bla(record, nx=nx)
    branches = 2 if kind == "parallel" else 1
    sizes = {"nz": branches, "nw": branches, "nn": 6} | sizes
    return lfrtorch.initialise(bla, record, **sizes, structure=kind, seed=seed)


def truth(kind: str) -> Model:
    """A system of that structure, strongly nonlinear; blocks in series have a state per branch."""
    branches = 2 if kind == "parallel" else 1
    nx = 2 * branches
    cell = random_cell(1, 1, nx, branches, branches, 4, radius=0.8, feedback=1.0, seed=3)
    cell.hold(structure(cell, kind))
    assert isinstance(cell.static, Network)
    with torch.no_grad():
        cell.Dyw.fill_(1.0 if kind == "wiener" else 0.0)
        cell.static.Ww.mul_(2.0)
        cell.static.Wz.mul_(2.0)
        cell.Bw.mul_(2.0)
    return random_model(cell)


@pytest.fixture(scope="module")
def record() -> Record:
    return measure(random_model(random_cell(nx=2, radius=0.8, feedback=0.4)), 200)


@pytest.mark.parametrize("kind", KINDS)
def test_a_fit_and_a_file_keep_the_blocks(kind: str, record: Record, tmp_path: Path):
    model = begun(kind, record)
    linear = lfrtorch.estimate_bla(record, nx=2)
    np.testing.assert_allclose(model.simulate(record), linear.simulate(record), atol=1e-8)
    trainer = lfrtorch.LevenbergMarquardt(max_iter=25)
    fitted = lfrtorch.fit(model, record, record, trainer=trainer).model
    cell = fitted.lfr.cell
    error = np.std(fitted.simulate(record) - record.y)
    assert error < 0.98 * np.std(linear.simulate(record) - record.y)
    assert cell.held.keys() == structure(cell, kind).keys()
    for name, zeros in cell.held.items():
        assert not cell.get_parameter(name)[zeros].any(), name
    again = lfrtorch.load(fitted.save(tmp_path / "model"))
    assert all(again.lfr.cell.held[name].equal(mask) for name, mask in cell.held.items())
    assert again.parameter_count == fitted.parameter_count
    assert again.parameter_count < sum(p.numel() for p in again.lfr.parameters())


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_planted_systems_are_recovered(kind: str):
    """From noise-free steady states, to a fiftieth of the linear model's error on other data.

    Validation picks one of 16 starts if the blocks are in series: the linear model does not say
    which of its poles are before the static map and which after it.
    """
    system = truth(kind)
    train, judge, test = (
        measure(system, T, seed=seed, start="periodic")
        for seed, T in enumerate([1024, 1024, 400], start=1)
    )
    nx, starts = system.lfr.cell.nx, 16 if kind in IN_SERIES else 3
    linear = lfrtorch.estimate_bla(train, nx=nx)
    models = [begun(kind, train, nx=nx, seed=seed, nn=4) for seed in range(starts)]
    trainer = lfrtorch.LevenbergMarquardt(max_iter=100)
    fitted = lfrtorch.fit(models, train, judge, trainer=trainer).model
    left = np.std(fitted.simulate(test) - test.y) / np.std(linear.simulate(test) - test.y)
    assert left < 0.02, left


def test_what_a_structure_has_no_place_for_is_refused(record: Record):
    with pytest.raises(lfrtorch.InputError, match="a w for each z"):
        begun("parallel", record, nz=2, nw=1)
    with pytest.raises(lfrtorch.InputError, match="use one of free, wiener"):
        begun("volterra", record)
