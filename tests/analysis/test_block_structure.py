"""Planted structures are named, whatever the coordinates of the model."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from reference import measure, normal, random_model

from lfrtorch.analysis import canonical, structure
from lfrtorch.engine.cell import LFRCell
from lfrtorch.maps.network import Network
from lfrtorch.model import Model

pytestmark = pytest.mark.numeric


def planted(kind: str) -> Model:
    """Two states before and two after one map, or two branches of these, mixed by a rotation."""
    branches = 2 if kind in ("parallel", "coupled") else 1
    cell = LFRCell(
        1,
        1,
        4 * branches,
        branches,
        branches,
        Network(branches, branches, 3 * branches),
        random=False,
    )
    cell.double()
    static = cell.static
    assert isinstance(static, Network)
    with torch.no_grad():
        for name, p in static.named_parameters():
            p.copy_(normal(*p.shape, seed=len(name)))
        if kind == "parallel":
            mask = torch.block_diag(torch.ones(3, 1), torch.ones(3, 1))
            static.Wz.mul_(mask)
            static.Ww.mul_(mask.mT)
            static.Ww.copy_(
                torch.block_diag(*torch.tensor([[[1.0, -0.5, 0.7]], [[-2.0, 1.0, 1.5]]]))
            )
        static.Wz.mul_(2.0)
        for i in range(branches):
            first, last = slice(4 * i, 4 * i + 2), slice(4 * i + 2, 4 * i + 4)
            cell.A[first, first] = torch.tensor([[0.6 + 0.25 * i, 0.3], [-0.3, 0.4]]).double()
            cell.A[last, last] = torch.tensor([[0.7, 0.2 - 0.5 * i], [-0.2, 0.5]]).double()
            cell.Bu[first], cell.Cz[i, first] = normal(2, 1, seed=i), normal(2, seed=3 + i)
            cell.Bw[last, i], cell.Cy[0, last] = normal(2, seed=5 + i), normal(2, seed=7 + i)
        if kind in ("Wiener", "static"):
            cell.Bw.zero_()
            cell.Dyw.fill_(1.0)
        if kind in ("Hammerstein", "static"):
            cell.Cz.zero_()
            cell.Dzu.fill_(1.0)
        if kind == "feedback":
            cell.Cz[0, 2:] = 1.5
        turn = torch.linalg.qr(normal(cell.nx, cell.nx))[0]
        cell.A.copy_(turn @ cell.A @ turn.mT)
        for p in (cell.Bu, cell.Bw):
            p.copy_(turn @ p)
        for p in (cell.Cz, cell.Cy):
            p.copy_(p @ turn.mT)
        turn = normal(branches, branches, seed=2)
        cell.Cz.copy_(turn @ cell.Cz)
        cell.Dzu.copy_(turn @ cell.Dzu)
        static.Wz.copy_(static.Wz @ turn.inverse())
    return random_model(cell)


@pytest.mark.parametrize(
    "kind",
    ["static", "Wiener", "Hammerstein", "Wiener-Hammerstein", "parallel", "coupled", "feedback"],
)
def test_planted_structures_are_named(kind: str):
    model = planted(kind)
    found = structure(model, measure(model, 600))
    assert found.name == kind, str(found)
    assert str(found).startswith(kind)


def test_branches_are_found():
    """Each V z is a signal that one branch of the map sees."""
    model = planted("parallel")
    record = measure(model, 600)
    found = structure(model, record)
    cell = model.lfr.cell
    assert isinstance(cell.static, Network)
    z = model.signals(record).z[0].numpy()
    seen = z @ canonical(model, record).Z.T @ found.V.T
    neurons = z @ cell.static.Wz.detach().numpy()[[0, 3]].T
    match = np.abs(np.corrcoef(seen.T, neurons.T)[:2, 2:])
    np.testing.assert_allclose(np.sort(match.max(axis=0)), 1.0, atol=1e-3)
    assert found.coupling < 0.01
