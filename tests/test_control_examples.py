"""Controllers of a quadruple tank, with a model of its data: no offset, and nothing winds up."""

from __future__ import annotations

import os
import runpy
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lfrtorch import Model, NoiseCovariance

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
OFFSET = 0.05  # cm; the sensor has 0.03 rms, and the model an error of 0.05

pytestmark = [
    pytest.mark.numeric,
    pytest.mark.filterwarnings("ignore::FutureWarning"),  # of casadi about numpy, in do-mpc
]

Identified = tuple[Model, NoiseCovariance]


@pytest.fixture(scope="module", autouse=True)
def beside_each_other():
    """The examples import the plant from the folder they are in."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(EXAMPLES)
        yield


def example(name: str) -> dict[str, Any]:
    return runpy.run_path(str(EXAMPLES / f"{name}.py"))


@pytest.fixture(scope="module")
def tanks(beside_each_other: None) -> Identified:
    return example("quadruple_tank")["identified"](samples=1000, iterations=20)


def offset(errors: np.ndarray, end: int) -> float:
    return float(np.abs(errors[end - 30 : end].mean(axis=0)).max())


def test_mpc_has_no_offset_and_keeps_its_limits(tanks: Identified):
    pytest.importorskip("casadi", reason="needs CasADi: pip install casadi")
    page = example("tank_mpc")
    found = page["closed_loop"](*tanks)
    assert max(offset(found["levels"] - found["wanted"], end) for end in (140, 220, 320)) < OFFSET
    np.testing.assert_allclose(found["disturbance"][190:].mean(axis=0), [0.4, 0.0], atol=0.05)
    assert found["levels"][:, 0].max() < page["CEILING"]
    assert np.abs(np.diff(found["u"], axis=0)).max() < page["STEP"] + 1e-6
    assert page["LOW"] - 1e-6 < found["u"].min() < found["u"].max() < page["HIGH"] + 1e-6
    assert page["figure"](found).axes


def test_limits_of_the_inputs_do_not_wind_the_disturbance_up(
    tanks: Identified, monkeypatch: pytest.MonkeyPatch
):
    pytest.importorskip("casadi", reason="needs CasADi: pip install casadi")
    closed_loop = example("tank_mpc")["closed_loop"]
    monkeypatch.setitem(closed_loop.__globals__, "HIGH", 3.6)
    schedule = {0: (12.0, 12.0), 20: (16.0, 12.0), 90: (12.0, 12.0)}
    found = closed_loop(*tanks, schedule, samples=140)
    assert found["u"][30:90, 0].min() > 3.5  # 16 cm take 4.05 V
    assert np.abs(found["disturbance"][20:]).max() < 0.2
    assert offset(found["levels"] - found["wanted"], 140) < OFFSET


def test_do_mpc_has_no_offset(tanks: Identified):
    pytest.importorskip("do_mpc", reason="needs do-mpc: pip install do-mpc")
    errors = example("tank_do_mpc")["closed_loop"](*tanks)
    assert max(offset(errors, 140), offset(errors, 240)) < OFFSET


@pytest.mark.parametrize("step", [2.0, -11.0])
def test_lqg_has_no_offset_and_its_integral_does_not_wind_up(tanks: Identified, step: float):
    pytest.importorskip("control", reason="needs python-control: pip install control")
    errors, u = example("tank_lqg")["closed_loop"](*tanks, step)
    at_limit = (u[100:250] <= 0.5).any()
    assert at_limit == (step < 0)  # a level of 1 cm beside one of 12 is out of reach
    assert at_limit or max(offset(errors, 150), offset(errors, 250)) < OFFSET
    assert offset(errors, 330) < OFFSET


def test_the_loop_in_c_is_that_in_python(tanks: Identified, tmp_path: Path):
    pytest.importorskip("control", reason="needs python-control: pip install control")
    if os.name != "posix" or not shutil.which("gcc"):
        pytest.skip("there is no gcc")
    page, (model, noise) = example("tank_c"), tanks
    program = page["compiled"](model, noise, [13.0, 11.0], tmp_path)
    levels, measured, u = page["closed_loop"](program)
    assert len(u) == 1000
    assert max(offset(levels - [13.0, 11.0], end) for end in (300, 1000)) < OFFSET
    rest = page["lfrtorch"].analysis.trim(model, y=[13.0, 11.0])
    observer = model.observer(noise=noise, disturbance="input", x0=rest.x)
    local = page["lfrtorch"].analysis.linearise(model, rest)
    gain = page["gain"](local)
    applied = [rest.u, *u]
    for y, before, expected in zip(measured, applied, u, strict=False):
        observer.correct(y, before)
        asked = rest.u - observer.disturbance - gain @ (observer.state - rest.x)
        np.testing.assert_allclose(np.clip(asked, 0.5, 5.5), expected, rtol=0, atol=1e-9)
        observer.advance(expected)
