"""The linear model beside an NL-LFR is the best that there is for the error that is judged."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import lfrtorch
from lfrtorch import Dataset, LevenbergMarquardt, Record, Settings, identify
from lfrtorch.fitting.observer import Observer
from lfrtorch.reporting.opponent import opponents

pytestmark = pytest.mark.numeric


def axis(name: str, seed: int, samples: int = 400) -> Record:
    """Two lightly damped modes in a loop, sampled fast, with a force that saturates."""
    rng = np.random.default_rng(seed)
    reference = np.repeat(rng.standard_normal(samples // 25), 25)
    noise = 0.01 * rng.standard_normal(samples)
    modes = [(0.05, 0.02, 1.0), (0.6, 0.01, 0.3)]  # radians a sample, damping, gain
    x, u, y = np.zeros((2, 2)), np.zeros(samples), np.zeros(samples)
    for k in range(samples):
        y[k] = x[:, 0].sum() + noise[k]
        u[k] = 0.3 * (reference[k] - y[k])
        for state, (w, damping, gain) in zip(x, modes, strict=True):
            radius = np.exp(-damping * w)
            a = np.array([2 * radius * np.cos(w), -(radius**2)])
            force = gain * (1 - a.sum()) * (u[k] + 0.3 * np.tanh(3 * u[k]))
            state[:] = a[0] * state[0] + state[1] + force, a[1] * state[0]
    return Record(u, y, name=name, skip=50)


@pytest.fixture(scope="module")
def measured() -> Dataset:
    train, validation, test = (axis(n, k) for k, n in enumerate(("train", "validation", "test")))
    return Dataset("axis", [train], [validation], [test])


def settings(**given) -> Settings:
    trainer = LevenbergMarquardt(max_iter=2)
    usual = {"nx": 2, "nz": 1, "nn": 2, "starts": 1, "feedthrough": False, "trainer": trainer}
    return Settings(**usual | given)


def test_a_start_that_predicts_is_judged_beside_a_model_that_simulates(measured: Dataset):
    run = identify(measured, settings(linear={"refine": "prediction"}), observer=Observer())
    (train,), (test,) = measured.train, measured.tests
    found = {
        refine: lfrtorch.estimate_bla(train, 2, refine=refine, feedthrough=False)
        for refine in ("simulation", "prediction")
    }
    errors = {refine: lfrtorch.rmse(test, model.simulate(test)) for refine, model in found.items()}
    assert errors["prediction"] > 1.3 * errors["simulation"]
    score = run.metrics["scores"]["test"]["lti_rmse"]
    assert score == pytest.approx(errors["simulation"], rel=1e-6)
    assert lfrtorch.rmse(test, run.linear.simulate(test)) == score


def test_each_horizon_has_the_linear_model_that_is_best_there(measured: Dataset):
    run = identify(measured, settings(noise="innovation"), observer=Observer())
    (test,) = measured.tests
    predictions = run.metrics["predictions"]["test"]["lti_rmse"]
    assert run.linear.K is not None  # the one that predicts the next sample
    assert predictions["1"] == pytest.approx(lfrtorch.rmse(test, run.linear.predict(test)))
    alone = lfrtorch.estimate_bla(measured.train[0], 2, refine="simulation", feedthrough=False)
    simulated = lfrtorch.rmse(test, alone.simulate(test))
    assert predictions["100"] <= 1.01 * simulated
    assert run.metrics["scores"]["test"]["lti_rmse"] == pytest.approx(simulated, rel=1e-6)


def test_no_second_linear_model_is_made_where_it_is_the_same(
    measured: Dataset, monkeypatch: pytest.MonkeyPatch
):
    made = []
    estimate = lfrtorch.estimate_bla
    for where in ("lfrtorch.fitting.linear_start", "lfrtorch.reporting.opponent"):
        monkeypatch.setattr(
            f"{where}.estimate_bla", lambda *a, **k: (made.append(1), estimate(*a, **k))[1]
        )
    identify(measured, settings(), observer=Observer())
    assert len(made) == 1


def test_another_order_is_estimated_for_the_comparison(measured: Dataset):
    options: dict[str, Any] = {"feedthrough": False}
    first = lfrtorch.estimate_bla(measured.train[0], 1, **options)
    found = opponents(first, measured.train, measured, nx=2, options=options)
    assert found[None].nx == 2
