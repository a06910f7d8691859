"""The figure of a model: what is drawn of which sizes, and the direction that bends most."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from reference import measure, random_cell, random_model

import lfrtorch
from lfrtorch.analysis.model_plots import most_nonlinear, static_figure, visited
from lfrtorch.maps.polynomial import Polynomial

pytestmark = pytest.mark.numeric


@pytest.mark.parametrize(
    ("sizes", "titles"),
    [
        ({"nz": 0, "nw": 0}, ["y1 / u1", "poles in the z plane"]),
        ({"nx": 3}, ["y1 / u1", "poles in the z plane", "w1: "]),
        ({"nu": 2, "nz": 2, "nw": 2}, ["y1 / u1", "y1 / u2", "poles in", "w1: ", "w2: "]),
        ({"ny": 3, "nu": 2, "nz": 3, "nw": 5}, ["y1 / u1", "y2 / u2", "poles", "w1: ", "w4: "]),
    ],
)
def test_panels(sizes: dict[str, Any], titles: list[str]):
    model = random_model(random_cell(**sizes))
    figure = lfrtorch.analysis.plot(model, measure(model, 100) if sizes.get("nw", 1) else None)
    shown = [ax.get_title() for part in figure.subfigs for ax in part.axes]
    for title in titles:
        assert any(one.startswith(title) for one in shown), title
    assert not any(one.startswith(("w5", "y3 / u1")) for one in shown)
    for line in figure.subfigs[0].axes[0].lines:
        assert np.isfinite(np.asarray(line.get_ydata(), dtype=float)).all()


def test_the_static_map_alone_is_the_last_part_and_a_linear_model_has_none():
    model = random_model(random_cell(nz=2, nw=3))
    titles = [ax.get_title() for ax in static_figure(model).axes]
    assert [title[:3] for title in titles if title] == ["w1:", "w2:", "w3:"]
    with pytest.raises(lfrtorch.InputError, match="has no static map"):
        static_figure(random_model(random_cell(nz=0, nw=0)))


def test_the_direction_that_bends_is_found_and_the_linear_part_is_taken_off():
    """w = 5 z1 + (z1 + 2 z2 - z3)² bends along one direction alone."""
    cell = random_cell(nx=4, nz=3, nw=1, static=Polynomial(3, 1, 2), feedback=0.0)
    assert isinstance(cell.static, Polynomial)
    direction = torch.tensor([1.0, 2.0, -1.0]).double()
    products = torch.outer(direction, direction)
    with torch.no_grad():
        cell.static.C.zero_()
        cell.static.C[0, 1] = 5.0
        n = 4
        for i in range(3):
            for j in range(i, 3):
                cell.static.C[0, n] = products[i, j] * (1 if i == j else 2)
                n += 1
    model = random_model(cell)
    where = visited(model, cell.map, None)
    at, share = most_nonlinear(cell.map, where, 0)
    assert share == pytest.approx(1.0, abs=1e-9)
    assert abs(np.corrcoef(at, where.z @ direction.numpy())[0, 1]) == pytest.approx(1.0)
    assert np.std(at) == pytest.approx(1.0, abs=1e-6)
    known = visited(model, cell.map, [measure(model, 300), measure(model, 200, seed=1)])
    assert known.z.shape == (500, 3)
    assert (known.known, where.known) == (True, False)
    assert 0.0 < known.nonlinear[0] < 1.0


def test_a_model_without_rest_has_a_figure_and_one_that_diverges_is_refused():
    cell = random_cell(nz=1, nw=1, static=Polynomial(1, 1, 2))
    assert isinstance(cell.static, Polynomial)
    with torch.no_grad():  # x1 grows by a step and a square in each sample
        cell.A.copy_(torch.diag(torch.tensor([1.0, 0.5])))
        cell.Bu.zero_()
        cell.Dzu.zero_()
        cell.Bw.copy_(torch.tensor([[1.0], [0.0]]))
        cell.Cz.copy_(torch.tensor([[1.0, 0.0]]))
        cell.static.C.copy_(torch.tensor([[1.0, 0.0, 1e-8]]))
    model = random_model(cell)
    record = lfrtorch.Record(
        np.zeros(30), np.zeros(30), model.fs, inputs=model.inputs, outputs=model.outputs
    )
    figure = lfrtorch.analysis.plot(model, record)
    labels = [line.get_label() for line in figure.subfigs[0].axes[0].lines]
    assert labels == ["linear part"]
    with torch.no_grad():
        cell.static.C[0, 2] = 10.0
    with pytest.raises(lfrtorch.InputError, match="diverges on the records"):
        lfrtorch.analysis.plot(model, record)
    with pytest.raises(lfrtorch.InputError, match="diverges under white noise"):
        lfrtorch.analysis.plot(model)
