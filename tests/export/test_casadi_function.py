"""The CasADi function of a model: its numbers, its derivatives, and a controller that uses it."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
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

from lfrtorch import InputError
from lfrtorch._support.types import Array
from lfrtorch.export import casadi_function, write
from lfrtorch.model.extended_kalman_filter import ExtendedKalmanFilter

casadi = pytest.importorskip(
    "casadi", reason="casadi comes with the extra: pip install -e '.[casadi]'"
)


@pytest.mark.numeric
@pytest.mark.parametrize("name", MODELS)
def test_steps_are_those_of_the_model(name: str):
    function = casadi_function(MODELS[name], name)

    def step(x: Array, u: Array) -> tuple[Array, Array]:
        x_next, y = function(x, u)
        return np.array(x_next)[:, 0], np.array(y)[:, 0]

    check_step(step, MODELS[name])
    check_run(step, MODELS[name])


@pytest.mark.numeric
@pytest.mark.parametrize("name", MODELS)
def test_jacobians_are_those_of_the_model(name: str):
    model, function = MODELS[name], casadi_function(MODELS[name], name)
    u, x = inputs(model, 1)[0], np.random.default_rng(4).normal(size=model.lfr.cell.nx)
    expected = jacobians(model, x, u)
    for found, one in zip(function.jacobian()(x, u, 0, 0), expected, strict=True):
        assert np.abs(np.array(found) - one).max() <= 1e-12 * np.abs(one).max()


@pytest.mark.numeric
@pytest.mark.parametrize("name", OBSERVED)
@pytest.mark.parametrize("kind", ["k", "ekf"])
def test_observers_are_those_of_the_model(name: str, kind: str, tmp_path: Path):
    model, (u, y) = OBSERVED[name], measured_with_gaps(OBSERVED[name], 40)
    noise, nx = some_noise(model), model.lfr.cell.nx
    if kind == "ekf":
        expected = model.observer(noise=noise)
        paths = write(model, "casadi", tmp_path, observer=noise)
    else:
        expected, paths = model.observer(), write(model, "casadi", tmp_path, observer=True)
    names = [f"model_{each}.casadi" for each in ("predict", "correct", "update")]
    assert [path.name for path in paths[2:]] == names
    predict, correct, update = (casadi.Function.load(str(path)) for path in paths[2:])
    x, P = np.zeros(nx), np.full((nx, nx), np.nan)
    for u_k, y_k in zip(u, y, strict=True):
        y_hat = np.array(predict(x, u_k))[:, 0]
        np.testing.assert_allclose(y_hat, expected.predict(u_k), rtol=1e-10, atol=1e-10)
        expected.correct(y_k, u_k)
        given = {"x": x, "u": u_k, "y": y_k} | ({} if np.isnan(P).all() else {"P": P})
        missing = {"missing": np.isnan(y_k)} if np.isnan(y_k).any() else {}
        known = correct(**given, **missing)
        x_known = np.array(known["x_known"])[:, 0]
        np.testing.assert_allclose(x_known, expected.state, rtol=1e-10, atol=1e-10)
        if isinstance(expected, ExtendedKalmanFilter):
            P = np.array(known["P_known"])
            np.testing.assert_allclose(P, expected.covariance, rtol=1e-10, atol=1e-12)
        expected.advance(u_k)
        after = update(**given, **missing)
        x = np.array(after["x_next"])[:, 0]
        np.testing.assert_allclose(x, expected.state, rtol=1e-10, atol=1e-10)
        if isinstance(expected, ExtendedKalmanFilter):
            P = np.array(after["P_next"])
            np.testing.assert_allclose(P, expected.covariance, rtol=1e-10, atol=1e-12)


@pytest.mark.numeric
def test_derivatives_far_out_are_finite():
    for activation in ("sigmoid", "softplus"):
        function = casadi_function(MODELS[activation])
        for x in (1e6, -1e6):
            derivatives = function.jacobian()(x, 0, 0, 0)
            assert all(np.isfinite(np.array(one)).all() for one in derivatives)


@pytest.mark.numeric
def test_the_controller_of_the_guide_is_solved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Inputs within limits bring the output to a set point, and the model itself agrees."""
    model = MODELS["smallest"]
    path, _ = write(model, "casadi", tmp_path, name="engine")
    assert path == tmp_path / "engine.casadi"
    monkeypatch.chdir(tmp_path)
    guide = Path(__file__).resolve().parents[2] / "docs" / "guide" / "export.md"
    section = guide.read_text(encoding="utf-8").split("## CasADi")[1]
    code = section.split("```python\n")[1].split("```")[0]
    known: dict = {}
    exec(code.replace('"ipopt"', '"ipopt", {}, {"print_level": 0}'), known)
    planned = known["problem"].debug.value(known["u"])
    assert known["problem"].stats()["success"]
    assert known["u_now"] == planned[0]
    assert (planned > -1e-6).all()
    assert (planned < 1 + 1e-6).all()
    errors = model.simulate(planned)[:, 0] - 0.3
    assert np.sum(errors**2) == pytest.approx(known["problem"].debug.value(known["cost"]), rel=1e-6)
    worst = [np.sum((model.simulate(np.full(20, u))[:, 0] - 0.3) ** 2) for u in (0.0, 0.5, 1.0)]
    assert np.sum(errors**2) < min(worst)


@pytest.mark.numeric
def test_the_channels_are_beside_the_function(tmp_path: Path):
    model = MODELS["smallest"]
    _, channels = write(model, "casadi", tmp_path, name="plant")
    found = json.loads(channels.read_text())
    check_rest(np.array(found.pop("x_rest")), model)
    assert found == {
        "name": "plant",
        "fs": 750.0,
        "states": 1,
        "inputs": [{"name": "u1", "unit": "N", "offset": model.scaler.u_offset[0]}],
        "outputs": [{"name": "y1", "unit": "mm", "offset": model.scaler.y_offset[0]}],
    }


def test_channels_name_the_symbols():
    assert [str(one) for one in casadi_function(MODELS["linear"]).sx_in("u").nz] == ["u1", "u2"]


def test_a_missing_package_is_said(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setitem(sys.modules, "casadi", None)
    with pytest.raises(InputError, match=r"casadi is not installed: pip install"):
        write(MODELS["linear"], "casadi", tmp_path)
    assert list(tmp_path.iterdir()) == []
