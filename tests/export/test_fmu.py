"""The FMU of a model, run by FMPy beside the model."""

from __future__ import annotations

import platform
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from exported import MODELS, check_output, inputs, jacobians

from lfrtorch import InputError
from lfrtorch._support.types import Array
from lfrtorch.data.records import Channel
from lfrtorch.export import write
from lfrtorch.model.model import Model

fmpy = pytest.importorskip("fmpy", reason="fmpy comes with the extra: pip install -e '.[fmu]'")

if (platform.system(), platform.machine()) != ("Linux", "x86_64"):
    pytest.skip("an FMU is compiled on Linux x86_64 alone", allow_module_level=True)
if not any(map(shutil.which, ("gcc", "cc", "clang"))):
    pytest.skip("there is no C compiler", allow_module_level=True)


class Unit:
    """An instance of one version, with the same calls for both."""

    def __init__(self, path: Path, folder: Path) -> None:
        found = fmpy.read_model_description(str(path), validate=True)
        fmpy.extract(str(path), unzipdir=str(folder))
        self.version = int(found.fmiVersion[0])
        made = fmpy.fmi2.FMU2Slave if self.version == 2 else fmpy.fmi3.FMU3Slave
        self.it = made(
            guid=found.guid, unzipDirectory=str(folder), instanceName="it",
            modelIdentifier=found.coSimulation.modelIdentifier,
        )  # fmt: skip
        self.it.instantiate()
        self.begin()
        self.references = {one.name: one.valueReference for one in found.modelVariables}
        self.description = found

    def begin(self) -> None:
        if self.version == 2:
            self.it.setupExperiment(startTime=0.0)
            self.it.enterInitializationMode()
        else:
            self.it.enterInitializationMode(startTime=0.0)
        self.it.exitInitializationMode()

    def get(self, references: list[int]) -> Array:
        read = self.it.getReal if self.version == 2 else self.it.getFloat64
        return np.array(read(references))

    def set(self, references: list[int], values: Array) -> None:
        (self.it.setReal if self.version == 2 else self.it.setFloat64)(references, values)


@contextmanager
def started(path: Path, folder: Path) -> Iterator[tuple[Unit, dict[str, int]]]:
    """An instance before its first step, and the value references."""
    unit = Unit(path, folder)
    yield unit, unit.references
    unit.it.terminate()
    unit.it.freeInstance()


@pytest.fixture(params=["fmu", "fmu3"])
def to(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.mark.numeric
@pytest.mark.parametrize("name", ["softplus", "polynomial", "linear"])
def test_the_simulation_is_that_of_the_model(name: str, to: str, tmp_path: Path):
    model = MODELS[name]
    (path,) = write(model, to, tmp_path, name="engine")
    u, T = inputs(model, 1000), 1.0 / model.fs
    nu, ny, nx = len(model.inputs), len(model.outputs), model.lfr.cell.nx
    with started(path, tmp_path / "unpacked") as (unit, references):
        assert list(references)[:nu] == [channel.name for channel in model.inputs]
        assert list(references)[nu : nu + ny] == [channel.name for channel in model.outputs]
        numbers = list(references.values())
        given, read, states = numbers[:nu], numbers[nu : nu + ny], numbers[nu + ny :][:nx]
        assert np.array_equal(unit.get(given), model.scaler.u_offset)

        def simulated(parts: tuple[float, ...] = (1.0,)) -> Array:
            y = []
            for k, u_k in enumerate(u):
                unit.set(given, u_k)
                y.append(unit.get(read))
                done = 0.0
                for part in parts:
                    unit.it.doStep((k + done) * T, part * T)
                    done += part
                    if done < 1.0 - 1e-9:  # held, and what is set now waits for the next sample
                        unit.set(given, u_k + 5.0)
                        assert np.array_equal(unit.get(read), y[-1])
            return np.array(y)

        check_output(simulated(), model, u)
        unit.it.reset()
        check_output(simulated((0.3, 0.45, 0.25)), model, u)
        # From a given state, two samples in one step, with the input held.
        x0 = np.linspace(-1.0, 1.0, nx)
        unit.set(states, x0)
        unit.set(given, u[0])
        unit.it.doStep(0.0, 2 * T)
        x = model.signals(np.stack([u[0], u[0]]), start="given", x0=x0).x[0, -1].numpy()
        assert np.allclose(unit.get(states), x, rtol=0, atol=1e-12)
        with pytest.raises(Exception, match="DoStep failed"):
            unit.it.doStep(0.0, -1.5 * T)
        with pytest.raises(Exception, match="failed"):
            unit.set(read, np.zeros(ny))


@pytest.mark.numeric
def test_a_state_is_restored_amid_a_sample(to: str, tmp_path: Path):
    model = MODELS["softplus"]
    (path,) = write(model, to, tmp_path, name="engine")
    u, T = inputs(model, 20), 1.0 / model.fs
    with started(path, tmp_path / "unpacked") as (unit, references):
        numbers = list(references.values())
        nu, ny = len(model.inputs), len(model.outputs)
        given, read = numbers[:nu], numbers[nu : nu + ny]
        get, put, free, serialize, again = (
            getattr(unit.it, name if unit.version == 2 else name.replace("FMUstate", "FMUState"))
            for name in (
                "getFMUstate", "setFMUstate", "freeFMUstate", "serializeFMUstate",
                "deSerializeFMUstate" if unit.version == 2 else "deserializeFMUState",
            )
        )  # fmt: skip

        def run() -> Array:
            y = []
            for u_k in u:
                unit.set(given, u_k)
                unit.it.doStep(0.0, 0.6 * T)
                y.append(unit.get(read))
            return np.array(y)

        unit.it.doStep(0.0, 0.4 * T)
        kept = get()
        stored = serialize(kept)
        first = run()
        put(kept)
        assert np.array_equal(run(), first)
        free(kept)
        kept = again(stored)
        put(kept)
        assert np.array_equal(run(), first)
        free(kept)


@pytest.mark.numeric
@pytest.mark.parametrize("name", ["softplus", "without"])
def test_derivatives_and_dependencies_are_those_of_the_model(name: str, to: str, tmp_path: Path):
    model = deepcopy(MODELS["softplus"])
    nu, ny, nx = len(model.inputs), len(model.outputs), model.lfr.cell.nx
    if name == "without":
        with torch.no_grad():
            model.lfr.cell.Dyu.zero_()
            model.lfr.cell.Dzu[:, 0] = 0.0
            model.lfr.cell.Dyw[1:] = 0.0  # the first output depends on the second input alone
    (path,) = write(model, to, tmp_path, name="engine")
    with started(path, tmp_path / "unpacked") as (unit, references):
        numbers = list(references.values())
        read, knowns = numbers[nu : nu + ny], [*numbers[:nu], *numbers[nu + ny :][:nx]]
        x, u = np.linspace(-1.0, 1.0, nx), inputs(model, 1)[0]
        unit.set(knowns, np.append(u, x))
        _, _, H, D = jacobians(model, x, u)
        for column, known in enumerate(knowns):
            found = unit.it.getDirectionalDerivative(read, [known], [1.0])
            np.testing.assert_allclose(found, np.hstack([D, H])[:, column], rtol=1e-9, atol=1e-12)
        for output, one in enumerate(unit.description.outputs):
            depends = [each.name for each in one.dependencies]
            expected = [c.name for c in model.inputs]
            if name == "without":
                expected = expected[1:] if output == 0 else []
            assert depends == expected


@pytest.mark.numeric
def test_the_code_of_the_guide_runs(to: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    model = MODELS["smallest"]
    write(model, to, tmp_path, name="engine")
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
