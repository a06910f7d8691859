"""The identified model: gauge invariance, parameter counts, and what simulate refuses."""

import re
from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import reference
import torch
from reference import measure, normal, random_cell, random_model
from torch import Tensor
from torch.testing import assert_close

from lfrtorch._support.tables import UNKNOWN
from lfrtorch.data.metrics import rmse
from lfrtorch.data.records import Channel, Record
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.held import no_feedthrough, structure
from lfrtorch.engine.newton import newton_states
from lfrtorch.engine.sensitivity import Linearisation, output_jacobian
from lfrtorch.engine.simulation import simulate, steady_state
from lfrtorch.least_squares.problem import Problem
from lfrtorch.linear.model import LinearModel
from lfrtorch.maps.network import Network
from lfrtorch.maps.polynomial import Polynomial
from lfrtorch.model.loading import load
from lfrtorch.model.model import Model

pytestmark = pytest.mark.numeric

# --- coordinates that do not matter ---------------------------------------------------------


def state(cell: LFRCell, T: Tensor) -> dict[str, Tensor]:
    """x -> T x."""
    inverse = torch.linalg.inv(T)
    return {
        "A": T @ cell.A @ inverse, "Bu": T @ cell.Bu, "Bw": T @ cell.Bw,
        "Cz": cell.Cz @ inverse, "Cy": cell.Cy @ inverse,
    }  # fmt: skip


def input_of_the_map(cell: LFRCell, T: Tensor) -> dict[str, Tensor]:
    """z -> T z."""
    assert isinstance(cell.static, Network)
    Wz = cell.static.Wz @ torch.linalg.inv(T)
    return {"Cz": T @ cell.Cz, "Dzu": T @ cell.Dzu, "static.Wz": Wz}


def output_of_the_map(cell: LFRCell, T: Tensor) -> dict[str, Tensor]:
    """w -> T w."""
    assert isinstance(cell.static, Network)
    inverse, static = torch.linalg.inv(T), cell.static
    return {
        "Bw": cell.Bw @ inverse, "Dyw": cell.Dyw @ inverse,
        "static.Ww": T @ static.Ww, "static.bw": T @ static.bw,
    }  # fmt: skip


@pytest.mark.parametrize("transform", [state, input_of_the_map, output_of_the_map])
def test_output_does_not_depend_on_coordinates(transform):
    cell = random_cell(2, 2, 3, 3, 3, 4)
    u, zero = normal(1, 100, 2), torch.zeros(1, 3, dtype=torch.float64)
    before = simulate(cell, u, zero).y, steady_state(cell, u).y
    T = normal(3, 3, seed=5)
    with torch.no_grad():
        for name, value in transform(cell, T).items():
            cell.get_parameter(name).copy_(value)
    # eps κ(T)² is about 1e-14; the steady state is known to 1e-10 / (1 - 0.9^100).
    assert_close(simulate(cell, u, zero).y, before[0], rtol=1e-9, atol=1e-9)
    assert_close(steady_state(cell, u).y, before[1], rtol=1e-9, atol=1e-9)


def test_passes_find_the_steady_state_where_newton_fails(monkeypatch: pytest.MonkeyPatch):
    cell = random_cell(nz=2, static=torch.nn.Linear(2, 1, dtype=torch.float64))
    u = normal(2, 40, 1)
    expected = steady_state(cell, u)

    def failing(*args: Any, periodic: bool = False, **options: Any) -> Tensor:
        return torch.nan * expected.x if periodic else newton_states(*args, **options)

    monkeypatch.setattr("lfrtorch.engine.simulation.newton_states", failing)
    assert_close(steady_state(cell, u).y, expected.y, rtol=0, atol=1e-8)  # known to 1e-10


@pytest.mark.parametrize(
    ("nu", "ny", "nx", "nz", "nw", "nn", "degree"),
    [(1, 1, 3, 2, 1, 5, 3), (1, 1, 2, 1, 2, 4, 3), (1, 1, 2, 2, 3, 4, 2), (2, 2, 2, 1, 1, 3, 4)],
)
@pytest.mark.parametrize("polynomial", [False, True])
def test_net_parameters_are_the_rank_of_the_jacobian(polynomial, nu, ny, nx, nz, nw, nn, degree):
    if polynomial:
        cell = random_cell(nu, ny, nx, nz, nw, static=Polynomial(nz, nw, degree))
        cell.get_parameter("static.C").detach().mul_(0.3)
        model = random_model(cell)
        assert model.sizes == {"nx": nx, "nz": nz, "nw": nw, "degree": degree}
    else:
        cell = random_cell(nu, ny, nx, nz, nw, nn)
        model = random_model(cell)
        linear = nx * (nx + nu + nw) + nz * (nx + nu) + ny * (nx + nu + nw)
        assert model.parameter_count == linear + nn * (nz + 1 + nw) + nw
    u = (0.5 if polynomial else 1.0) * normal(1, 200, nu)
    linearisation = Linearisation(cell, u, steady_state(cell, u), periodic=True)
    J = output_jacobian(linearisation).flatten(0, 2)
    s = torch.linalg.svdvals(J / J.norm(dim=0))
    # Directions that are seen have 6e-7 or more, those of the gauge rounding errors of 5e-16.
    assert model.net_parameter_count == int((s > 1e-11 * s[0]).sum())


@pytest.mark.parametrize(
    ("static", "kind", "sizes", "z", "y", "frozen"),
    [
        (Network(1, 2, 4), "free", (1, 2), False, True, 2),
        (Polynomial(1, 2, 3), "free", (1, 2), True, False, 2 + 2),
        (Polynomial(3, 1, 3), "free", (3, 1), False, True, 6),  # 3 combinations of 2 states
        (Network(2, 1, 4), "hammerstein", (2, 1), True, True, 0),  # 2 of 1 input
    ],
)
def test_zeros_that_stay_zeros_are_no_parameters(static, kind, sizes, z, y, frozen):
    nu = 1 if kind == "hammerstein" else 2
    cell = random_cell(nu, 1, 2, *sizes, static=deepcopy(static).double())
    cell.hold(structure(cell, kind))
    with torch.no_grad():
        if isinstance(static, Polynomial):
            cell.get_parameter("static.C").mul_(0.1)
        else:  # neurons that are not alike
            cell.get_parameter("static.Wz").mul_(2.0)
    every = random_model(cell).parameter_count
    cell.hold(no_feedthrough(cell, z=z, y=y))
    model = random_model(cell, fs=1.0)
    assert model.parameter_count == every - frozen
    u = model.scaler.u_offset + model.scaler.u_scale * normal(300, nu).numpy()
    record = Record(u, normal(300, 1).numpy(), start="periodic")
    problem = Problem.of(model, record)
    s = torch.linalg.svdvals(problem.jacobian(problem.theta))
    assert model.net_parameter_count == int((s > 1e-11 * s[0]).sum())


def test_net_parameters_of_a_linear_model():
    model = random_model(random_cell(2, 1, 3, 0, 0))
    assert model.parameter_count == 3 * 3 + 3 * 2 + 3 + 2
    assert model.net_parameter_count == 3 * 2 + 3 + 2
    assert model.sizes == {"nx": 3, "nz": 0, "nw": 0, "nn": 0}


# --- simulation in physical units -----------------------------------------------------------


@pytest.fixture
def model() -> Model:
    return random_model(random_cell(2, 2, 3, 2, 1, 4))


def test_scaling_stands_at_the_two_ends(model: Model):
    u = np.random.default_rng(0).normal(size=(30, 2))
    s = model.scaler
    cell, zero = model.lfr.cell, torch.zeros(1, 3, dtype=torch.float64)
    inside = reference.simulate(cell, torch.tensor((u - s.u_offset) / s.u_scale)[None], zero)
    expected = inside.y[0].numpy() * s.y_scale + s.y_offset
    np.testing.assert_allclose(model.simulate(u), expected, rtol=1e-12, atol=1e-12)


def test_record_is_simulated_from_its_own_start(model: Model):
    for start in ("zero", "periodic"):
        record = measure(model, 40, start=start)
        assert np.array_equal(model.simulate(record), model.simulate(record.u, start=start))
    periodic = measure(model, 40, start="periodic")
    assert not np.allclose(model.simulate(periodic), model.simulate(periodic, start="zero"))


def test_start_state_is_carried(model: Model):
    u = np.random.default_rng(0).normal(size=(30, 2))
    normalised = torch.tensor(model.scaler.normalise_u(u))[None]
    middle = model.lfr.trajectory(normalised).x[0, 20]
    second = model.simulate(u[20:], x0=middle.numpy())
    # eps over the 1 - 0.9 of the contraction, in outputs of order one
    np.testing.assert_allclose(second, model.simulate(u)[20:], rtol=0, atol=1e-12)


def test_one_input_may_be_one_dimensional():
    model = random_model(random_cell())
    u = np.sin(np.arange(20))
    assert np.array_equal(model.simulate(u), model.simulate(u[:, None]))


def test_a_single_sample_is_enough(model: Model):
    assert model.simulate(np.ones((2, 2)))[:1] == pytest.approx(model.simulate(np.ones((1, 2))))


def test_single_precision_model_gives_double_precision_output():
    model = random_model(random_cell(dtype=torch.float32))
    y = model.simulate(np.sin(np.arange(20)))
    assert y.dtype == np.float64
    double = random_model(random_cell()).simulate(np.sin(np.arange(20)))
    np.testing.assert_allclose(y, double, rtol=0, atol=1e-5)  # some eps of single precision


# --- refusals -------------------------------------------------------------------------------


def refused(model: Model, message: str, *data, **options):
    with pytest.raises(ValueError, match=re.escape(message)):
        model.simulate(*data, **options)


def test_number_of_inputs(model: Model):
    refused(model, "input has 1 column(s) and 2 channel(s) are expected (u1, u2)", np.ones(9))
    record = Record(np.ones((9, 3)), np.ones(9), model.fs, name="lab")
    refused(model, "record 'lab' has 3 input(s), but the model has 2 (u1, u2); give a col", record)
    refused(model, "shape ()", 3.0)


def test_sampling_frequency(model: Model):
    record = Record(np.ones((9, 2)), np.ones((9, 2)), 50.0, name="lab")
    refused(model, "record 'lab' is sampled at 50.0 Hz and the model at 100.0 Hz; resam", record)


def test_start_states_that_cannot_be(model: Model):
    u = np.ones((9, 2))
    refused(model, "start is 'steady'", u, start="steady")
    refused(model, "start='given' needs a start state: pass x0", u, start="given")
    refused(model, "start='estimated' needs a record", u, start="estimated")
    refused(model, "x0 has 2 entries; the model has 3.", u, x0=np.zeros(2))
    for x0 in ([np.nan, 0.0, 0.0], np.ma.masked_array(np.zeros(3), mask=[True, False, False])):
        refused(model, "x0 has NaN, infinite or masked entries", u, x0=x0)
    for x0 in ([1j, 0.0, 0.0], "abc"):
        refused(model, "give real numbers", u, x0=x0)


def test_input_that_is_not_finite(model: Model):
    u = np.ones((9, 2))
    u[3, 1] = np.nan
    refused(model, "input 'u2' has 1 NaN, infinite or masked sample(s), the first at index 3", u)


# --- start states ---------------------------------------------------------------------------


def test_record_from_a_given_state(model: Model):
    whole = measure(model, 60)
    state = model.signals(whole).x[0, 20].numpy()
    part = replace(whole[20:], start="given", x0=state)
    np.testing.assert_allclose(model.simulate(part), part.y, rtol=0, atol=1e-12)
    np.testing.assert_allclose(
        model.simulate(part.u, start="given", x0=state), part.y, rtol=0, atol=1e-12
    )


def test_record_from_the_state_that_fits_best(model: Model):
    whole = measure(model, 200)
    part = replace(whole[20:], start="estimated")
    np.testing.assert_allclose(model.simulate(part), part.y, rtol=0, atol=1e-8)


def test_scored_samples_have_no_part_in_the_start(model: Model):
    whole = measure(model, 200)
    part = replace(whole[20:], start="estimated", skip=100)
    other = replace(part, y=np.concatenate([part.y[:100], -part.y[100:]]))
    for record in (part, other):
        np.testing.assert_allclose(model.simulate(record), part.y, rtol=0, atol=1e-8)
    judge = Problem.judge(model, other)
    assert judge.rmse(judge.theta) == pytest.approx(rmse(other, part.y), rel=1e-8)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: {"scaler": replace(m.scaler, u_scale=np.ones(3))}, r"scales of shape \(3,\)"),
        (lambda m: {"scaler": replace(m.scaler, y_scale=-m.scaler.y_scale)}, "scale is not posi"),
        (lambda m: {"outputs": ()}, "the model has 2 outputs, 0 channels"),
        (lambda m: {"K": torch.zeros(3, 7)}, r"K has the shape \(3, 7\); give \(3, "),
        (lambda m: {"fs": 0.0}, "sampling frequency is 0.0; give a positive number"),
    ],
)
def test_parts_of_other_sizes_make_no_model(
    model: Model, change: Callable[[Model], dict[str, Any]], message: str
):
    with pytest.raises(ValueError, match=message):
        replace(model, **change(model))


# --- what print shows ------------------------------------------------------------------------


def test_a_model_is_printed_in_a_few_lines(tmp_path: Path):
    large = random_model(random_cell(nu=5, ny=5, nx=60, nz=6, nw=6, nn=40))
    large = replace(large, fitted_to="lab: 3 record(s), 900 samples")
    shown = str(large).splitlines()
    assert len(shown) <= 25
    assert max(map(len, shown)) <= 110
    for words in ("u1", "6 poles of the largest radius", "first 4 of 25 gains", "lab: 3 record(s)"):
        assert any(words in line for line in shown), words
    assert "\n" not in repr(large)
    large.save(tmp_path / "model")
    assert load(tmp_path / "model").fitted_to == large.fitted_to
    small = random_model(random_cell())
    assert "fitted to" not in str(small)
    small.save(tmp_path / "model")
    assert load(tmp_path / "model").fitted_to == ""


def test_poles_and_gains_are_those_of_a_known_oscillator():
    """5 Hz, 10 % damping, and an output of 4 mm under a constant 2 N."""
    s = 2 * np.pi * 5.0 * complex(-0.1, np.sqrt(1 - 0.01))
    z = np.exp(s / 100.0)
    A = np.array([[z.real, z.imag], [-z.imag, z.real]])
    B = np.array([[1.0], [0.0]])
    C = 2.0 * (np.eye(2) - A)[:1]
    channels = (Channel("force", "N"),), (Channel("x", "mm"),)
    linear = LinearModel(A, B, C, np.zeros((1, 1)), 100.0, np.ones(1), np.zeros(1), *channels)
    for text in (str(linear), str(linear.to_model())):
        lines = text.splitlines()
        row = lines[1 + next(i for i, line in enumerate(lines) if line.startswith("---"))].split()
        assert row[:2] == ["5.000", "0.100"]
        assert lines[-1].split() == ["x", "/", "force", "mm/N", "2.00"]
        assert "force 1.00" in text
    integrator = replace(linear, A=np.eye(2))
    assert str(integrator).endswith(UNKNOWN)
    assert repr(linear) == "LinearModel(force (N) -> x (mm), 100 Hz, nx=2)"


def test_a_model_without_a_rest_says_so():
    cell = LFRCell(1, 1, 1, 1, 1, Polynomial(1, 1, 2), random=False).double()
    assert isinstance(cell.static, Polynomial)
    with torch.no_grad():  # x+ = x + 1 + x²
        for one in (cell.A, cell.Bw, cell.Cz, cell.static.C):
            one.fill_(1.0)
        cell.static.C[0, 1] = 0.0
    shown = str(random_model(cell))
    assert "none found" in shown
    assert "at rest" not in shown
