"""The system of python-control, and the code that makes one, beside the model."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from exported import MODELS, check_output, check_rest, check_run, check_step, inputs, jacobians

from lfrtorch.data.records import Channel
from lfrtorch.export import control_system, python_source, write

control = pytest.importorskip(
    "control", reason="control comes with the extra: pip install -e '.[control]'"
)


@pytest.mark.numeric
@pytest.mark.parametrize("name", MODELS)
def test_steps_are_those_of_the_model(name: str):
    made: dict[str, Any] = {}
    exec(python_source(MODELS[name], name), made)
    check_step(made["step"], MODELS[name])
    check_run(made["step"], MODELS[name])
    check_rest(made["x_rest"], MODELS[name])


@pytest.mark.numeric
@pytest.mark.parametrize("name", ["softplus", "polynomial"])
def test_the_system_simulates(name: str):
    model, system = MODELS[name], control_system(MODELS[name], name)
    assert isinstance(system, control.NonlinearIOSystem)
    u = inputs(model, 200)
    response = control.input_output_response(system, np.arange(200) / model.fs, u.T)
    check_output(response.outputs.T, model, u)
    assert (system.name, system.dt, system.nstates) == (name, 0.01, model.lfr.cell.nx)


def test_another_number_of_inputs_or_states_is_refused():
    made: dict[str, Any] = {}
    exec(python_source(MODELS["polynomial"]), made)
    x, u = np.zeros(2), np.ones(2)
    for wrong in (3.0, np.ones(3), np.ones((2, 1))):
        with pytest.raises(ValueError, match=r"u has the shape \(.*\); give \(2,\)"):
            made["step"](x, wrong)
    with pytest.raises(ValueError, match=r"x has the shape \(1,\); give \(2,\)"):
        made["step"](0.0, u)
    exec(python_source(MODELS["smallest"]), made)
    assert made["step"](0.0, 1.0)[1].shape == (1,)  # a number is a vector of one


def test_channels_whose_labels_would_be_one_have_two():
    model = MODELS["polynomial"]
    named = replace(model, inputs=(Channel("a.b"), Channel("a_b")))
    system = control_system(named)
    assert system.input_labels == ["a_b", "a_b_"]
    u = inputs(model, 50)
    response = control.input_output_response(system, np.arange(50) / model.fs, u.T)
    check_output(response.outputs.T, model, u)


def test_the_file_stands_alone(tmp_path: Path):
    """It is imported without lfrtorch, and odd channel names are no code."""
    model = MODELS["smallest"]
    odd = (Channel('a.b"""\n', "'°"),)
    (path,) = write(replace(model, inputs=odd), "control", tmp_path, name="it")
    code = "import sys, it; s = it.system(); print(s.input_labels, 'lfrtorch' in sys.modules)"
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=path.parent, capture_output=True, text=True, check=False)
    assert done.stderr == ""
    assert done.stdout == '[\'a_b"""\\n\'] False\n'


@pytest.mark.numeric
def test_the_code_of_the_guide_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    model = MODELS["smallest"]
    write(model, "control", tmp_path, name="engine")
    monkeypatch.syspath_prepend(tmp_path)
    guide = Path(__file__).resolve().parents[2] / "docs" / "guide" / "export.md"
    section = guide.read_text(encoding="utf-8").split("## python-control")[1]
    known: dict[str, Any] = {}
    exec(section.split("```python\n")[1].split("```")[0], known)
    sys.modules.pop("engine")
    check_output(known["response"].outputs[:, None], model, np.sin(known["t"])[:, None])
    at = known["response"].states[:, -1], np.array([0.5])
    matrices = [getattr(known["here"], letter) for letter in "ABCD"]
    for found, expected in zip(matrices, jacobians(model, *at), strict=True):
        assert np.allclose(found, expected, rtol=1e-4, atol=1e-5)  # finite differences of 1e-6
