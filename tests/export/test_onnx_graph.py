"""The ONNX graphs of a model, run by onnxruntime beside the model."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from exported import MODELS, check_output, check_run, check_step, inputs
from reference import random_cell, random_model

from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array
from lfrtorch.export import onnx_models, write

reason = "onnx and onnxruntime come with the extra: pip install -e '.[onnx]'"
onnx = pytest.importorskip("onnx", reason=reason)
onnxruntime = pytest.importorskip("onnxruntime", reason=reason)


def session(model: bytes | str) -> Any:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    return onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])


@pytest.mark.numeric
@pytest.mark.parametrize("name", MODELS)
def test_samples_are_those_of_the_model(name: str):
    sample, simulation = onnx_models(MODELS[name], name)
    for graph in (sample, simulation):
        onnx.checker.check_model(graph, full_check=True)
    run = session(sample.SerializeToString())

    def step(x: Array, u: Array) -> tuple[Array, Array]:
        x_next, y = run.run(None, {"x": x[None], "u": u[None]})
        return x_next[0], y[0]

    check_step(step, MODELS[name])
    check_run(step, MODELS[name])


@pytest.mark.numeric
@pytest.mark.parametrize("name", MODELS)
def test_simulations_are_those_of_the_model(name: str, tmp_path: Path):
    model = MODELS[name]
    sample, simulation = map(session, map(str, write(model, "onnx", tmp_path, name=name)))
    u, nx = inputs(model, 1000), model.lfr.cell.nx
    x0 = np.stack([np.zeros(nx), np.ones(nx)])
    x_end, y = simulation.run(None, {"x0": x0, "u": np.stack([u, u])})
    check_output(y[0], model, u)
    assert np.allclose(y[1], model.simulate(u, start="given", x0=np.ones(nx)), rtol=0, atol=1e-9)
    x = model.signals(u, start="given", x0=np.ones(nx)).x[0, -1]
    assert np.allclose(x_end[1], x, rtol=0, atol=1e-9)
    several = sample.run(None, {"x": x0, "u": u[:2]})
    one = sample.run(None, {"x": x0[1:], "u": u[1:2]})
    assert all(np.allclose(a[1], b[0], rtol=1e-12) for a, b in zip(several, one, strict=True))


class Law(torch.nn.Module):
    """Two laws of one's own, of several layers and branches."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.layers = torch.nn.Sequential(
            torch.nn.Linear(2, 4), torch.nn.Tanh(), torch.nn.Linear(4, 1), torch.nn.Softsign()
        )
        self.b = torch.nn.Parameter(torch.tensor(0.3))

    def forward(self, z: torch.Tensor) -> torch.Tensor:
        first, second = z.unbind(-1)
        dry = torch.where(second.abs() < 1, second**3, second.clamp(min=-1.2, max=0.8).sin())
        return torch.stack([self.layers(z)[..., 0] - self.b * first * first.abs(), dry], dim=-1)


@pytest.mark.numeric
def test_a_map_of_ones_own_is_in_the_graph():
    model = random_model(random_cell(2, 2, 3, 2, 2, static=Law(), feedback=0.05))
    sample, simulation = onnx_models(model)
    for graph in (sample, simulation):
        onnx.checker.check_model(graph, full_check=True)
    assert "w      = f(z) = Law(z)" in sample.doc_string
    u, x0 = inputs(model, 300), np.zeros((2, 3))
    y = session(simulation.SerializeToString()).run(None, {"x0": x0, "u": np.stack([u, u])})[1]
    check_output(y[1], model, u)
    first = session(sample.SerializeToString()).run(None, {"x": x0[:1], "u": u[:1]})[1]
    np.testing.assert_allclose(first, y[0, :1], rtol=1e-12)


class Branches(torch.nn.Linear):
    def forward(self, input: torch.Tensor) -> torch.Tensor:
        return super().forward(input) if input.sum() > 0 else -input


class Unknown(torch.nn.Linear):
    def forward(self, input: torch.Tensor) -> torch.Tensor:
        return torch.special.i0(input)


class Single(torch.nn.Linear):
    """ONNX holds the slope in single precision."""

    def forward(self, input: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.leaky_relu(input, 0.01)


class Drawn(torch.nn.Linear):
    def forward(self, input: torch.Tensor) -> torch.Tensor:
        return input * float(torch.rand(()))


@pytest.mark.parametrize(
    ("static", "why"),
    [
        (Branches, "branches in Python"),
        (Unknown, "aten::i0"),
        (Single, "single precision"),
        (Drawn, "other numbers"),
    ],
)
def test_a_map_that_has_no_graph_is_refused(static: type[torch.nn.Linear], why: str):
    model = random_model(random_cell(1, 1, 1, 1, 1, static=static(1, 1)))
    with pytest.raises(InputError, match=f"(?s)static map {static.__name__}.*{why}"):
        onnx_models(model)


def test_metadata_say_what_the_numbers_are():
    model = MODELS["smallest"]
    for graph in onnx_models(model, "engine"):
        found = {entry.key: json.loads(entry.value) for entry in graph.metadata_props}
        assert (found["name"], found["fs"], found["states"]) == ("engine", 750.0, 1)
        assert found["inputs"] == [{"name": "u1", "unit": "N", "offset": model.scaler.u_offset[0]}]
        assert "y[0]: y1 (mm), operating point" in graph.doc_string


@pytest.mark.numeric
def test_the_simulation_of_the_guide_runs(tmp_path, monkeypatch, capsys):
    write(MODELS["smallest"], "onnx", tmp_path, name="engine")
    monkeypatch.chdir(tmp_path)
    guide = Path(__file__).resolve().parents[2] / "docs" / "guide" / "export.md"
    section = guide.read_text(encoding="utf-8").split("## ONNX")[1]
    known: dict = {}
    exec(section.split("```python\n")[1].split("```")[0], known)
    check_output(known["y"][0], MODELS["smallest"], known["u"][0])
    assert capsys.readouterr().out == "750.0\n"
