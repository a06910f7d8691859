"""Checkpoints of two versions before are read: each kind to the outputs that it had then.

``checkpoints/`` has small models that those versions fitted and saved, and what they simulated.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import lfrtorch
from lfrtorch.maps.network import Network

pytestmark = pytest.mark.numeric

HERE = Path(__file__).parent / "checkpoints"
SAVED = [folder for version in ("first", "second") for folder in sorted((HERE / version).iterdir())]
FOLDERS = [folder for folder in SAVED if folder.is_dir()]
U = np.linspace(-1.0, 1.0, 20)


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda f: f"{f.parent.name} {f.name}")
def test_a_model_of_before_simulates_as_then(folder: Path, tmp_path: Path):
    expected = json.loads((folder.parent / "outputs.json").read_text())[folder.name]
    model = lfrtorch.load(folder)
    np.testing.assert_allclose(model.simulate(U).ravel(), expected, rtol=1e-9, atol=1e-10)
    again = lfrtorch.load(model.save(tmp_path / "again"))
    assert np.array_equal(again.simulate(U), model.simulate(U))
    assert {n: m.tolist() for n, m in again.lfr.cell.held.items()} == {
        n: m.tolist() for n, m in model.lfr.cell.held.items()
    }


def test_each_kind_is_there():
    kinds = {folder.name for folder in FOLDERS}
    assert kinds == {
        "network", "polynomial", "no_feedthrough", "series", "linear", "canonical", "known", "fixed"
    }  # fmt: skip


@pytest.mark.parametrize("version", ["first", "second"])
def test_what_a_fit_held_then_it_holds_now(version: str):
    names = {"no_feedthrough": {"Dzu"}, "series": {"A", "Bu", "Bw", "Cz"}, "fixed": {"Cy"}}
    for name, held in names.items():
        if (folder := HERE / version / name).is_dir():
            cell = lfrtorch.load(folder).lfr.cell
            assert {*cell.held} == held
            assert all(not cell.get_parameter(n)[cell.held[n]].any() for n in held - {"Cy"})


@pytest.mark.parametrize("version", ["first", "second"])
def test_a_canonical_form_is_folded_into_a_plain_map(version: str):
    assert isinstance(lfrtorch.load(HERE / version / "canonical").lfr.cell.static, Network)


@pytest.mark.parametrize("version", ["first", "second"])
def test_a_linear_model_of_before_is_its_own_view(version: str):
    folder = HERE / version / "linear"
    linear = lfrtorch.LinearModel.load(folder)
    assert linear.fit is not None
    assert linear.covariance is not None
    assert linear.covariance.shape == (9, 9)
    np.testing.assert_array_equal(linear.simulate(U), lfrtorch.load(folder).simulate(U))
