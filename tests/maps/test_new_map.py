"""A map that the package has never heard of does all that maps do."""

import ctypes
import shutil
import subprocess
from copy import deepcopy
from pathlib import Path

import numpy as np
import pytest
import torch
from reference import measure, move, random_cell, random_model

import lfrtorch
from lfrtorch._support.types import Array
from lfrtorch.analysis import linearise
from lfrtorch.model.model import Model

pytestmark = pytest.mark.numeric


class Drag(lfrtorch.StaticMap):
    """w = a z |z|."""

    def __init__(self) -> None:
        super().__init__(nz=1, nw=1)
        self.a = torch.nn.Parameter(torch.ones(1))

    def equations(self, z, phi):
        return [phi[0] * z[0] * abs(z[0])]


@pytest.fixture
def model() -> Model:
    return random_model(random_cell(2, 1, 3, static=Drag(), radius=0.6, feedback=0.02))


def test_it_fits_in_machine_code(model: Model):
    cell = model.lfr.cell
    assert cell.map.code is not None
    record = measure(model, 300)
    move(model, 0.05)
    trainer = lfrtorch.LevenbergMarquardt(max_iter=50)
    found = lfrtorch.fit(model, record, trainer=trainer).model
    assert lfrtorch.rmse(record, found.simulate(record)) < 1e-6
    started = lfrtorch.initialise(
        lfrtorch.estimate_bla(record, nx=3), record, nz=1, nw=1, static=Drag()
    )
    assert started.sizes == {"nx": 3, "nz": 1, "nw": 1, "nn": 0}
    assert "static map  Drag()" in str(started)


def test_its_periodic_steady_state_is_where_periods_end(model: Model):
    record = measure(model, 50, start="periodic")
    periods = model.simulate(np.tile(record.u, (30, 1)))
    np.testing.assert_allclose(record.y, periods[-50:], rtol=0, atol=1e-9)


def test_it_is_linearised(model: Model):
    u = model.scaler.u_offset + np.array([0.5, -0.3])
    local, step = linearise(model, u), 1e-6 * np.eye(2)[0]
    ends = [model.simulate(np.tile(u + d, (500, 1)))[-1, 0] for d in (-step, step)]
    gain = local.C @ np.linalg.solve(np.eye(3) - local.A, local.B) + local.D
    assert (ends[1] - ends[0]) / 2e-6 == pytest.approx(gain[0, 0], rel=1e-6)


def test_it_is_saved_and_loaded(model: Model, tmp_path: Path):
    folder, record = model.save(tmp_path / "model"), measure(model, 50)
    with pytest.raises(lfrtorch.InputError, match="class Drag, which is not part of this package"):
        lfrtorch.load(folder)
    again = lfrtorch.load(folder, static=Drag())
    assert np.array_equal(again.simulate(record), record.y)


def test_it_is_averaged_drawn_and_taken_apart(model: Model, tmp_path: Path):
    record = measure(model, 100)
    other = deepcopy(model)
    move(other, 0.02)
    mean = lfrtorch.mean_model([model, other])
    assert mean.lfr.cell.map.code is not None
    expected = (record.y + other.simulate(record)) / 2
    np.testing.assert_allclose(mean.simulate(record), expected, rtol=0, atol=1e-12)
    lfrtorch.analysis.plot(model, record).savefig(tmp_path / "figure.png")
    with pytest.raises(lfrtorch.InputError, match="Drag, which is not known to be bounded"):
        lfrtorch.analysis.bound(model, 1.0)


@pytest.mark.parametrize("target", ["c", "casadi", "onnx"])
def test_it_is_exported(model: Model, target: str, tmp_path: Path):
    u, paths = measure(model, 50).u, lfrtorch.export.write(model, target, tmp_path)
    np.testing.assert_allclose(RUNS[target](paths, u), model.simulate(u), rtol=0, atol=1e-10)


def by_casadi(paths: list[Path], u: Array) -> Array:
    casadi, x, y = pytest.importorskip("casadi"), np.zeros(3), []
    step = casadi.Function.load(str(next(p for p in paths if p.suffix == ".casadi")))
    for u_k in u:
        x, y_k = step(x, u_k)
        y.append(np.array(y_k)[:, 0])
    return np.array(y)


def by_onnx(paths: list[Path], u: Array) -> Array:
    onnxruntime = pytest.importorskip("onnxruntime")
    path = next(p for p in paths if "simulat" in p.name)
    run = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"]).run
    return run(None, {"x0": np.zeros((1, 3)), "u": u[None]})[1][0]


def by_c(paths: list[Path], u: Array) -> Array:
    compiler, folder = shutil.which("cc"), paths[0].parent
    if compiler is None:
        pytest.skip("there is no C compiler, cc")
    source = next(p for p in paths if p.suffix == ".c")
    subprocess.run([compiler, "-shared", "-fPIC", "-o", folder / "m.so", source, "-lm"], check=True)
    step, x, y = ctypes.CDLL(str(folder / "m.so")).model_step, np.zeros(3), np.zeros((len(u), 1))
    after = np.zeros(3)
    for u_k, y_k in zip(u, y, strict=True):
        step(*(a.ctypes.data_as(ctypes.c_void_p) for a in (x, u_k, after, y_k)))
        x[:] = after
    return y


RUNS = {"c": by_c, "casadi": by_casadi, "onnx": by_onnx}
