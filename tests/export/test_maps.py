"""Every export of every static map computes what the model computes."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from exported import MODELS, Drag, inputs, known_model
from reference import random_cell, random_model
from torch import Tensor

from lfrtorch import InputError
from lfrtorch._support.types import Array
from lfrtorch.export import casadi_function, onnx_models, python_source, write
from lfrtorch.maps.polynomial import Polynomial
from lfrtorch.maps.static_map import StaticMap
from lfrtorch.model.model import Model


class Constant(StaticMap):
    """A map that no z moves, and that has no weights."""

    def __init__(self) -> None:
        super().__init__(1, 1)

    def equations(self, z: Sequence[Any], phi: Sequence[Any]) -> Sequence[Any]:
        """w of z."""
        return [0.25]


class Square(torch.nn.Module):
    """A module of torch, whose equations nobody knows."""

    def forward(self, z: Tensor) -> Tensor:
        return 0.1 * z.square()


def of_static(static: torch.nn.Module, nz: int, nw: int) -> Model:
    return random_model(random_cell(1, 1, 2, nz, nw, static=static, feedback=0.05))


EVERY: dict[str, Model] = {
    **MODELS,
    "known and polynomial": known_model(Polynomial(2, 2, 3, dtype=torch.float64)),
    "known and equations": known_model(Drag()),
    "constant": of_static(Constant(), 1, 1),
}

OF_TORCH = of_static(Square(), 2, 2)


def by_c(model: Model, u: Array, folder: Path) -> Array:
    """The C, compiled."""
    if not (gcc := shutil.which("gcc") or shutil.which("cc")):
        pytest.skip("there is no C compiler, gcc or cc")
    write(model, "c", folder, name="it")
    command = [gcc, "-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-shared", "-fPIC"]
    subprocess.run([*command, "-o", "it.so", "it.c", "-lm"], cwd=folder, check=True)
    step = ctypes.CDLL(str(folder / "it.so")).it_step
    x, y = np.zeros(model.lfr.cell.nx), np.empty((len(u), len(model.outputs)))
    for u_k, y_k in zip(u, y, strict=True):
        step(*(a.ctypes.data_as(ctypes.c_void_p) for a in (x, u_k, x, y_k)))
    return y


def by_casadi(model: Model, u: Array, folder: Path) -> Array:
    """The function, sample by sample."""
    pytest.importorskip("casadi", reason="casadi comes with the extra: pip install -e '.[casadi]'")
    run = casadi_function(model).mapaccum(len(u))
    return np.array(run(np.zeros(model.lfr.cell.nx), u.T)[1]).T


def by_python(model: Model, u: Array, folder: Path) -> Array:
    """The code, sample by sample."""
    made: dict[str, Any] = {}
    exec(python_source(model), made)
    x, y = np.zeros(model.lfr.cell.nx), []
    for u_k in u:
        x, y_k = made["step"](x, u_k)
        y.append(y_k)
    return np.array(y)


def by_onnx(model: Model, u: Array, folder: Path) -> Array:
    """The graph of a simulation."""
    reason = "onnx and onnxruntime come with the extra: pip install -e '.[onnx]'"
    pytest.importorskip("onnx", reason=reason)
    runtime = pytest.importorskip("onnxruntime", reason=reason)
    graph = onnx_models(model)[1].SerializeToString()
    session = runtime.InferenceSession(graph, providers=["CPUExecutionProvider"])
    return session.run(None, {"x0": np.zeros((1, model.lfr.cell.nx)), "u": u[None]})[1][0]


TARGETS: list[Callable[[Model, Array, Path], Array]] = [by_c, by_casadi, by_python, by_onnx]


@pytest.mark.numeric
@pytest.mark.parametrize(
    ("name", "by"),
    [*((name, by) for name in EVERY for by in TARGETS), ("of torch", by_onnx)],
)
def test_an_export_computes_what_the_model_does(name: str, by: Any, tmp_path: Path):
    model = EVERY.get(name, OF_TORCH)
    u = inputs(model, 30)
    expected = model.simulate(u)
    y = by(model, u, tmp_path)
    assert y.shape == expected.shape
    assert np.abs(y - expected).max() <= 1e-12 * np.abs(expected).max()


@pytest.mark.parametrize("by", [by_c, by_casadi, by_python])
def test_a_map_without_equations_goes_to_onnx_alone(by: Any, tmp_path: Path):
    with pytest.raises(InputError, match="a class of your own, whose equations are not known"):
        by(OF_TORCH, inputs(OF_TORCH, 1), tmp_path)


def test_readers_are_told_what_the_map_is(tmp_path: Path):
    write(EVERY["known and equations"], "c", tmp_path, name="it")
    assert "w      = f(z) = [a step of the known model; Drag(z)]" in (tmp_path / "it.h").read_text()
