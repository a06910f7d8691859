"""Fits that stay among models that are proven to contract."""

from dataclasses import replace
from functools import partial
from typing import Any

import pytest
import torch
from reference import measure, normal, polynomial_cell, random_cell, random_model

from lfrtorch import analysis
from lfrtorch.data.records import Record
from lfrtorch.fitting.multistart import fit
from lfrtorch.guarantees.contracting import Contracting, MarginBound
from lfrtorch.least_squares.adam import Adam
from lfrtorch.least_squares.bounded_system import BoundedSystem
from lfrtorch.least_squares.guarantee import guarantee_of
from lfrtorch.least_squares.levenberg_marquardt import LevenbergMarquardt
from lfrtorch.least_squares.linear_systems import CholeskySystem
from lfrtorch.least_squares.problem import Problem
from lfrtorch.maps.network import Network
from lfrtorch.model.model import Model

pytestmark = pytest.mark.numeric


def held(sizes: dict[str, Any]) -> tuple[BoundedSystem, MarginBound, int]:
    """Steps of |δ - free|² from a random model, by the unit matrix, and its parameters."""
    default: dict[str, Any] = {"nx": 3, "feedback": 0.15}
    cell = random_cell(**default | sizes)
    theta = torch.cat([p.detach().flatten() for p in cell.parameters()])
    system = CholeskySystem(torch.eye(len(theta), dtype=theta.dtype), len(theta))
    found = Contracting(cell).bounded(theta, system)
    assert isinstance(found, BoundedSystem)
    assert isinstance(found.bounds, MarginBound)
    return found, found.bounds, len(theta)


@pytest.mark.parametrize("sizes", [{}, {"nz": 2, "nw": 2, "nn": 6}, {"nz": 3, "nw": 3, "nn": 4}])
def test_the_slope_is_that_of_the_margin(sizes: dict[str, Any]):
    _, bound, size = held(sizes)
    step = 1e-5 * normal(size, seed=3)
    change = bound.after(step) - bound.after(-step)
    assert float(-2.0 * bound.slopes[0] @ step) == pytest.approx(change, rel=0.05)


def test_a_step_keeps_a_margin():
    system, bound, size = held({"nz": 2, "nw": 2, "nn": 6})
    slope = bound.slopes[0]
    inside = -0.01 * slope
    assert torch.equal(system.solve(-inside, 0.0), inside)
    for far in (2.0, 20.0):
        beyond = far * slope / slope.norm() + 0.1 * normal(size)
        assert bound.after(beyond) <= 0.0
        step = system.solve(-beyond, 0.0)
        assert bound.after(step) > 0.0
        across = beyond - step  # what the bound takes away is along its slope
        assert float(across @ slope) == pytest.approx(float(across.norm() * slope.norm()))


def bistable() -> tuple[Model, Record]:
    """A contracting start, and data of a model with two states at rest."""
    truth = random_model(random_cell(1, 1, 1, 1, 1, 4, seed=4))
    cell, static = truth.lfr.cell, truth.lfr.cell.static
    assert isinstance(static, Network)
    with torch.no_grad():
        for p in (cell.Dzu, cell.Dyu, cell.Dyw, static.bz, static.bw):
            p.zero_()
        for p in (cell.Cz, cell.Bw, cell.Bu, cell.Cy, static.Wz):
            p.fill_(1.0)
        cell.A.fill_(0.5)
        static.Ww.fill_(0.2)
    record = measure(truth, 200)
    with torch.no_grad():
        static.Ww.copy_(1e-3 * torch.tensor([[1.0, -1.0, 2.0, 0.5]]))
        static.Wz.add_(0.1 * normal(4, 1))
    return truth, record


@pytest.mark.parametrize("trainer", [LevenbergMarquardt(max_iter=8), Adam(20, 8e-2)])
def test_every_model_on_the_way_contracts(trainer):
    found = {}
    for contracting in (True, False):
        model, record = bistable()
        proofs = []

        def watch(model: Model, _, proofs: list[bool] = proofs) -> None:
            Contracting(model.lfr.cell)  # refuses a model without a certificate
            proofs.append(True)

        options = replace(trainer, guarantee="contracting" if contracting else None)
        result = fit(model, record, trainer=options, monitors=[watch] if contracting else [])
        assert result.history[-1].train < 0.8 * result.history[0].train
        assert len(proofs) == (len(result.history) if contracting else 0)
        found[contracting] = analysis.contraction(model).found
    assert found == {True: True, False: False}


def test_what_has_no_certificate_is_not_admitted():
    model, record = bistable()
    problem = Problem.of(
        model, record, guarantee=partial(guarantee_of, "contracting", record.samples)
    )
    theta = problem.theta
    assert problem.admissible(theta) is theta
    problem.linearise(theta)
    far = theta.clone()
    far[0] = 1.5  # A
    admitted = problem.admissible(far)
    assert 0.9 < float(admitted[0]) < 1.0
    admitted = problem.admissible(1e200 * far)  # finite, and its slopes are not
    assert problem.admissible(admitted) is admitted


def test_a_start_without_a_certificate_is_refused():
    model, record = bistable()
    with torch.no_grad():
        model.lfr.cell.A.fill_(1.1)
    with pytest.raises(ValueError, match="needs a start that is proven to contract"):
        Problem.of(model, record, guarantee=partial(guarantee_of, "contracting", record.samples))
    polynomial = random_model(polynomial_cell(1, 1, 2))
    trainer = LevenbergMarquardt(guarantee="contracting")
    with pytest.raises(ValueError, match=r"which a network has, and not a Polynomial"):
        fit(polynomial, measure(polynomial, 50), trainer=trainer)


def test_a_rate_that_is_asked_for_is_kept():
    model, record = bistable()
    for rate in (0.97, 0.8):
        trainer = LevenbergMarquardt(max_iter=6, guarantee=rate)
        result = fit(model, record, trainer=trainer, monitors=[])
        assert result.history[-1].train < result.history[0].train
        Contracting(result.model.lfr.cell, rate)  # refuses a model without a certificate
        with pytest.raises(ValueError, match="that is proven to contract"):
            Contracting(result.model.lfr.cell, 0.4)
        model, record = bistable()
    with pytest.raises(ValueError, match=r"poles within 0\.4"):
        Problem.of(
            model, record, guarantee=partial(guarantee_of, 0.4, record.samples)
        )  # the start has 0.5
    for wrong in (1.0, -0.5, 1):
        with pytest.raises(ValueError, match=r"guarantee is .* a rate above 0 and below 1"):
            LevenbergMarquardt(guarantee=wrong)
