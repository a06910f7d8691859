"""Both starts are exactly the linear model, with the weights drawn as documented."""

import tracemalloc
from typing import Any, Literal

import numpy as np
import pytest
import reference
import torch
from reference import random_system
from scipy.signal import butter, lfilter
from torch import Tensor, nn

from lfrtorch.data.metrics import rmse
from lfrtorch.data.records import Record
from lfrtorch.fitting import nonlinear_end
from lfrtorch.fitting.means import mean_model
from lfrtorch.fitting.multistart import fit
from lfrtorch.fitting.starts import initialise
from lfrtorch.least_squares.levenberg_marquardt import LevenbergMarquardt
from lfrtorch.least_squares.problem import Problem
from lfrtorch.linear.bla import estimate_bla
from lfrtorch.linear.model import LinearModel
from lfrtorch.maps.network import Network
from lfrtorch.maps.polynomial import Polynomial
from lfrtorch.model.loading import load
from lfrtorch.model.model import Model

pytestmark = pytest.mark.numeric

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


class Shifted(nn.Module):
    """A user's own map from 2 to 3 signals, which does not vanish at zero."""

    def __init__(self):
        super().__init__()
        self.c = nn.Parameter(torch.ones(3, 2))

    def forward(self, z: Tensor) -> Tensor:
        return torch.cos(z) @ self.c.mT


def static_maps() -> dict[str, nn.Module]:
    network, polynomial = Network(2, 3, 5, "relu"), Polynomial(2, 3, 2)
    with torch.no_grad():
        for weight in (network.bw, polynomial.C):
            weight.fill_(0.7)
    return {"network": network, "polynomial": polynomial, "own": Shifted()}


@pytest.fixture(scope="module")
def bla() -> LinearModel:
    return estimate_bla(RECORDS, 3)


def network(model: Model) -> Network:
    assert isinstance(model.lfr.cell.static, Network)
    return model.lfr.cell.static


def check_simulations(model: Model, bla: LinearModel, records: list[Record]) -> None:
    """Equal but for rounding in other units and coordinates, and the periodic start.

    That is eps κ, κ of some hundred.
    """
    for record in records:
        expected = bla.simulate(record)
        tolerance = (1e-11 if record.start == "zero" else 1e-9) * np.abs(expected).max()
        np.testing.assert_allclose(model.simulate(record), expected, rtol=0, atol=tolerance)


@pytest.mark.parametrize("method", METHODS)
def test_start_is_the_linear_model(bla: LinearModel, method):
    model = initialise(bla, RECORDS, **SIZES, method=method)
    check_simulations(model, bla, [*RECORDS, RECORDS[0][50:120]])
    assert (model.fs, model.inputs, model.outputs) == (bla.fs, bla.inputs, bla.outputs)
    # eps κ of the change of coordinates, some hundred
    poles = np.poly(model.lfr.cell.A.detach().numpy())
    np.testing.assert_allclose(poles, np.poly(bla.A), rtol=0, atol=1e-11)


@pytest.mark.parametrize("method", METHODS)
def test_signals_have_unit_deviation(bla: LinearModel, method):
    T = np.random.default_rng(1).normal(size=(3, 3))  # also from a model in any coordinates
    for start in (bla, bla.transformed(T)):
        model = initialise(start, RECORDS, **SIZES, method=method)
        problem = Problem.of(model, RECORDS)
        (trajectories,) = problem.evaluate(problem.theta).seen
        x = torch.cat([t.x[:, :-1].flatten(0, 1) for t in trajectories])
        z = torch.cat([t.z.flatten(0, 1) for t in trajectories])
        u = torch.cat([group.u.flatten(0, 1) for group in problem.errors.groups])
        y = torch.cat([group.y.flatten(0, 1) for group in problem.errors.groups])
        for signal in (x, z):
            np.testing.assert_allclose(signal.std(dim=0, correction=0).numpy(), 1, rtol=1e-8)
        for signal in (u, y):  # about the operating point, which need not be the mean
            # Sums of 350 squares: eps times less than that.
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


def test_weights_of_the_zero_output_which_is_the_default(bla: LinearModel):
    model = initialise(bla, RECORDS, **SIZES)
    cell, static = model.lfr.cell, network(model)
    assert not static.Ww.any()
    assert not static.bw.any()
    for weight in (cell.Bw, cell.Dyw):
        assert weight.all()
        assert weight.abs().max() <= 0.3
    for weight in (static.Wz, static.bz):
        assert weight.all()
        assert weight.abs().max() <= 1


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


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        *(({size: 0}, f"{size} is 0; give a whole number of at le") for size in ("nz", "nw", "nn")),
        ({"nn": None}, "nn is None; give a whole number of at least 1"),  # and no map
        (
            {"method": "random"},
            "method is 'random'; give 'zero_output', 'random_states' or 'paper'",
        ),
        *(
            ({"dtype": dtype}, "dtype is .*; give torch.float64 or torch.float32")
            for dtype in (torch.int64, torch.float16, "float64")
        ),
    ],
)
def test_what_makes_no_model_is_refused(bla: LinearModel, changed: dict[str, Any], message: str):
    with pytest.raises(ValueError, match=message):
        initialise(bla, RECORDS, **SIZES | changed)


# --- a static map of the caller's -----------------------------------------------------------


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("name", ["network", "polynomial", "own"])
def test_start_with_a_given_map_is_the_linear_model(bla: LinearModel, name: str, method):
    static = static_maps()[name]
    given = {key: weight.clone() for key, weight in static.state_dict().items()}
    model = initialise(bla, RECORDS, nz=2, nw=3, static=static, method=method)
    cell = model.lfr.cell
    assert type(cell.static) is type(static)
    assert {p.dtype for p in model.lfr.parameters()} == {torch.float64}
    check_simulations(model, bla, RECORDS)
    # What makes w vanish may move: the map's own output weights, or else Bw and Dyw.
    cleared = {"network": {"Ww", "bw"}, "polynomial": {"C"}, "own": set()}[name]
    cleared = cleared if method == "zero_output" else set()
    for weight in (cell.Bw, cell.Dyw):
        assert bool(weight.all()) == bool(weight.any()) == bool(cleared)
        assert weight.abs().max() <= 0.3
    assert cell.static is not None
    for key, weight in cell.static.state_dict().items():
        expected = torch.zeros_like(weight) if key in cleared else given[key].double()
        assert torch.equal(weight, expected)
    for key, weight in static.state_dict().items():  # the caller's module is left alone
        assert torch.equal(weight, given[key])


@pytest.mark.parametrize("vanishing", [True, False])
def test_an_own_map_without_an_output_is_let_act_on_the_state(bla: LinearModel, vanishing: bool):
    """Else neither its weights nor Bw had a slope: the start would be a saddle."""
    static = Shifted()
    if vanishing:
        nn.init.zeros_(static.c)
    cell = initialise(bla, RECORDS, nz=2, nw=3, static=static).lfr.cell
    for weight in (cell.Bw, cell.Dyw):
        assert bool(weight.all()) == bool(weight.any()) == vanishing


def test_given_map_changes_nothing_else(bla: LinearModel):
    network = initialise(bla, RECORDS, **SIZES).lfr.state_dict()
    own = initialise(bla, RECORDS, nz=2, nw=3, static=Shifted()).lfr.state_dict()
    for name in ("cell.A", "cell.Bu", "cell.Cy", "cell.Dyu"):
        assert torch.equal(network[name], own[name])


@pytest.mark.parametrize("static", [Polynomial(3, 3, 2), Polynomial(2, 1, 2), nn.Linear(3, 3)])
def test_given_map_of_other_sizes(bla: LinearModel, static: nn.Module):
    with pytest.raises(ValueError, match=r"with nz=2 and nw=3 it must give w of shape \(1, 2, 3\)"):
        initialise(bla, RECORDS, nz=2, nw=3, static=static)


# --- a nonlinearity at one end --------------------------------------------------------------


def bent(end: str, samples: int = 500, noise: float = 0.01) -> Record:
    """Two inputs through a filter each, and a bend at the input, the output or in the feedback."""
    generator = np.random.default_rng(3)
    u, x = generator.normal(size=(samples, 2)), np.zeros(2)
    v = u + 0.3 * u**2 if end == "input" else u
    y = np.empty((samples, 2))
    for k in range(samples):
        y[k] = x
        fed_back = np.tanh(x) if end == "feedback" else x
        x = [0.7, 0.5] * fed_back + v[k]
    if end == "output":
        y = np.tanh(y + 0.5)
    return Record(u, y + noise * generator.normal(size=y.shape), skip=20)


@pytest.mark.parametrize(("nz", "nw"), [(1, 2), (2, 2), (3, 1)])
def test_start_where_the_nonlinearity_is(nz: int, nw: int):
    for end in ("input", "output"):
        record = bent(end)
        bla = estimate_bla(record, 2)
        model = initialise(bla, record, nz=nz, nw=nw, nn=3)
        z, y = (signal[0].numpy() for signal in model.signals(record)[1::2])
        source = y if end == "output" else record.u
        for i in range(min(nz, 2)):
            assert abs(np.corrcoef(z[:, i], source[:, i])[0, 1]) > 1 - 1e-9
        cell = model.lfr.cell
        assert bool(cell.Bw.any()) == (end == "input")
        assert cell.Dyw.all()
        np.testing.assert_allclose(model.simulate(record), bla.simulate(record), rtol=0, atol=1e-10)
        usual = initialise(bla, record, nz=nz, nw=nw, nn=3, method="paper").signals(record).z[0]
        assert abs(np.corrcoef(usual[:, 0], source[:, 0])[0, 1]) < 1 - 1e-3


@pytest.mark.parametrize("end", ["input", "output"])
def test_long_record_is_searched_in_part(end: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(nonlinear_end, "SAMPLES", 400)  # a 25th, and both outputs of each sample
    record = bent(end, samples=10_000)
    bla = estimate_bla(record, 2, max_iter=1)
    tracemalloc.start()
    cell = initialise(bla, record, nz=2, nw=1, nn=3).lfr.cell
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert bool(cell.Bw.any()) == (end == "input")
    assert bool(cell.Cz.any()) == (end == "output")
    assert peak < 20 * record.y.nbytes  # the responses to 16 polynomials alone take 16


@pytest.mark.parametrize(
    ("record", "nx"),
    [
        (bent("feedback"), 2),
        (bent("neither"), 2),
        (bent("output", noise=0.3), 2),
        (bent("output", samples=80), 2),
    ],
    ids=["feedback", "linear", "noise", "short"],
)
def test_start_is_random_where_no_end_explains_the_error(record: Record, nx: int):
    cell = initialise(estimate_bla(record, nx), record, nz=2, nw=1, nn=3).lfr.cell
    assert cell.Bw.all()
    assert cell.Cz.all()


@pytest.mark.parametrize("end", ["input", "output"])
def test_every_start_finds_a_nonlinearity_at_one_end(end: str):
    """Of third order at the input and of first order at the output, most random z do not."""
    generator = np.random.default_rng(0)
    u = generator.normal(size=800)
    b, a = butter(3, 0.2) if end == "input" else ([0.0, 1.0], [1.0, -0.7])
    y = lfilter(b, a, u + 0.3 * u**2) if end == "input" else np.tanh(lfilter(b, a, u))
    record = Record(u, y, skip=50)
    bla = estimate_bla(record, len(a) - 1)
    for seed in range(3):
        model = initialise(bla, record, nz=1, nw=1, nn=4, seed=seed)
        found = fit(model, record, trainer=LevenbergMarquardt(max_iter=15))
        assert found.history[-1].train < 0.1 * rmse(record, bla.simulate(record))


@pytest.mark.parametrize("method", METHODS)
def test_a_nonlinearity_of_the_states_alone(method, tmp_path):
    """Dzu is 0 before and after a fit, and saved so; else the start is that of any model."""
    bla = estimate_bla(RECORDS, 3)
    models = [
        initialise(bla, RECORDS, **SIZES, method=method, seed=seed, z_feedthrough=False)
        for seed in range(2)
    ]
    mean = mean_model(models)
    assert np.allclose(models[0].simulate(RECORDS[1]), bla.simulate(RECORDS[1]))
    z = torch.cat([models[0].signals(record).z[0] for record in RECORDS])
    assert torch.allclose(z.std(dim=0, correction=0), torch.ones(2, dtype=z.dtype))
    for model in (models[0], mean, load(models[1].save(tmp_path / "model"))):
        before = model.lfr.cell.Cz.detach().clone()
        fit(model, RECORDS, trainer=LevenbergMarquardt(max_iter=2), monitors=[])
        assert not model.lfr.cell.Dzu.any()
        assert not torch.equal(model.lfr.cell.Cz, before)


@pytest.mark.parametrize("z_feedthrough", [True, False])
@pytest.mark.parametrize("noise", ["output", "innovation"])
def test_without_feedthrough_an_input_acts_later(noise, z_feedthrough, tmp_path):
    """Neither by Dyu nor through w, before and after a fit, and saved so."""
    refine = "simulation" if noise == "output" else "prediction"
    bla = estimate_bla(RECORDS, 3, refine=refine, feedthrough=False, max_iter=5)
    options = {"z_feedthrough": z_feedthrough, "feedthrough": False}
    models = [initialise(bla, RECORDS, **SIZES, seed=seed, **options) for seed in range(2)]
    fresh = [models[0], load(models[1].save(tmp_path / "model"))]
    for model in [*fresh, mean_model(models)][: 2 if noise != "output" else 3]:
        trainer = LevenbergMarquardt(max_iter=2)
        found = fit(model, RECORDS, noise=noise, trainer=trainer, monitors=[]).model
        cell = found.lfr.cell
        assert cell.Bw.any()
        assert not cell.Dyu.any()
        assert bool(cell.Dzu.any()) == z_feedthrough
        assert bool(cell.Dyw.any()) != z_feedthrough
        u = RECORDS[1].u.copy()
        before = found.simulate(u)
        u[-1] += 1.0
        assert np.array_equal(found.simulate(u), before)


def test_a_model_without_feedthrough_from_one_with_is_refused():
    sizes: dict[str, Any] = {"nz": 1, "nw": 1, "nn": 2, "feedthrough": False}
    with pytest.raises(ValueError, match=r"estimate it with estimate_bla\(..., feedthrough=False"):
        initialise(estimate_bla(RECORDS, 3, max_iter=0), RECORDS, **sizes)
    bla = estimate_bla(RECORDS, 3, max_iter=0, feedthrough=False)
    with pytest.raises(ValueError, match="give z_feedthrough=False as well"):
        initialise(bla, RECORDS, **sizes, structure="wiener")


def test_integrators_leave_z_something_to_see():
    u = np.random.default_rng(0).normal(size=300)
    record = Record(u, np.cumsum(u) - u, start="estimated")
    bla = estimate_bla(record, 1, integrators=1)
    assert initialise(bla, record, nz=1, nw=1, nn=2).lfr.cell.Dzu.all()
    with pytest.raises(ValueError, match="all states integrate, which z may not see; raise nx"):
        initialise(bla, record, nz=1, nw=1, nn=2, z_feedthrough=False)
