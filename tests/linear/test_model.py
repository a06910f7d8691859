"""The linear model: its signals, responses, zeros and coordinates, and its way to other tools."""

import json
import re
import sys
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import reference
import scipy.linalg
import scipy.signal
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from reference import System, normal, random_cell, random_model, random_system

import lfrtorch
from lfrtorch._support.types import Array
from lfrtorch.data.records import Channel, Record, Scaler
from lfrtorch.engine.lfr import LFR
from lfrtorch.linear.balancing import balancing
from lfrtorch.linear.model import LinearFit, LinearModel
from lfrtorch.linear.resolvent import frequency_response
from lfrtorch.model.model import Model

pytestmark = pytest.mark.numeric

FS = 10.0
OMEGA = np.linspace(0.01, 3.1, 50)
U0, Y0 = np.array([3.0, -1.0]), np.array([-7.0, 20.0])


def of_system(system: System, **fields) -> LinearModel:
    """The model of deviations from U0 and Y0."""
    ny, nu = system[3].shape
    inputs = tuple(Channel(f"u{i + 1}", "N") for i in range(nu))
    outputs = tuple(Channel(f"y{i + 1}", "mm") for i in range(ny))
    return LinearModel(*system, FS, np.resize(U0, nu), np.resize(Y0, ny), inputs, outputs, **fields)


def system_of(model: LinearModel) -> System:
    return model.A, model.B, model.C, model.D


def some_covariance(P: int) -> Array:
    root = np.random.default_rng(7).normal(size=(P, P))
    return 1e-6 * root @ root.T


@pytest.fixture
def model() -> LinearModel:
    return of_system(random_system(3, 2, 2))


@pytest.fixture
def observed(model: LinearModel) -> LinearModel:
    """With everything that is known of innovations and uncertainty."""
    A, C = model.A, model.C
    S = np.array([[0.5, 0.2], [0.2, 0.4]])
    P = scipy.linalg.solve_discrete_are(A.T, C.T, np.eye(3), S)
    K = A @ P @ C.T @ np.linalg.inv(C @ P @ C.T + S)  # A - K C is stable
    covariance = some_covariance((3 + 2) * (3 + 2))
    return replace(model, K=K, innovation_covariance=S, covariance=covariance)


def some_input(T: int = 300) -> Array:
    return np.random.default_rng(5).normal(size=(T, 2))


# --- simulation -----------------------------------------------------------------------------


def test_simulation_from_zero_is_dlsim(model: LinearModel):
    u = some_input()
    record = Record(u + U0, u, FS)
    expected = reference.dlsim(system_of(model), u) + Y0
    np.testing.assert_allclose(model.simulate(record), expected, rtol=0, atol=1e-10)


def test_periodic_simulation_is_the_response_in_frequency(model: LinearModel):
    u = some_input()
    record = Record(u + U0, u, FS, "periodic")
    expected = reference.periodic_response(system_of(model), u) + Y0
    np.testing.assert_allclose(model.simulate(record), expected, rtol=0, atol=1e-8)


def test_simulation_from_the_state_that_fits_best(model: LinearModel):
    """A given start state is in other coordinates, so that it is estimated, too."""
    u = some_input()
    y = reference.dlsim(system_of(model), u) + Y0
    some = Record(u[200:] + U0, y[200:], FS, "estimated")
    for record in (some, replace(some, start="given", x0=np.ones(3))):
        # Least squares for three numbers, and the recursion: rounding times |y| = 30.
        np.testing.assert_allclose(model.simulate(record), record.y, rtol=0, atol=1e-10)


# --- prediction -----------------------------------------------------------------------------


def innovation_model(model: LinearModel, u: Array, e: Array) -> Array:
    """x+ = A x + B u + K e, y = C x + D u + e, in deviations, from zero."""
    assert model.K is not None
    x, y = np.zeros(model.nx), []
    for u_k, e_k in zip(u, e, strict=True):
        y.append(model.C @ x + model.D @ u_k + e_k)
        x = model.A @ x + model.B @ u_k + model.K @ e_k
    return np.array(y)


def test_prediction_error_of_the_true_model_is_the_innovation(observed: LinearModel):
    u, e = some_input(), normal(300, 2, seed=6).numpy()
    record = Record(u + U0, innovation_model(observed, u, e) + Y0, FS)
    # The predictor is stable: rounding errors of signals of size 30 do not grow.
    np.testing.assert_allclose(record.y - observed.predict(record), e, rtol=0, atol=1e-11)


def test_prediction_is_its_recursion_on_any_data(observed: LinearModel):
    """The state takes in what the output was, after the output was predicted."""
    assert observed.K is not None
    u, y = some_input(), normal(300, 2, seed=8).numpy()
    x, expected = np.zeros(3), []
    for u_k, y_k in zip(u, y, strict=True):
        expected.append(observed.C @ x + observed.D @ u_k)
        x = observed.A @ x + observed.B @ u_k + observed.K @ (y_k - expected[-1])
    found = observed.predict(Record(u + U0, y + Y0, FS))
    np.testing.assert_allclose(found, expected + Y0, rtol=0, atol=1e-11)


def test_prediction_needs_a_gain(model: LinearModel):
    u = some_input()
    with pytest.raises(ValueError, match="no innovation gain K"):
        model.predict(Record(u, u, FS))


def test_prediction_needs_the_channels_of_the_model(observed: LinearModel):
    u = some_input()
    with pytest.raises(ValueError, match=r"has 1 input\(s\), but the model has 2"):
        observed.predict(Record(u[:, :1], u, FS))
    with pytest.raises(ValueError, match=r"has 1 output\(s\), but the model has 2"):
        observed.predict(Record(u, u[:, 0], FS))


# --- the response and its deviation ---------------------------------------------------------


def test_frequency_response_is_its_formula(model: LinearModel):
    G = model.frf(OMEGA * FS / 2 / np.pi)
    assert G.shape == (50, 2, 2)
    np.testing.assert_allclose(G, reference.frf(system_of(model), OMEGA), rtol=0, atol=1e-12)


def perturbed(model: LinearModel, d_theta: Array) -> System:
    A, B, C, D = system_of(model)
    parts = np.split(d_theta, np.cumsum([A.size, B.size, C.size]))
    matrices = zip((A, B, C, D), parts, strict=True)
    a, b, c, d = (M + part.reshape(M.shape) for M, part in matrices)
    return a, b, c, d


def test_deviation_of_the_response_is_that_of_its_linear_part():
    """By central differences, for other numbers of inputs than outputs."""
    P = (3 + 1) * (3 + 2)
    model = of_system(random_system(3, 2, 1), covariance=some_covariance(P))
    assert model.covariance is not None
    z, h = np.exp(1j * OMEGA), 1e-6
    J = np.stack(
        [
            frequency_response(*perturbed(model, h * step), z)
            - frequency_response(*perturbed(model, -h * step), z)
            for step in np.eye(P)
        ],
        axis=-1,
    ) / (2 * h)
    variance = np.einsum("foip,pq,foiq->foi", J, model.covariance, J.conj()).real
    found = model.frf_std(OMEGA * FS / 2 / np.pi)
    assert found.shape == (50, 1, 2)
    # h² times a third derivative of up to gain⁴ = 1e4, and eps / h: 1e-8.
    np.testing.assert_allclose(found, np.sqrt(variance), rtol=1e-7)


def test_deviation_needs_a_covariance(model: LinearModel):
    with pytest.raises(ValueError, match="the covariance of this model is not known"):
        model.frf_std([1.0])


# --- poles and zeros ------------------------------------------------------------------------


def ordered(values) -> Array:
    return np.sort_complex(np.asarray(values, dtype=complex))


@pytest.mark.parametrize("nx", [1, 2, 3, 6])
def test_zeros_of_one_channel_are_scipy_s(nx: int):
    system = random_system(nx)
    expected = scipy.signal.ss2zpk(*system)[0]
    # By the polynomial, whose roots are conditioned to 1e4 or so at order 6.
    zeros = of_system(system).zeros()
    np.testing.assert_allclose(ordered(zeros), ordered(expected), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    "zeros", [[], [0.5], [-0.3, 2.5], [0.2 + 0.6j, 0.2 - 0.6j, 1.0], [0.5, -0.3, 2.5, 0.9]]
)
def test_zeros_at_infinity_are_none(zeros: list[complex]):
    """Up to five of them beside the finite ones, in coordinates that hide the structure."""
    poles = [0.9, 0.7, -0.4, 0.3 + 0.5j, 0.3 - 0.5j]
    system = scipy.signal.zpk2ss(zeros, poles, 2.0)
    T = np.random.default_rng(0).normal(size=(5, 5))
    for model in (of_system(system), of_system(system).transformed(T)):
        found = model.zeros()
        assert len(found) == len(zeros)
        # eps times the condition of T and of the companion form: 1e3 each.
        np.testing.assert_allclose(ordered(found), ordered(zeros), rtol=0, atol=1e-9)


@pytest.mark.parametrize("nx", [1, 2, 5, 8])
def test_delay_has_no_zeros(nx: int):
    delay = of_system((np.eye(nx, k=-1), np.eye(nx, 1), np.eye(1, nx, nx - 1), np.zeros((1, 1))))
    assert len(delay.zeros()) == 0
    rotation = scipy.linalg.qr(np.random.default_rng(nx).normal(size=(nx, nx)))[0]
    assert len(delay.transformed(rotation).zeros()) == 0


@pytest.mark.parametrize(("direct", "count"), [(1.0, 5), (0.0, 3)])
def test_response_is_singular_at_transmission_zeros(direct: float, count: int):
    A, B, C, D = random_system(5, 2, 2)
    model = of_system((A, B, C, direct * D))
    zeros = model.zeros()
    assert len(zeros) == count  # without direct term two are at infinity
    for G in frequency_response(*system_of(model), zeros):
        s = np.linalg.svd(G, compute_uv=False)
        # eps times the condition of the zeros.
        assert s[1] < 1e-10 * s[0]


exponents = st.lists(st.floats(-12.0, 12.0), min_size=3, max_size=3)


@given(
    nx=st.integers(1, 5), n=st.integers(1, 3), direct=st.booleans(), by_u=exponents, by_y=exponents
)
@example(nx=1, n=1, direct=True, by_u=[12.0] * 3, by_y=[0.0] * 3)  # its zero counted as infinite
@settings(max_examples=40)
def test_zeros_in_other_units_are_the_same(
    nx: int, n: int, direct: bool, by_u: list[float], by_y: list[float]
):
    A, B, C, D = random_system(nx, n, n)
    zeros = of_system((A, B, C, direct * D)).zeros()
    u, y = 10.0 ** np.array(by_u[:n]), 10.0 ** np.array(by_y[:n])[:, None]
    scaled = of_system((A, B * u, y * C, direct * y * D * u)).zeros()
    assert len(scaled) == len(zeros)
    for zero in zeros:  # eps times their condition, 1e4 for some of these systems
        assert np.abs(scaled - zero).min() < 1e-9 * (1.0 + abs(zero))


def test_zeros_of_the_channels():
    A, B, C, D = random_system(4, 2, 3)
    model = of_system((A, B, C, D))
    for o in range(3):
        for i in range(2):
            expected = ordered(scipy.signal.ss2zpk(A, B[:, [i]], C[[o]], D[[o]][:, [i]])[0])
            np.testing.assert_allclose(ordered(model.zeros(o, i)), expected, rtol=1e-9, atol=1e-9)


def test_zeros_of_one_output_or_input():
    """The other side is left whole: a square model if it has one channel."""
    A, B, C, D = random_system(3, 1, 2)
    model = of_system((A, B, C, D))
    np.testing.assert_allclose(ordered(model.zeros(1)), ordered(model.zeros(1, 0)))
    with pytest.raises(ValueError, match=r"1 input\(s\) and 2 output\(s\)"):
        model.zeros(input=0)


def test_outputs_that_are_alike_or_zero_have_no_zeros():
    """The response is singular everywhere, nowhere more than elsewhere."""
    A, B, C, D = random_system(3, 2, 1)
    for factor in (2, 0):
        C, D = factor * C, factor * D
        alike = of_system((A, B, np.vstack([C, 2 * C]), np.vstack([D, 2 * D])))
        assert len(alike.zeros()) == 0
    assert len(of_system((A, B[:, :1], C, D[:, :1])).zeros()) == 0


def test_zeros_of_a_model_that_is_not_square():
    message = "a model of 2 input(s) and 1 output(s) has no transmission zeros in general; ask for"
    with pytest.raises(ValueError, match=re.escape(message)):
        of_system(random_system(3, 2, 1)).zeros()


# --- coordinates ----------------------------------------------------------------------------


def test_transformed_model_is_the_same_system(model: LinearModel):
    T = np.random.default_rng(3).normal(size=(3, 3))
    other = model.transformed(T)
    np.testing.assert_allclose(other.A @ T, T @ model.A, rtol=0, atol=1e-12)
    np.testing.assert_allclose(other.frf(OMEGA), model.frf(OMEGA), rtol=0, atol=1e-9)


def test_transformed_model_predicts_and_deviates_alike(observed: LinearModel):
    T = np.random.default_rng(3).normal(size=(3, 3))
    u, y = some_input(), normal(300, 2, seed=8).numpy()
    for inverse in (None, np.asarray(np.linalg.inv(T), dtype=np.float64)):
        other = observed.transformed(T) if inverse is None else observed.transformed(T, inverse)
        assert observed.K is not None
        np.testing.assert_array_equal(other.K, T @ observed.K)
        record = Record(u, y, FS)
        np.testing.assert_allclose(other.predict(record), observed.predict(record), atol=1e-9)
        np.testing.assert_allclose(other.frf_std(OMEGA), observed.frf_std(OMEGA), rtol=1e-9)
        assert other.innovation_covariance is observed.innovation_covariance


def test_covariance_moves_with_the_entries(observed: LinearModel):
    """A small change of all entries, transformed, is the change that the covariance is made of."""
    T = np.random.default_rng(3).normal(size=(3, 3))
    d = np.random.default_rng(4).normal(size=25)
    single = replace(observed, covariance=np.outer(d, d)).transformed(T)
    moved = of_system(perturbed(observed, d)).transformed(T)
    before = observed.transformed(T)  # entries are linear in the given ones
    pairs = zip(system_of(moved), system_of(before), strict=True)
    change = np.concatenate([(a - b).ravel() for a, b in pairs])
    assert single.covariance is not None
    np.testing.assert_allclose(single.covariance, np.outer(change, change), rtol=0, atol=1e-9)


def gramians(A: Array, B: Array, C: Array) -> tuple[Array, Array]:
    return (
        scipy.linalg.solve_discrete_lyapunov(A, B @ B.T),
        scipy.linalg.solve_discrete_lyapunov(A.T, C.T @ C),
    )


@pytest.mark.parametrize(("nx", "nu", "ny"), [(1, 1, 1), (4, 1, 1), (5, 2, 3)])
def test_balanced_gramians_are_diagonal_and_equal(nx: int, nu: int, ny: int):
    A, B, C, _ = random_system(nx, nu, ny)
    T, inverse = balancing(A, B, C)
    P, Q = gramians(A, B, C)
    hankel = np.sqrt(np.sort(np.linalg.eigvals(P @ Q).real)[::-1])
    # eps times the condition of T, squared: the ratio of Hankel singular values, 1e3.
    close = {"rtol": 0, "atol": 1e-9 * hankel[0]}
    np.testing.assert_allclose(T @ inverse, np.eye(nx), rtol=0, atol=1e-9)
    np.testing.assert_allclose(T @ P @ T.T, np.diag(hankel), **close)
    np.testing.assert_allclose(inverse.T @ Q @ inverse, np.diag(hankel), **close)


def test_balancing_close_to_the_unit_circle():
    """Two integrators all but: the sum of the Gramian's terms has 1e7 of them and is finite."""
    A = np.diag([1 - 1e-6, 1 - 2e-6, 0.5])
    B, C = np.ones((3, 1)), np.array([[1.0, -1.0, 1.0]])
    T, inverse = balancing(A, B, C)
    assert np.isfinite(T).all()
    G = reference.frf((T @ A @ inverse, T @ B, C @ inverse, np.zeros((1, 1))), OMEGA)
    expected = reference.frf((A, B, C, np.zeros((1, 1))), OMEGA)
    # eps times Gramians of 1e6, of which the two states that are all but alike keep the root.
    np.testing.assert_allclose(G, expected, rtol=0, atol=1e-7)


@pytest.mark.parametrize("pole", [1.0, 1.0 + 1e-15, 1.5])
def test_balancing_on_and_beyond_the_unit_circle_changes_nothing(pole: float):
    A, B, C = np.diag([pole, 0.5]), np.ones((2, 1)), np.array([[1.0, 2.0]])
    for matrix in balancing(A, B, C):
        np.testing.assert_array_equal(matrix, np.eye(2))


def test_balancing_states_that_no_input_reaches_changes_nothing():
    A, C = np.diag([0.5, 0.2]), np.ones((1, 2))
    for matrix in balancing(A, np.zeros((2, 1)), C):
        assert np.array_equal(matrix, np.eye(2))


def test_balancing_a_state_that_nothing_reaches_or_sees():
    A, B, C = np.diag([0.5, 0.3, 0.8]), np.array([[1.0], [0.0], [1.0]]), np.array([[1.0, 1.0, 0.0]])
    T, inverse = balancing(A, B, C)
    G = reference.frf((T @ A @ inverse, T @ B, C @ inverse, np.zeros((1, 1))), OMEGA)
    expected = 1 / (np.exp(1j * OMEGA) - 0.5)
    # The floor under the two singular values that vanish is eps: roots of it come back, 1e-8.
    np.testing.assert_allclose(G[:, 0, 0], expected, rtol=0, atol=1e-7)


# --- other homes ----------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_cell_with_the_model_written_into_it(model: LinearModel, dtype: torch.dtype):
    """In the scaler's units; a network beside it stays as it is."""
    cell = random_cell(2, 2, 3, 2, 1, 4, dtype=dtype)
    with torch.no_grad():
        cell.Bw.zero_()
        cell.Dyw.zero_()
    linear = ("A", "Bu", "Cy", "Dyu")
    before = {n: p.clone() for n, p in cell.named_parameters() if n not in linear}
    scaler = Scaler(U0, np.array([0.5, 3.0]), Y0, np.array([2.0, 0.1]))
    model.write(cell, scaler)
    for name, weight in before.items():
        assert torch.equal(cell.get_parameter(name), weight)
        assert cell.get_parameter(name).dtype == dtype
    u = some_input()
    record = Record(u + U0, u, FS, inputs=model.inputs, outputs=model.outputs)
    found = Model(LFR(cell), scaler, FS, model.inputs, model.outputs).simulate(record)
    # Rounding of the weights times a gain of 30.
    atol = 1e5 * torch.finfo(dtype).eps
    np.testing.assert_allclose(found, model.simulate(record), rtol=0, atol=atol)


def test_scipy_simulates_the_deviations(model: LinearModel):
    u = some_input()
    system = model.to_scipy()
    assert system.dt == 1 / FS
    _, y, _ = scipy.signal.dlsim(system, u)
    found = model.simulate(Record(u + U0, u, FS))
    np.testing.assert_allclose(found, y + Y0, rtol=0, atol=1e-10)


def test_control_has_the_same_response_and_names(model: LinearModel):
    pytest.importorskip("control", reason="comes with the extra: pip install -e '.[dev]'")
    inputs = (Channel("force", "N"), Channel("valve.1", "m [rel]"))
    system = replace(model, inputs=inputs).to_control()
    assert system.dt == 1 / FS
    assert system.input_labels == ["force", "valve_1"]  # it allows no dots
    assert system.output_labels == ["y1", "y2"]
    G = np.moveaxis(system(np.exp(1j * OMEGA)), 2, 0)
    np.testing.assert_allclose(G, reference.frf(system_of(model), OMEGA), rtol=0, atol=1e-11)


def test_control_is_not_installed(model: LinearModel, monkeypatch):
    monkeypatch.setitem(sys.modules, "control", None)
    message = "the package control is not installed: pip install 'lfrtorch[control]'."
    with pytest.raises(ValueError, match=re.escape(message)):
        model.to_control()


# --- files ----------------------------------------------------------------------------------

FIT = LinearFit("prediction", 1 / 3, 17, "converged", 0.1 + 0.2, (1.0, 1e-17 / 3), ("a note", "é"))


def same(mine: LinearModel, other: LinearModel):
    for field in fields(LinearModel):
        a, b = getattr(mine, field.name), getattr(other, field.name)
        if isinstance(a, np.ndarray):
            assert a.dtype == b.dtype
            assert np.array_equal(a, b), field.name
        else:
            assert a == b, field.name


def test_bare_input_is_simulated_from_rest(model: LinearModel):
    u = np.random.default_rng(5).normal(size=(50, len(model.inputs)))
    y = np.zeros((50, len(model.outputs)))
    expected = model.simulate(Record(u, y, model.fs))
    assert np.array_equal(model.simulate(u), expected)


def test_response_at_one_frequency(model: LinearModel):
    assert np.array_equal(model.frf(1.0), model.frf([1.0]))
    with pytest.raises(ValueError, match=re.escape("frequencies have shape (1, 2); give one")):
        model.frf([[1.0, 2.0]])


def test_saved_model_is_read_to_the_same_bits(observed: LinearModel, tmp_path: Path):
    # Matrices that are transposed in memory keep their order.
    whole = replace(observed, fit=FIT, fs=10 / 3, A=np.asfortranarray(observed.A))
    same(whole, LinearModel.load(whole.save(tmp_path / "bla")))
    with pytest.raises(AssertionError):
        same(replace(whole, A=whole.A + 1e-16), LinearModel.load(tmp_path / "bla"))


def test_model_of_which_less_is_known_is_read_back(model: LinearModel, tmp_path: Path):
    loaded = LinearModel.load(model.save(tmp_path / "bla"))
    same(model, loaded)
    assert (loaded.K, loaded.covariance, loaded.fit) == (None, None, None)


def test_saved_model_takes_the_place_of_another(
    model: LinearModel, observed: LinearModel, tmp_path: Path
):
    observed.save(tmp_path / "bla")
    same(model, LinearModel.load(model.save(tmp_path / "bla")))


def test_folder_of_a_nonlinear_model(tmp_path: Path):
    folder = random_model(random_cell()).save(tmp_path / "model")
    message = f"'{folder}' holds no linear model; lfrtorch.load reads an NL-LFR."
    with pytest.raises(ValueError, match=re.escape(message)):
        LinearModel.load(folder)


def test_a_linear_model_is_a_model(model: LinearModel, tmp_path: Path):
    loaded = lfrtorch.load(model.save(tmp_path / "bla"))
    u = np.random.default_rng(0).standard_normal((50, len(model.inputs)))
    assert np.array_equal(loaded.simulate(u), model.simulate(u))
    assert loaded.sizes["nz"] == 0
    same(model, LinearModel.of(loaded))


@pytest.mark.parametrize(
    "damage",
    [
        lambda d: d.pop("fs"),
        lambda d: d["linear"].pop("fit"),
        lambda d: d["linear"]["fit"].pop("notes"),
        lambda d: d["linear"]["fit"].update(other=1),
        lambda d: d.update(fs="fast"),
        lambda d: d.pop("inputs"),
        lambda d: d["inputs"].pop(),
        lambda d: d["outputs"].append({"name": "y3", "unit": ""}),
        lambda d: d["outputs"][0].update(colour="red"),
        lambda d: d.update(linear=3),
    ],
)
def test_damaged_description(observed: LinearModel, tmp_path: Path, damage):
    folder = replace(observed, fit=FIT).save(tmp_path / "bla")
    description = json.loads((folder / "model.json").read_text())
    damage(description)
    (folder / "model.json").write_text(json.dumps(description))
    with pytest.raises(ValueError, match="is damaged: its description and weights do not fit"):
        LinearModel.load(folder)


def test_weights_of_another_model(model: LinearModel, tmp_path: Path):
    folder = model.save(tmp_path / "bla")
    for system in (random_system(3, 1, 2), random_system(3, 2, 1)):
        other = of_system(system).save(tmp_path / "other")
        (folder / "weights.safetensors").write_bytes((other / "weights.safetensors").read_bytes())
        with pytest.raises(ValueError, match="is damaged: its description and weights do not fit"):
            LinearModel.load(folder)
    other = random_model(random_cell()).save(tmp_path / "model")
    (folder / "weights.safetensors").write_bytes((other / "weights.safetensors").read_bytes())
    with pytest.raises(ValueError, match="is damaged: its description and weights do not fit"):
        LinearModel.load(folder)


@pytest.mark.parametrize("units", [(1e11, 1e-11), (1e-11, 1e11)])
def test_an_estimated_start_does_not_depend_on_the_units_of_outputs(units):
    rng, zero = np.random.default_rng(0), np.zeros(2)
    u, T = rng.standard_normal((100, 1)), 100
    A, B, outputs = np.diag([0.95, 0.9]), np.array([[0.3], [0.4]]), (Channel("p"), Channel("x"))

    def simulated(scale: np.ndarray) -> np.ndarray:
        rest = (np.zeros((2, 1)), 1.0, np.zeros(1), zero, (Channel("u"),), outputs)
        model = LinearModel(A, B, np.diag(scale), *rest)
        free = np.stack([4.0 * 0.95 ** np.arange(T), 4.0 * 0.9 ** np.arange(T)], axis=1)
        y = np.asarray(free * scale, dtype=np.float64)
        return model.simulate(Record(u, y, start="estimated")) / scale

    np.testing.assert_allclose(simulated(np.array(units)), simulated(np.ones(2)), atol=1e-6)
