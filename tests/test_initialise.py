"""Both starts are exactly the linear model, with the weights drawn as documented."""

from typing import Any, Literal

import numpy as np
import pytest
import reference
import torch
from reference import random_system

from lfrtorch.bla import LinearModel, estimate_bla
from lfrtorch.initialise import OUTPUT_RANGE, initialise
from lfrtorch.model import Model
from lfrtorch.nonlinearity import Network
from lfrtorch.records import Record
from lfrtorch.residual import SimulationError

METHODS: tuple[Literal["paper", "zero_output"], ...] = ("paper", "zero_output")
SIZES: dict[str, Any] = {"nz": 2, "nw": 3, "nn": 4}


def some_records() -> list[Record]:
    """Linear data with offsets, one record in steady state and one from rest."""
    system, generator = random_system(3, 2, 2), np.random.default_rng(0)
    steady, rest = generator.normal(size=(200, 2)), generator.normal(size=(150, 2))
    return [
        Record(
            3 * steady + 2, reference.periodic_response(system, 3 * steady) - 5, 9.0, "periodic"
        ),
        Record(3 * rest + 2, reference.dlsim(system, 3 * rest) - 5, 9.0),
    ]


RECORDS = some_records()


@pytest.fixture(scope="module")
def bla() -> LinearModel:
    return estimate_bla(RECORDS, 3)


def network(model: Model) -> Network:
    assert isinstance(model.lfr.cell.static, Network)
    return model.lfr.cell.static


@pytest.mark.parametrize("method", METHODS)
def test_start_is_the_linear_model(bla: LinearModel, method):
    model = initialise(bla, RECORDS, **SIZES, method=method)
    for record in (*RECORDS, RECORDS[0][50:120]):
        expected = bla.simulate(record)
        # Equal but for rounding in other units and coordinates, and the periodic start.
        tolerance = 1e-12 if record.start == "zero" else 1e-9
        np.testing.assert_allclose(
            model.simulate(record), expected, rtol=0, atol=tolerance * np.abs(expected).max()
        )
    assert (model.fs, model.inputs, model.outputs) == (bla.fs, bla.inputs, bla.outputs)


@pytest.mark.parametrize("method", METHODS)
def test_poles_are_those_of_the_linear_model(bla: LinearModel, method):
    A = initialise(bla, RECORDS, **SIZES, method=method).lfr.cell.A.detach().numpy()
    np.testing.assert_allclose(np.poly(A), np.poly(bla.A), rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("method", METHODS)
def test_signals_have_unit_deviation(bla: LinearModel, method):
    T = np.random.default_rng(1).normal(size=(3, 3))  # also from a model in any coordinates
    for start in (bla, bla.transformed(T)):
        model = initialise(start, RECORDS, **SIZES, method=method)
        problem = SimulationError(model, RECORDS)
        trajectories = problem.trajectories(problem.theta)
        x = torch.cat([t.x[:, :-1].flatten(0, 1) for t in trajectories])
        z = torch.cat([t.z.flatten(0, 1) for t in trajectories])
        u = torch.cat([batch.u.flatten(0, 1) for batch in problem.batches])
        y = torch.cat([batch.y.flatten(0, 1) for batch in problem.batches])
        for signal in (x, z):
            np.testing.assert_allclose(signal.std(dim=0, correction=0).numpy(), 1, rtol=1e-8)
        for signal in (u, y):  # about the operating point, which need not be the mean
            np.testing.assert_allclose(signal.square().mean(dim=0).sqrt().numpy(), 1, rtol=1e-12)


def test_weights_of_the_paper(bla: LinearModel):
    model = initialise(bla, RECORDS, **SIZES, method="paper")
    cell, static = model.lfr.cell, network(model)
    assert not cell.Bw.any()
    assert not cell.Dyw.any()
    assert static.Ww.all()
    for weight in (static.Wz, static.bz, static.Ww):
        assert weight.abs().max() <= 1
    assert not static.bw.any()


def test_weights_of_the_zero_output(bla: LinearModel):
    model = initialise(bla, RECORDS, **SIZES, method="zero_output")
    cell, static = model.lfr.cell, network(model)
    assert not static.Ww.any()
    assert not static.bw.any()
    for weight in (cell.Bw, cell.Dyw):
        assert weight.all()
        assert weight.abs().max() <= OUTPUT_RANGE
    for weight in (static.Wz, static.bz):
        assert weight.all()
        assert weight.abs().max() <= 1


def test_zero_output_is_the_default(bla: LinearModel):
    assert not network(initialise(bla, RECORDS, **SIZES)).Ww.any()


@pytest.mark.parametrize("method", METHODS)
def test_same_seed_same_bits(bla: LinearModel, method):
    torch.manual_seed(0)
    first = initialise(bla, RECORDS, **SIZES, method=method, seed=1)
    torch.manual_seed(1)  # the global generator has no part in it
    again = initialise(bla, RECORDS, **SIZES, method=method, seed=1)
    other = initialise(bla, RECORDS, **SIZES, method=method, seed=2)
    for name, weight in first.lfr.state_dict().items():
        assert torch.equal(weight, again.lfr.state_dict()[name])
    for name in ("cell.Cz", "cell.Dzu", "cell.static.Wz", "cell.static.bz"):
        assert not torch.equal(first.lfr.state_dict()[name], other.lfr.state_dict()[name])


def test_options_reach_the_model(bla: LinearModel):
    model = initialise(bla, RECORDS, **SIZES, activation="relu", dtype=torch.float32)
    assert model.sizes == {"nx": 3, **SIZES}
    assert network(model).activation == "relu"
    assert {p.dtype for p in model.lfr.parameters()} == {torch.float32}


@pytest.mark.parametrize("size", ["nz", "nw", "nn"])
def test_size_below_one(bla: LinearModel, size: str):
    options: dict[str, Any] = SIZES | {size: 0}
    with pytest.raises(ValueError, match=f"{size} is 0; give a whole number of at least 1"):
        initialise(bla, RECORDS, **options)


def test_unknown_method(bla: LinearModel):
    with pytest.raises(ValueError, match="method is 'random'; use 'zero_output' or 'paper'"):
        initialise(bla, RECORDS, **SIZES, method="random")  # pyright: ignore[reportArgumentType]
