"""One canonical form for all weights that are the same model, and it simulates alike."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import reference
import torch
from reference import measure, normal, polynomial_cell, random_cell, random_model
from torch.testing import assert_close

import lfrtorch
from lfrtorch.analysis import canonical
from lfrtorch.data.records import Record
from lfrtorch.engine.lfr import LFR
from lfrtorch.engine.simulation import simulate, steady_state
from lfrtorch.maps.network import Network
from lfrtorch.model.model import Model

pytestmark = pytest.mark.numeric

SIZES: dict[str, Any] = {"nu": 2, "ny": 2, "nx": 3, "nz": 2, "nw": 3, "nn": 6}


def strong(**more: Any) -> Model:
    return random_model(random_cell(**SIZES | more, radius=0.5, feedback=0.4))


def disguised(model: Model, seed: int) -> Model:
    """The same model: other coordinates of x, z and w, and a linear part of w moved about."""
    cell = deepcopy(model.lfr.cell)
    assert isinstance(cell.static, Network)
    Tx, Tz, Tw = (
        torch.linalg.qr(normal(n, n, seed=seed + i))[0]
        @ torch.diag(torch.linspace(0.5, 2, n)).double()
        for i, n in enumerate((cell.nx, cell.nz, cell.nw))
    )
    with torch.no_grad():
        cell.A.copy_(Tx @ cell.A @ Tx.inverse())
        cell.Bu.copy_(Tx @ cell.Bu)
        cell.Bw.copy_(Tx @ cell.Bw @ Tw.inverse())
        cell.Cz.copy_(Tz @ cell.Cz @ Tx.inverse())
        cell.Dzu.copy_(Tz @ cell.Dzu)
        cell.Cy.copy_(cell.Cy @ Tx.inverse())
        cell.Dyw.copy_(cell.Dyw @ Tw.inverse())
        cell.static.Wz.copy_(cell.static.Wz @ Tz.inverse())
        cell.static.Ww.copy_(Tw @ cell.static.Ww)
        cell.static.bw.copy_(Tw @ cell.static.bw)
    return replace(model, lfr=LFR(cell))


def with_a_linear_part(model: Model) -> Model:
    """The same model, whose map has a linear part that the linear block takes off again."""
    cell, move = deepcopy(model.lfr.cell), 0.7 * normal(model.lfr.cell.nw, model.lfr.cell.nz)
    base = cell.static

    class Moved(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.base = base

        def forward(self, z: torch.Tensor) -> torch.Tensor:
            assert self.base is not None
            return self.base(z) + z @ move.mT

    cell.static = Moved()
    with torch.no_grad():
        cell.A.sub_(cell.Bw @ move @ cell.Cz)
        cell.Bu.sub_(cell.Bw @ move @ cell.Dzu)
        cell.Cy.sub_(cell.Dyw @ move @ cell.Cz)
        cell.Dyu.sub_(cell.Dyw @ move @ cell.Dzu)
    return replace(model, lfr=LFR(cell))


def data(model: Model) -> list[Record]:
    return [measure(model, 80, seed=1), measure(model, 60, seed=2)]


def test_it_is_the_same_model_with_a_map_of_no_slope_and_unit_covariances():
    model = strong()
    records = data(model)
    found = canonical(model, records)
    A, Bu, Bw, Cz, Dzu, Cy, Dyu, Dyw = found.matrices
    signals = []
    for record in records:
        y = found.model.simulate(record)
        np.testing.assert_allclose(y, record.y, rtol=0, atol=1e-10 * record.y.std())
        x, z = found.model.signals(record).x[0].numpy(), model.signals(record).z[0].numpy()
        z, u = z @ found.Z.T, model.scaler.normalise_u(record.u)
        w, y = found.static(z), (y - model.scaler.y_offset) / model.scaler.y_scale
        np.testing.assert_allclose(x[1:], x[:-1] @ A.T + u @ Bu.T + w @ Bw.T, atol=1e-10)
        np.testing.assert_allclose(z, x[:-1] @ Cz.T + u @ Dzu.T, atol=1e-10)
        np.testing.assert_allclose(y, x[:-1] @ Cy.T + u @ Dyu.T + w @ Dyw.T, atol=1e-10)
        signals.append((x, z, w))
    x, z, w = (np.concatenate(each) for each in zip(*signals, strict=True))
    for signal in (x, z, w):
        covariance = np.cov(signal.T, bias=True)
        np.testing.assert_allclose(covariance, np.eye(len(covariance)), atol=1e-8)
    np.testing.assert_allclose(np.cov(z.T, w.T, bias=True)[:2, 2:], 0.0, atol=1e-8)
    assert (np.diff(found.shares) <= 0).all()
    assert (np.diff(found.bends) <= 0).all()
    assert found.shares.sum() == pytest.approx(1.0)
    assert found.bends.sum() == pytest.approx(1.0)


@pytest.mark.parametrize("polynomial", [False, True])
def test_it_is_compiled_saved_and_taken_apart_again(polynomial: bool, tmp_path: Path):
    model = random_model(polynomial_cell(2, 2, 3)) if polynomial else strong()
    record = measure(model, 80, seed=1)
    form = canonical(model, record)
    found = form.model
    cell, u = found.lfr.cell, torch.as_tensor(model.scaler.normalise_u(record.u))[None]
    assert cell.map.code is not None
    x0 = normal(1, cell.nx)
    for one, other in zip(simulate(cell, u, x0), reference.simulate(cell, u, x0), strict=True):
        assert_close(one, other, rtol=0, atol=1e-10)
    periodic = steady_state(cell, u)
    assert_close(periodic.y, steady_state(model.lfr.cell, u).y, rtol=0, atol=1e-8)
    assert_close(periodic.w, cell.internal(u, periodic.x[:, :-1])[1], rtol=0, atol=1e-10)
    again = lfrtorch.load(found.save(tmp_path / "model"))
    assert np.array_equal(again.simulate(record), found.simulate(record))
    assert again.sizes == model.sizes
    assert again.net_parameter_count == model.net_parameter_count
    twice = canonical(found, record)
    np.testing.assert_allclose(twice.model.simulate(record), record.y, atol=1e-9)
    np.testing.assert_allclose(twice.X, np.eye(cell.nx), atol=1e-6)
    np.testing.assert_allclose(twice.Z, form.Z, atol=1e-6)


@pytest.mark.parametrize("change", ["first", "second", "linear"])
def test_the_same_model_in_other_weights_has_the_same_form(change: str):
    model = strong()
    other = with_a_linear_part(model) if change == "linear" else disguised(model, len(change))
    records = data(model)
    np.testing.assert_allclose(other.simulate(records[0]), records[0].y, atol=1e-10)
    one, two = (canonical(each, records) for each in (model, other))
    for first, second in zip(one.matrices, two.matrices, strict=True):
        np.testing.assert_allclose(second, first, rtol=0, atol=1e-7 * max(np.abs(first).max(), 1.0))
    z = normal(50, 2).numpy()
    np.testing.assert_allclose(two.static(z), one.static(z), rtol=0, atol=1e-6)
    np.testing.assert_allclose(two.slopes(z), one.slopes(z), rtol=0, atol=1e-6)
    np.testing.assert_allclose(two.shares, one.shares, atol=1e-9)


def test_what_has_no_nonlinearity_is_refused():
    linear = random_model(random_cell(nz=0, nw=0))
    with pytest.raises(lfrtorch.InputError, match="no static map"):
        canonical(linear, measure(linear, 50))
    model = strong()
    with torch.no_grad():
        model.lfr.cell.static.get_parameter("Ww").zero_()  # type: ignore[union-attr]
    with pytest.raises(lfrtorch.InputError, match="it has no nonlinear part"):
        canonical(model, measure(model, 50))


def test_a_map_that_no_output_shows_has_no_shares():
    model = strong()
    cell = model.lfr.cell
    with torch.no_grad():
        cell.Bw.zero_()
        cell.Dyw.zero_()
    record = measure(model, 100)
    found = canonical(model, record)
    assert not found.shares.any()
    assert not found.bends.any()
    np.testing.assert_allclose(found.model.simulate(record), record.y, rtol=0, atol=1e-9)
