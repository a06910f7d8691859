"""The start by inference and learning: better than the linear model, on planted systems."""

from collections.abc import Callable
from importlib import import_module
from typing import Any

import numpy as np
import pytest
import torch
from reference import dlsim, random_system
from torch import nn

from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.lfr import LFR
from lfrtorch.engine.nonlinearity import Network, Polynomial
from lfrtorch.fitting.inference import InferenceError, infer, residual_of
from lfrtorch.fitting.starts import initialise
from lfrtorch.linear.bla import estimate_bla
from lfrtorch.linear.model import LinearModel
from lfrtorch.metrics import rmse
from lfrtorch.model import Model
from lfrtorch.records import Channel, Record, Scaler

pytestmark = pytest.mark.numeric

PERIOD = 512
ONE: dict[str, Any] = {"nz": 1, "nw": 1, "nn": 5}


class Saturation(nn.Module):
    """w = a tanh(b z), a user's own map."""

    def __init__(self):
        super().__init__()
        self.a, self.b = (nn.Parameter(torch.ones(())) for _ in range(2))

    def forward(self, z: torch.Tensor) -> torch.Tensor:
        return self.a * torch.tanh(self.b * z)


def wiener_hammerstein() -> LFRCell:
    """u -> second-order filter -> saturation -> first-order filter -> y."""
    cell = LFRCell(1, 1, 3, 1, 1, Saturation(), dtype=torch.float64)
    with torch.no_grad():
        cell.A.copy_(torch.tensor([[0.8, -0.4, 0.0], [0.4, 0.8, 0.0], [0.0, 0.0, 0.6]]))
        cell.Bu.copy_(torch.tensor([[0.8], [0.3], [0.0]]))
        cell.Bw.copy_(torch.tensor([[0.0], [0.0], [1.0]]))
        cell.Cz.copy_(torch.tensor([[0.6, 0.5, 0.0]]))
        cell.Cy.copy_(torch.tensor([[0.0, 0.0, 1.0]]))
    return cell


def feedback() -> LFRCell:
    """A resonance whose spring is nonlinear: w acts back on what it is made of."""
    cell = LFRCell(1, 1, 2, 1, 1, Saturation(), dtype=torch.float64)
    with torch.no_grad():
        cell.A.copy_(torch.tensor([[0.85, 0.35], [-0.35, 0.8]]))
        cell.Bu.copy_(torch.tensor([[0.0], [0.4]]))
        cell.Bw.copy_(torch.tensor([[0.0], [-0.25]]))
        cell.Cz.copy_(torch.tensor([[1.0, 0.0]]))
        cell.Cy.copy_(torch.tensor([[1.0, 0.0]]))
    return cell


SYSTEMS: dict[str, Callable[[], LFRCell]] = {
    "Wiener-Hammerstein": wiener_hammerstein,
    "feedback": feedback,
}


def measured(cell: LFRCell, *, records: int = 2) -> list[Record]:
    """Steady-state records of white inputs, with offsets, and noise far below the nonlinearity."""
    one = np.ones(1)
    scaler = Scaler(2 * one, 3 * one, -5 * one, 0.1 * one)
    model = Model(LFR(cell), scaler, 1.0, (Channel("u"),), (Channel("y"),))
    data = []
    for seed in range(records):
        generator = np.random.default_rng(seed)
        u = 2 + 3 * generator.normal(size=(PERIOD, 1))
        y = model.simulate(u, start="periodic")
        y = y + 1e-4 * np.std(y) * generator.normal(size=y.shape)
        data.append(Record(u, y, 1.0, "periodic"))
    return data


class Own(nn.Module):
    """A user's own map that can take what the linear model already has off a saturation."""

    def __init__(self):
        super().__init__()
        self.c = nn.Parameter(torch.tensor([0.0, 0.3, 1.0]))

    def forward(self, z: torch.Tensor) -> torch.Tensor:
        return self.c[0] + self.c[1] * z + self.c[2] * torch.tanh(z)


@pytest.fixture(scope="module", params=SYSTEMS)
def planted(request: pytest.FixtureRequest) -> tuple[list[Record], LinearModel]:
    cell = SYSTEMS[request.param]()
    data = measured(cell)
    return data, estimate_bla(data, cell.nx)


@pytest.fixture(scope="module")
def spring() -> tuple[list[Record], LinearModel]:
    data = measured(feedback())
    return data, estimate_bla(data, 2)


def error(model: Model | LinearModel, data: list[Record]) -> float:
    return float(np.sqrt(np.mean([rmse(r, model.simulate(r)) ** 2 for r in data])))


@pytest.mark.parametrize("seed", range(2))
def test_start_is_better_than_the_linear_model(planted, seed: int):
    data, bla = planted
    model = infer(bla, data, **ONE, seed=seed)
    assert error(model, data) < 0.7 * error(bla, data)
    cell, plain = model.lfr.cell, initialise(bla, data, **ONE, seed=seed).lfr.cell
    for name in ("A", "Bu", "Cy", "Dyu"):
        assert torch.equal(cell.get_parameter(name), plain.get_parameter(name))


@pytest.mark.parametrize(("nz", "nw"), [(2, 1), (1, 2)])
def test_start_of_other_sizes_is_never_worse(planted, nz: int, nw: int):
    data, bla = planted
    model = infer(bla, data, nz=nz, nw=nw, nn=6)
    assert (model.sizes["nz"], model.sizes["nw"]) == (nz, nw)
    assert error(model, data) < 0.8 * error(bla, data)


def test_start_from_linear_data_is_the_linear_model():
    system = random_system(2, 2, 2)
    u = np.random.default_rng(0).normal(size=(200, 2))
    y = dlsim(system, np.tile(u, (20, 1)))[-400:]
    data = [Record(np.tile(u, (2, 1)), y, 1.0, "periodic", period=200)]
    bla = estimate_bla(data, 2)
    model = infer(bla, data, nz=2, nw=2, nn=4)
    # Rounding errors, of 1e-9 or less, are all there is to explain.
    np.testing.assert_allclose(model.simulate(data[0]), bla.simulate(data[0]), atol=1e-7)


def test_same_seed_same_bits(spring):
    data, bla = spring
    torch.manual_seed(0)
    first = infer(bla, data, **ONE, seed=1)
    torch.manual_seed(1)  # the global generator has no part in it
    again = infer(bla, data, **ONE, seed=1)
    other = infer(bla, data, **ONE, seed=2)
    for name, weight in first.lfr.state_dict().items():
        assert torch.equal(weight, again.lfr.state_dict()[name])
    assert not torch.equal(first.lfr.cell.Cz, other.lfr.cell.Cz)


@pytest.mark.parametrize("static", [Polynomial(1, 1, 3), Own(), Network(1, 1, 4, "rbf")])
def test_given_map_is_fitted(spring, static: nn.Module):
    data, bla = spring
    given = {name: weight.clone() for name, weight in static.state_dict().items()}
    model = infer(bla, data, nz=1, nw=1, static=static)
    assert type(model.lfr.cell.static) is type(static)
    assert error(model, data) < 0.4 * error(bla, data)
    for name, weight in static.state_dict().items():  # the caller's module is left alone
        assert torch.equal(weight, given[name])


def test_options_reach_the_model(spring):
    data, bla = spring
    model = infer(bla, data, **ONE, activation="sigmoid", degree=3, dtype=torch.float32)
    assert isinstance(model.lfr.cell.static, Network)
    assert model.lfr.cell.static.activation == "sigmoid"
    assert {p.dtype for p in model.lfr.parameters()} == {torch.float32}
    assert error(model, data) < 0.8 * error(bla, data)


@pytest.mark.parametrize(
    ("nz", "nw", "ny"),
    [
        (1, 2, 1),
        pytest.param(2, 1, 1, marks=pytest.mark.slow),
        pytest.param(2, 1, 2, marks=pytest.mark.slow),
        (2, 2, 2),
    ],
)
def test_gradient(nz: int, nw: int, ny: int, monkeypatch: pytest.MonkeyPatch):
    """Exact, as r is orthogonal to what Kaufman's approximation leaves out of J."""
    # The damping of β is no part of the cost.
    monkeypatch.setattr(import_module("lfrtorch.fitting.inference"), "CONDITION", 1e-14)
    generator = np.random.default_rng(0)
    u = np.tile(generator.normal(size=(50, 2)), (2, 1))
    y = generator.normal(size=(100, ny))
    data = [Record(u[:50], y[:50], 1.0, "periodic"), Record(u, y, 1.0, "periodic", period=50)]
    bla = estimate_bla(data, 3)
    model = initialise(bla, data, nz=nz, nw=nw, nn=1)
    B, N = generator.normal(size=(3 + ny, nw)), 0.5 * generator.normal(size=(nz, 5))
    residuals = [residual_of(model, record, generator) for record in data]
    problem = InferenceError(residuals, B, N, 3)
    J = problem.linearise(problem.theta)
    assert torch.equal(J.residual, problem.residual(problem.theta))

    gradient, h = 2.0 * J.adjoint(J.residual), 1e-5
    steps = h * torch.eye(len(problem.theta), dtype=torch.float64)

    def cost(theta: torch.Tensor) -> float:
        return problem.cost(problem.residual(theta))

    slope = [(cost(problem.theta + s) - cost(problem.theta - s)) / (2 * h) for s in steps]
    # h² of the central difference, and rounding errors of β where the φ are all but collinear.
    expected = torch.tensor(slope, dtype=torch.float64)
    torch.testing.assert_close(gradient, expected, rtol=0, atol=1e-5 * float(expected.abs().max()))


def test_records_that_are_not_periodic(spring):
    data, bla = spring
    with pytest.raises(ValueError, match=r"start='zero'; inference needs .*init=zero_output"):
        infer(bla, [data[0], data[1][:]], **ONE)


def test_degree_below_one(spring):
    data, bla = spring
    with pytest.raises(ValueError, match="degree is 0; give a whole number of at least 1"):
        infer(bla, data, **ONE, degree=0)


def test_map_without_weights(spring):
    data, bla = spring
    with pytest.raises(ValueError, match="static has no weights that could be fitted"):
        infer(bla, data, nz=1, nw=1, static=nn.Tanh())
