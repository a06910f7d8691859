"""The FMU of a model, run by FMPy beside the model."""

from __future__ import annotations

import platform
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from exported import MODELS, check_output, inputs

from lfrtorch import InputError
from lfrtorch._support.types import Array
from lfrtorch.export import write
from lfrtorch.model import Model
from lfrtorch.records import Channel

fmpy = pytest.importorskip("fmpy", reason="fmpy comes with the extra: pip install -e '.[fmu]'")

if (platform.system(), platform.machine()) != ("Linux", "x86_64"):
    pytest.skip("an FMU is compiled on Linux x86_64 alone", allow_module_level=True)
if not any(map(shutil.which, ("gcc", "cc", "clang"))):
    pytest.skip("there is no C compiler", allow_module_level=True)


@contextmanager
def started(path: Path, folder: Path) -> Iterator[tuple[Any, dict[str, int]]]:
    """An instance before its first step, and the value references."""
    found = fmpy.read_model_description(str(path), validate=True)
    fmpy.extract(str(path), unzipdir=str(folder))
    unit = fmpy.fmi2.FMU2Slave(
        guid=found.guid, unzipDirectory=str(folder), instanceName="it",
        modelIdentifier=found.coSimulation.modelIdentifier,
    )  # fmt: skip
    unit.instantiate()
    unit.setupExperiment(startTime=0.0)
    unit.enterInitializationMode()
    unit.exitInitializationMode()
    yield unit, {one.name: one.valueReference for one in found.modelVariables}
    unit.terminate()
    unit.freeInstance()


@pytest.mark.numeric
@pytest.mark.parametrize("name", ["softplus", "polynomial", "linear"])
def test_the_simulation_is_that_of_the_model(name: str, tmp_path: Path):
    model = MODELS[name]
    (path,) = write(model, "fmu", tmp_path, name="engine")
    u, T = inputs(model, 1000), 1.0 / model.fs
    nu, ny = len(model.inputs), len(model.outputs)
    with started(path, tmp_path / "unpacked") as (unit, references):
        assert list(references)[:nu] == [channel.name for channel in model.inputs]
        assert list(references)[nu : nu + ny] == [channel.name for channel in model.outputs]
        given, read = list(references.values())[:nu], list(references.values())[nu : nu + ny]
        assert np.array_equal(unit.getReal(given), model.scaler.u_offset)

        def simulated() -> Array:
            y = []
            for k, u_k in enumerate(u):
                unit.setReal(given, u_k)
                y.append(unit.getReal(read))
                unit.doStep(k * T, T)
            return np.array(y)

        check_output(simulated(), model, u)
        unit.reset()
        check_output(simulated(), model, u)
        # From a given state, two samples in one step, with the input held.
        states = list(references.values())[nu + ny :]
        x0 = np.linspace(-1.0, 1.0, len(states))
        unit.setReal(states, x0)
        unit.setReal(given, u[0])
        unit.doStep(0.0, 2 * T)
        x = model.signals(np.stack([u[0], u[0]]), start="given", x0=x0).x[0, -1].numpy()
        assert np.allclose(unit.getReal(states), x, rtol=0, atol=1e-12)
        with pytest.raises(Exception, match="DoStep failed"):
            unit.doStep(0.0, 1.5 * T)
        with pytest.raises(Exception, match="SetReal failed"):
            unit.setReal(read, np.zeros(ny))


@pytest.mark.numeric
def test_the_code_of_the_guide_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    model = MODELS["smallest"]
    write(model, "fmu", tmp_path, name="engine")
    monkeypatch.chdir(tmp_path)
    guide = Path(__file__).resolve().parents[2] / "docs" / "guide" / "export.md"
    section = guide.read_text(encoding="utf-8").split("## FMU")[1]
    known: dict[str, Any] = {}
    exec(section.split("```python\n")[1].split("```")[0], known)
    u = np.full(len(known["found"]), model.scaler.u_offset[0])
    check = model.simulate(u)[:, 0]
    assert np.allclose(known["found"]["y1"], check, rtol=0, atol=1e-10)


def test_odd_and_equal_names_are_written(tmp_path: Path):
    model = MODELS["smallest"]
    same = (Channel("<x[1]>\n", "°"),)
    odd = Model(model.lfr, model.scaler, model.fs, same, same)
    (path,) = write(odd, "fmu", tmp_path)
    found = fmpy.read_model_description(str(path), validate=True)
    assert [one.name for one in found.modelVariables] == ["<x[1]> ", "<x[1]> _", "x[1]"]
    assert [one.unit for one in found.modelVariables] == ["°", "°", None]


def test_a_missing_compiler_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(InputError, match="an FMU needs a C compiler; install gcc"):
        write(MODELS["linear"], "fmu", tmp_path)
    assert list(tmp_path.iterdir()) == []
