"""The C of a model, compiled without a warning and run beside the model."""

from __future__ import annotations

import ctypes
import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from exported import (
    MODELS,
    OBSERVED,
    check_rest,
    check_run,
    check_step,
    inputs,
    jacobians,
    measured_with_gaps,
    some_noise,
)
from reference import measure, random_cell, random_model

from lfrtorch import InputError, NoiseCovariance
from lfrtorch._support.types import Array
from lfrtorch.data.records import Channel
from lfrtorch.export import c_source, python_source, write
from lfrtorch.model.extended_kalman_filter import ExtendedKalmanFilter
from lfrtorch.model.model import Model

GCC = shutil.which("gcc") or shutil.which("cc") or ""
STRICT = ["-std=c99", "-Wall", "-Wextra", "-Wshadow", "-Werror", "-pedantic"]

needs_compiler = pytest.mark.skipif(not GCC, reason="there is no C compiler, gcc or cc")


def compiled(
    folder: Path, models: dict[str, Model], observers: dict[str, Any] | None = None
) -> ctypes.CDLL:
    """A library of several models, some with observers."""
    for name, model in models.items():
        observer = (observers or {}).get(name, False)
        for kind, text in zip("hc", c_source(model, name, observer=observer), strict=True):
            (folder / f"{name}.{kind}").write_text(text)
    sources = [f"{name}.c" for name in models]
    command = [GCC, *STRICT, "-shared", "-fPIC", "-o", "models.so", *sources, "-lm"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    return ctypes.CDLL(str(folder / "models.so"))


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    return compiled(tmp_path_factory.mktemp("c"), MODELS)


@pytest.fixture(scope="module")
def observers(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    models = {f"{kind}_{name}": each for name, each in OBSERVED.items() for kind in ("k", "ekf")}
    chosen = {name: name[0] == "k" or some_noise(each) for name, each in models.items()}
    return compiled(tmp_path_factory.mktemp("observers"), models, chosen)


def call(library: ctypes.CDLL, function: str, *arrays: np.ndarray) -> None:
    getattr(library, function)(*(a.ctypes.data_as(ctypes.c_void_p) for a in arrays))


@needs_compiler
@pytest.mark.numeric
@pytest.mark.parametrize("name", MODELS)
def test_steps_are_those_of_the_model(name: str, library: ctypes.CDLL):
    model = MODELS[name]

    def step(x: Array, u: Array) -> tuple[Array, Array]:
        x_next, y = np.full_like(x, np.nan), np.full(len(model.outputs), np.nan)
        call(library, f"{name}_step", x, u, x_next, y)
        return x_next, y

    check_step(step, model)
    check_run(step, model)


@needs_compiler
@pytest.mark.numeric
@pytest.mark.parametrize("name", MODELS)
def test_jacobians_are_those_of_the_model(name: str, library: ctypes.CDLL):
    model = MODELS[name]
    u, x = inputs(model, 1)[0], np.random.default_rng(4).normal(size=model.lfr.cell.nx)
    expected = jacobians(model, x, u)
    found = [np.full_like(one, np.nan) for one in expected]
    call(library, f"{name}_jacobians", x, u, *found)
    for one, other in zip(found, expected, strict=True):
        assert np.abs(one - other).max() <= 1e-12 * np.abs(other).max()


@needs_compiler
@pytest.mark.numeric
@pytest.mark.parametrize("name", MODELS)
def test_the_state_at_rest_stays(name: str, library: ctypes.CDLL):
    x = np.full(MODELS[name].lfr.cell.nx, np.nan)
    call(library, f"{name}_rest", x)
    check_rest(x, MODELS[name])
    assert (name == "linear") == (not x.any())  # a network's bias moves it from 0


def test_a_model_without_rest_says_so():
    """An integrator that drifts by the bias of the network."""
    model = random_model(random_cell(1, 1, 1, 1, 1, 3))
    with torch.no_grad():
        model.lfr.cell.A.fill_(1.0)
        model.lfr.cell.Cz.zero_()
    assert not any("_rest" in text for text in c_source(model))
    text = python_source(model)
    assert "none at rest" in text
    assert "x_rest" not in text


@needs_compiler
@pytest.mark.numeric
@pytest.mark.parametrize("name", OBSERVED)
@pytest.mark.parametrize("kind", ["k", "ekf"])
@pytest.mark.parametrize("way", ["update", "correct"])
def test_observers_are_those_of_the_model(name: str, kind: str, way: str, observers: ctypes.CDLL):
    """The struct has x, then U with a filter, u and y_hat, and more of its own."""
    model, (u, y) = OBSERVED[name], measured_with_gaps(OBSERVED[name], 200)
    nx, nu, ny = model.lfr.cell.nx, len(model.inputs), len(model.outputs)
    roots = nx * nx if kind == "ekf" else 0
    expected = model.observer(noise=some_noise(model)) if roots else model.observer()
    left = (ny + 2 * nx) ** 2 + nx + 1 if roots else ny
    struct, y_hat = np.full(nx + roots + nu + ny + left, np.nan), np.empty(ny)
    call(observers, f"{kind}_{name}_observer_reset", struct)
    for k, (u_k, y_k) in enumerate(zip(u, y, strict=True)):
        if way == "update":
            call(observers, f"{kind}_{name}_observer_predict", struct, u_k, y_hat)
            call(observers, f"{kind}_{name}_observer_update", struct, y_k)
            np.testing.assert_allclose(y_hat, expected.predict(u_k), rtol=1e-10, atol=1e-10)
            expected.update(y_k)
        elif k % 5 == 4:  # a sample without outputs
            call(observers, f"{kind}_{name}_observer_advance", struct, u_k)
            expected.advance(u_k)
        else:
            call(observers, f"{kind}_{name}_observer_correct", struct, u_k, y_k)
            expected.correct(y_k, u_k)
            np.testing.assert_allclose(struct[:nx], expected.state, rtol=1e-10, atol=1e-10)
            call(observers, f"{kind}_{name}_observer_advance", struct, u_k)
            expected.advance(u_k)
        np.testing.assert_allclose(struct[:nx], expected.state, rtol=1e-10, atol=1e-10)
        if isinstance(expected, ExtendedKalmanFilter):
            U = struct[nx : nx + roots].reshape(nx, nx)
            np.testing.assert_allclose(U @ U.T, expected.covariance, rtol=1e-10, atol=1e-12)


@needs_compiler
@pytest.mark.numeric
def test_the_reach_is_the_square_of_the_surprise(tmp_path: Path):
    model = MODELS["tanh"]
    model = model.reaching(measure(model, 300, seed=1))
    assert model.reach is not None
    library = compiled(tmp_path, {"it": model})
    library.it_reach.restype = ctypes.c_double
    u, x = inputs(model, 1)[0], np.random.default_rng(4).normal(size=model.lfr.cell.nx)
    pointers = (a.ctypes.data_as(ctypes.c_void_p) for a in (x, u))
    v = (u - model.scaler.u_offset) / model.scaler.u_scale
    z = model.lfr.cell.internal(torch.tensor(v), torch.tensor(x))[0].detach().numpy()
    expected = float(model.reach.z.surprise(z)) ** 2
    assert abs(library.it_reach(*pointers) / expected - 1.0) < 1e-9
    assert "in the data" in (tmp_path / "it.h").read_text()
    casadi = pytest.importorskip("casadi")
    write(model, "casadi", tmp_path, name="it")
    reach = casadi.Function.load(str(tmp_path / "it_reach.casadi"))
    assert abs(float(reach(x, u)) / expected - 1.0) < 1e-9
    channels = json.loads((tmp_path / "it_channels.json").read_text())
    assert channels["inputs"][0]["most"] == model.reach.u[0, 1]


@needs_compiler
@pytest.mark.numeric
def test_the_state_may_be_replaced_in_place(library: ctypes.CDLL):
    u, x, y = inputs(MODELS["softplus"], 1)[0], np.array([0.3, -0.2, 0.1, 0.2]), np.empty(3)
    x_next = np.empty(4)
    call(library, "softplus_step", x, u, x_next, y)
    call(library, "softplus_step", x, u, x, y)
    assert np.array_equal(x, x_next)
    call(library, "softplus_reset", x)
    assert not x.any()


@needs_compiler
@pytest.mark.numeric
@pytest.mark.parametrize("name", MODELS)
def test_single_precision_is_that_of_the_model(name: str, tmp_path: Path):
    """Without a double, and with an observer: 1000 samples agree to 1e-4 of the rms."""
    model = MODELS[name]
    noise = some_noise(model)
    for kind, text in zip("hc", c_source(model, "it", observer=noise, single=True), strict=True):
        (tmp_path / f"it.{kind}").write_text(text)
    command = [GCC, *STRICT, "-Wdouble-promotion", "-Wfloat-conversion", "-shared", "-fPIC"]
    done = subprocess.run(
        [*command, "-o", "it.so", "it.c", "-lm"],
        cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    library = ctypes.CDLL(str(tmp_path / "it.so"))
    u = inputs(model, 1000)
    x, y = np.zeros(model.lfr.cell.nx, np.float32), np.zeros((1000, len(model.outputs)), np.float32)
    for u_k, y_k in zip(u.astype(np.float32), y, strict=True):
        call(library, "it_step", x, u_k, x, y_k)
    expected = model.simulate(u)
    assert (np.abs(y - expected).max(axis=0) <= 1e-4 * expected.std(axis=0)).all()


@needs_compiler
@pytest.mark.parametrize("activation", ["sigmoid", "relu", "softplus"])
def test_activations_far_out(activation: str, tmp_path: Path):
    """No overflow, and a number that is none stays visible."""
    model = random_model(random_cell(1, 1, 1, 1, 1, 3, activation=activation))
    library = compiled(tmp_path, {"far": model})
    for x, finite in ((1e6, True), (-1e6, True), (np.nan, False)):
        x_next, y = np.empty(1), np.empty(1)
        call(library, "far_step", np.array([x]), np.zeros(1), x_next, y)
        with torch.no_grad():
            v = -torch.tensor(model.scaler.u_offset / model.scaler.u_scale)
            expected = model.lfr.cell(v, torch.tensor([x], dtype=torch.float64))[1].numpy()
        assert np.allclose(x_next, expected, rtol=1e-12, equal_nan=True)
        assert np.isfinite(y).all() == finite


@needs_compiler
def test_channels_of_any_name_stay_comments(tmp_path: Path):
    model = MODELS["smallest"]
    names = Channel("*/ #error /* ??/", "\\\nµm/°C\u202e"), Channel("y\n", "*/*")
    odd = Model(model.lfr, model.scaler, model.fs, (names[0],), (names[1],))
    compiled(tmp_path, {"odd": odd})
    text = (tmp_path / "odd.h").read_text()
    assert " * u[0]: * / #error / * ? ?/ (\\ µm/°C ), operating point 0.12573\n" in text


def test_the_header_says_what_a_reader_needs():
    header, source = c_source(MODELS["smallest"], "motor_2")
    for text in (
        "#define MOTOR_2_TS 0.0013333333333333333 /* sampling time, s */",
        "#define MOTOR_2_NX 1 ",
        " * motor_2: a nonlinear state-space model in physical units, sampled at 750 Hz,",
        " *     w      = f(z) = Ww tanh(Wz z + bz) + bw",
        " * u[0]: u1 (N), operating point 0.12573",
        " * y[0]: y1 (mm), operating point 0.640",
    ):
        assert text in header
    assert max(map(len, (header + source).splitlines())) <= 100
    assert {line for line in source.splitlines() if "#include" in line} == {
        '#include "motor_2.h"',
        "#include <math.h>",
    }


@pytest.mark.parametrize("name", ["2nd", "a-b", "a b", "", "end", "lambda", "_x", "a__b", "é"])
def test_names_that_are_no_identifiers_are_refused(name: str):
    with pytest.raises(InputError, match="give letters, digits and single underscores"):
        c_source(MODELS["linear"], name)


def test_what_has_no_equations_is_refused():
    own = random_model(random_cell(1, 1, 1, 1, 1, static=torch.nn.Linear(1, 1)))
    with pytest.raises(InputError, match="the static map is a Linear, a class of your own"):
        c_source(own)
    lost = random_model(random_cell())
    with torch.no_grad():
        lost.lfr.cell.A[0, 0] = torch.nan
    with pytest.raises(InputError, match="weights that are not finite"):
        c_source(lost)


@pytest.mark.parametrize(
    ("to", "observer", "said"),
    [
        ("c", True, "no innovation gain K"),
        ("c", NoiseCovariance(Q=1.0, R=0.0), "R is not positive"),
        ("onnx", NoiseCovariance(Q=1.0, R=1.0), "there is no observer for to='onnx'"),
    ],
)
def test_observers_that_cannot_be_are_refused(to: str, observer: Any, said: str, tmp_path: Path):
    with pytest.raises(InputError, match=said):
        write(MODELS["smallest"], to, tmp_path, observer=observer)
    assert list(tmp_path.iterdir()) == []


@needs_compiler
@pytest.mark.numeric
def test_the_program_of_the_guide_simulates(tmp_path: Path):
    guide = Path(__file__).resolve().parents[2] / "docs" / "guide" / "export.md"
    program = guide.read_text(encoding="utf-8").split("```c\n")[1].split("```")[0]
    (tmp_path / "main.c").write_text(program)
    write(MODELS["smallest"], "c", tmp_path, name="engine")
    command = [GCC, *STRICT, "main.c", "engine.c", "-lm", "-o", "run"]
    subprocess.run(command, cwd=tmp_path, check=True)
    printed = subprocess.run([tmp_path / "run"], capture_output=True, text=True, check=True).stdout
    times, y = np.array([line.split() for line in printed.splitlines()], dtype=float).T
    assert np.allclose(times, np.arange(100) / 750.0, rtol=1e-5)
    u = np.repeat([1.0, 0.0], 50)
    assert np.allclose(y, MODELS["smallest"].simulate(u)[:, 0], rtol=0, atol=1e-8)
