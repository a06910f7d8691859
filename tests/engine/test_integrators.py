"""Integrators of the linear model stay exact in a fit: no other state and no z sees their state."""

from typing import Any, Literal

import numpy as np
import pytest
import torch

from lfrtorch.data.metrics import rmse
from lfrtorch.data.records import Record
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.held import held_parameters, integrating_states, integrators
from lfrtorch.fitting.means import mean_model
from lfrtorch.fitting.multistart import fit
from lfrtorch.fitting.starts import initialise
from lfrtorch.least_squares.adam import Adam
from lfrtorch.least_squares.levenberg_marquardt import LevenbergMarquardt
from lfrtorch.linear.bla import estimate_bla
from lfrtorch.maps.network import Network
from lfrtorch.maps.polynomial import Polynomial
from lfrtorch.model.model import Model

pytestmark = pytest.mark.numeric


def axis(integrators: int) -> Record:
    """A mass with friction, or a motor whose speed integrates twice, from rest."""
    u = np.random.default_rng(0).standard_normal(800)
    y = np.zeros((len(u), 1))
    v = s = p = 0.0
    for k, force in enumerate(u):
        y[k] = s if integrators == 1 else p
        v, s, p = 0.8 * v + force - 0.5 * np.tanh(2 * v), s + v, p + s
    return Record(u, y[:, 0], start="estimated")


def started(integrators: Literal[1, 2], **options: Any) -> Model:
    record = axis(integrators)
    bla = estimate_bla(record, integrators + 1, integrators=integrators)
    sizes = {"nz": 1, "nw": 1} | ({} if "static" in options else {"nn": 4})
    return initialise(bla, record, **sizes, **options)


def bits(model: Model, count: int) -> list[bytes]:
    """Of what makes them integrators: ones and zeros."""
    A, Cz = model.lfr.cell.A.detach(), model.lfr.cell.Cz.detach()
    parts = A.diagonal()[-count:], A[:, -count:] != 0, Cz[:, -count:]
    return [part.contiguous().numpy().tobytes() for part in parts]


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize(
    ("options", "trainer"),
    [
        ({}, LevenbergMarquardt(max_iter=15)),
        ({}, LevenbergMarquardt(max_iter=5, least_damping=1e-14, damping=1e-14)),  # by QR
        ({"static": Polynomial(1, 1, 3)}, LevenbergMarquardt(max_iter=5)),
        ({}, Adam(max_iter=20)),
    ],
    ids=["cholesky", "svd", "polynomial", "adam"],
)
def test_a_fit_keeps_them(count, options, trainer):
    record, model = axis(count), started(count, **options)
    before, error = bits(model, count), rmse(record, model.simulate(record))
    fit(model, record, trainer=trainer)
    assert bits(model, count) == before
    assert integrating_states(model.lfr.cell).sum() == count
    assert rmse(record, model.simulate(record)) < error
    assert np.sum(np.abs(np.linalg.eigvals(model.lfr.cell.A.detach()) - 1) < 1e-6) == count


def test_a_position_keeps_its_own_beside_a_speed():
    whole = axis(1)
    speed = np.diff(whole.y[:, 0], append=whole.y[-1:, 0].tolist())
    record = Record(whole.u[:-1], np.column_stack([whole.y[:-1, 0], speed[:-1]]), start="estimated")
    model = initialise(estimate_bla(record, 2, integrators=[1, 0]), record, nz=1, nw=1, nn=4)
    before, error = bits(model, 1), rmse(record, model.simulate(record))
    fit(model, record, trainer=LevenbergMarquardt(max_iter=15))
    assert bits(model, 1) == before
    assert integrating_states(model.lfr.cell).tolist() == [False, True]
    assert rmse(record, model.simulate(record)) < 0.5 * error


def test_a_shift_stays_for_good():
    record, model = axis(1), started(1)
    fit(model, record, trainer=LevenbergMarquardt(max_iter=10))
    u = np.random.default_rng(1).standard_normal(2000)
    at, ahead = (model.simulate(u, start="given", x0=[0.0, shift]) for shift in (0.0, 1.0))
    assert np.allclose(ahead - at, (ahead - at)[0], rtol=1e-6)


@pytest.mark.slow
def test_a_mean_has_those_of_all():
    mean = mean_model([started(1, seed=seed) for seed in range(3)])
    assert integrating_states(mean.lfr.cell).tolist() == 3 * [False, True]


def test_a_state_that_is_seen_integrates_no_more():
    cell = LFRCell(1, 1, 3, 1, 1, Network(1, 1, 2), dtype=torch.float64, random=False)
    cell.hold(integrators(cell))
    assert not held_parameters(cell).any()
    with torch.no_grad():
        cell.A.copy_(torch.tensor([[0.9, 0, 0], [1, 1, 0], [2, 3, 1]]))
    assert integrating_states(cell).tolist() == [False, True, True]
    with torch.no_grad():
        cell.Cz[0, 1] = 1e-9
    assert integrating_states(cell).tolist() == [False, False, True]
    cell.hold(integrators(cell))
    cell.A.requires_grad_(False)
    mask = held_parameters(cell)
    assert len(mask) == sum(p.numel() for p in cell.parameters() if p.requires_grad)
    assert mask.sum() == 1  # of Cz
    with torch.no_grad():
        cell.A[0, 2] = 1e-9
    assert not integrating_states(cell).any()
