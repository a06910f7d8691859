"""Identification with a dead time: the fits see later inputs, and the models know the delay."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from command_line import configuration

from lfrtorch import (
    Dataset,
    InputError,
    Known,
    LevenbergMarquardt,
    Record,
    Settings,
    identify,
    load,
    rmse,
)
from lfrtorch.cli.config import configured
from lfrtorch.fitting.observer import Observer
from lfrtorch.reporting.html import render

DELAY = 6
SHORT = LevenbergMarquardt(max_iter=12)


def delayed_saturation(seed: int, samples: int = 500, noise: float = 0.02) -> Record:
    """A lag whose input saturates, and acts after so many samples and the usual one."""
    rng = np.random.default_rng(seed)
    u, y = np.repeat(rng.standard_normal(samples // 2), 2), np.zeros(samples)
    late = np.concatenate([np.zeros(DELAY), u])
    for k in range(samples - 1):
        y[k + 1] = 0.7 * y[k] + np.tanh(late[k])
    return Record(u, y + noise * rng.standard_normal(samples), fs=2.0, skip=20, name=f"r{seed}")


@pytest.fixture(scope="module")
def dataset() -> Dataset:
    train, validation, test = map(delayed_saturation, range(3))
    late = replace(test[100:], start="estimated", skip=50, name="late")
    return Dataset("delayed", [train], [validation], [test, late])


def settings(**more: Any) -> Settings:
    given = {"nx": 1, "nz": 1, "nn": 4, "starts": 1, "trainer": SHORT, "delay": "auto"}
    return Settings(**{**given, **more})


def test_it_is_found_and_told(dataset: Dataset, tmp_path: Path):
    run = identify(dataset, settings(nx="auto"), observer=Observer())
    assert run.model.sizes["nx"] == 1
    assert run.model.delay[0] in (DELAY, DELAY + 1)
    assert run.linear.delay == run.model.delay == run.settings.delay
    assert run.dataset.tests[0].samples == 500  # as measured
    (found,) = run.dead_times
    assert abs(found.samples - DELAY) < max(2 * found.std, 0.1)
    assert "dead time of u:" in str(run)
    assert run.metrics["dead_times"][0]["samples"] == found.samples
    scores = run.metrics["scores"]
    for test in dataset.tests:
        assert scores[test.name]["rmse"] == pytest.approx(rmse(test, run.model.simulate(test)))
        assert scores[test.name]["rmse"] < 0.05
    assert "Dead time of u:" in render(run, {})
    again = load(run.model.save(tmp_path / "model"))
    assert again.delay == run.model.delay
    assert again.information is not None


def test_without_it_the_model_is_worse(dataset: Dataset):
    with_delay, without = (
        identify(dataset, settings(delay=delay), observer=Observer()).metrics["scores"]["r2"][
            "rmse"
        ]
        for delay in (DELAY, 0)
    )
    assert with_delay < 0.2 * without


@pytest.mark.parametrize("delay", [5.3, 6, [5.3], np.array([6])])
def test_a_given_dead_time_is_rounded_up(dataset: Dataset, delay: Any):
    run = identify(dataset, settings(delay=delay), observer=Observer())
    assert run.model.delay == (DELAY,)


def test_no_dead_time_is_no_delay():
    u = np.random.default_rng(0).standard_normal(400)
    y = np.convolve(u, 0.9 ** np.arange(30))[:400]
    run = identify(Record(u, y, skip=20), settings(), observer=Observer())
    assert run.model.delay == (0,)
    assert run.dead_times == ()


MORE: tuple[dict[str, Any], ...] = (
    {"noise": "innovation"},
    {"horizon": 40},
    {"average": 2, "starts": 3},
    {"feedthrough": False},
)
RARER: tuple[dict[str, Any], ...] = (
    {"static": "polynomial"},
    {"structure": "hammerstein"},
    {"refit": True},
    {"first_part": 0.5, "first_iterations": 3},
    {"init": "paper"},
    {"nn": "auto", "starts": 4},
    {"linear": {"offset": False}},
    {"linear": {"refine": "frequency"}},
)


@pytest.mark.parametrize(
    "more", [*MORE, *(pytest.param(one, marks=pytest.mark.slow) for one in RARER)], ids="-".join
)
def test_it_goes_with_every_setting(dataset: Dataset, more: dict[str, Any]):
    run = identify(dataset, settings(delay=DELAY, **more), observer=Observer())
    assert run.model.delay == (DELAY,)
    assert len(run.dead_times) == 1
    assert run.metrics["scores"]["r2"]["rmse"] < 0.25


@pytest.mark.parametrize(
    "start", ["estimated", "periodic", pytest.param("measured", marks=pytest.mark.slow)]
)
def test_it_goes_with_every_start(start: Any):
    u = np.tile(np.random.default_rng(0).standard_normal(200), 3)
    y, late = np.zeros(600), np.concatenate([np.zeros(DELAY), u])
    for k in range(599):
        y[k + 1] = 0.7 * y[k] + np.tanh(late[k])
    parts = [Record(u[p], y[p], start=start) for p in (slice(200, 400), slice(400, 600))]
    horizon = 20 if start == "measured" else None
    data = Dataset("begun", parts[:1], [], parts[1:])
    delay = "auto" if start == "measured" else DELAY
    run = identify(data, settings(horizon=horizon, delay=delay), observer=Observer())
    assert run.model.delay[0] in (DELAY, DELAY + 1)
    known = parts[1].y[DELAY + 50 :]
    if start != "measured":
        simulated = run.model.simulate(parts[1])[DELAY + 50 :]
        assert np.std(known - simulated) < 0.3 * np.std(known)


def test_known_equations_have_it(dataset: Dataset):
    def rates(x, u, p):
        return (p.gain * torch.tanh(u[0]) - p.rate * x.level,)

    known = Known(rates, states=["level"], parameters={"gain": 1.5, "rate": 0.5})
    run = identify(dataset, Settings(known=known, trainer=SHORT, delay=DELAY), observer=Observer())
    assert run.model.delay == (DELAY,)
    assert run.metrics["scores"]["r2"]["rmse"] < 0.1


def test_a_model_to_start_from_brings_its_own(dataset: Dataset):
    first = identify(dataset, settings(delay=DELAY), observer=Observer()).model
    cases: tuple[tuple[Any, int], ...] = ((0, DELAY), ("auto", DELAY), (DELAY + 1, DELAY + 1))
    for delay, found in cases:
        more = Settings(init_from=first, delay=delay, trainer=LevenbergMarquardt(max_iter=2))
        run = identify(dataset, more, observer=Observer())
        assert run.model.delay == (found,)


def test_two_inputs_have_two():
    rng = np.random.default_rng(1)
    u, y = rng.standard_normal((600, 2)), np.zeros(600)
    first, second = (np.concatenate([np.zeros(d), v]) for d, v in zip((4, 9), u.T, strict=True))
    for k in range(599):
        y[k + 1] = 0.7 * y[k] + np.tanh(first[k]) - 0.5 * second[k]
    run = identify(Record(u, y, skip=20), settings(delay=(4, 9)), observer=Observer())
    assert run.model.delay == (4, 9)
    assert [one.input.name for one in run.dead_times] == ["u1", "u2"]
    with pytest.raises(InputError, match="delay has 3 numbers"):
        identify(Record(u, y), settings(delay=(1, 2, 3)), observer=Observer())


@pytest.mark.parametrize("delay", ["some", -1, (1, -2), None, float("nan")])
def test_what_is_no_delay_is_refused(delay: Any):
    with pytest.raises(InputError, match="delay"):
        settings(delay=delay)


def test_the_command_line_takes_it():
    for word, found in (("auto", "auto"), ("3.5", 3.5), ("[2,0.5]", (2, 0.5))):
        assert configured(configuration("+bench=boucwen", f"delay={word}")).delay == found
