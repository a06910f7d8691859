"""Entries of the matrices that are given: the coordinates of a start, and a fit that keeps them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from reference import measure, random_cell, random_model

import lfrtorch
from lfrtorch import Dataset, InputError, Record, Settings, initialise
from lfrtorch.fitting.given_entries import with_given

NAN = float("nan")


def oscillator(samples: int = 600, seed: int = 0) -> Record:
    """A mass on a spring that hardens; position and speed are its states, in m and m/s."""
    rng = np.random.default_rng(seed)
    u = 5.0 + 2.0 * rng.standard_normal(samples)
    x, y = np.array([0.5, 0.0]), []
    for force in u:
        y.append(x[0])
        rate = 0.5 * (force - 5.0) - 0.8 * x[1] - 2.0 * (x[0] - 0.5) - 3.0 * (x[0] - 0.5) ** 3
        x = x + 0.1 * np.array([x[1], rate])
    return Record(u, np.array(y) + 1e-3 * rng.standard_normal(samples), fs=10.0)


def identified(**settings: Any) -> lfrtorch.Run:
    usual: dict[str, Any] = {"nx": 2, "nz": 1, "nw": 1, "nn": 4, "starts": 1}
    dataset = Dataset("oscillator", [oscillator()], [], [])
    return lfrtorch.identify(dataset, Settings(**{**usual, **settings}))


PHYSICAL = {"Cy": [[1.0, 0.0]], "A": [[1.0, 0.1], [NAN, NAN]], "Bu": [[0.0], [NAN]]}
"""The output is the position, and that is the sum of speeds."""


@pytest.mark.parametrize("names", [("Cy",), ("A", "Cy"), ("A", "Cy", "Bu")])
def test_the_same_model_is_put_into_coordinates_that_have_the_entries(names: tuple[str, ...]):
    model = random_model(random_cell(1, 1, 2, 1, 1, 3))
    scale = float(model.scaler.y_scale[0])
    free = {"A": [[NAN, 0.1], [NAN, NAN]], "Cy": [[1.0, 0.0]], "Bu": [[NAN], [0.3]]}
    given = {name: free[name] for name in names}
    found, apart = with_given(model, given)
    assert apart < 1e-6
    u = measure(model, 50, seed=1).u
    moment, T = (
        model.state_covariance,
        np.linalg.lstsq(model.signals(u).x[0].numpy(), found.signals(u).x[0].numpy(), rcond=None)[
            0
        ].T,
    )
    np.testing.assert_allclose(found.state_covariance, T @ moment @ T.T, rtol=1e-4, atol=1e-8)
    difference = found.simulate(u) - model.simulate(u)
    assert np.abs(difference).max() < 1e-5 * np.abs(model.simulate(u)).max()
    assert found.lfr.cell.Cy.tolist() == [[pytest.approx(1.0 / scale), 0.0]]
    assert {*found.lfr.cell.held} == {*names}


def test_a_fit_keeps_what_is_given_and_is_as_good(tmp_path: Path):
    free, run = identified(), identified(fixed=PHYSICAL)
    cell, s = run.model.lfr.cell, run.model.scaler
    assert cell.Cy.tolist() == [[pytest.approx(1.0 / s.y_scale[0]), 0.0]]
    assert cell.A[0].tolist() == [1.0, 0.1]
    assert cell.Bu[0].tolist() == [0.0]
    assert run.model.parameter_count == free.model.parameter_count - 5
    # Four of the five entries are a choice of coordinates.
    assert run.model.net_parameter_count == free.model.net_parameter_count - 1
    errors = [each.fit.history[each.fit.chosen_iteration].train for each in (run, free)]
    assert errors[0] < 1.1 * errors[1]
    other = oscillator(seed=3)
    assert lfrtorch.rmse(other, run.model.simulate(other)) < 0.05 * np.std(other.y)
    assert cell.A[1].tolist()[1] == pytest.approx(1 - 0.08, abs=0.05)  # the damping
    run.model.save(tmp_path / "model")
    again = lfrtorch.load(tmp_path / "model")
    assert {*again.lfr.cell.held} == {*PHYSICAL}


def test_entries_are_given_in_physical_units():
    model = random_model(random_cell(2, 2, 2, 1, 1, 3))
    u, y = model.scaler.u_scale, model.scaler.y_scale[:, None]
    Dzu, Dyu, Dyw = [[0.3, 0.4]], [[0.5, 0.6], [0.7, 0.8]], [[0.9], [1.1]]
    given: dict[str, Any] = {"Dzu": Dzu, "Dyu": Dyu, "Dyw": Dyw}
    cell = with_given(model, given)[0].lfr.cell
    for found, wanted in ((cell.Dzu, Dzu * u), (cell.Dyu, Dyu * u / y), (cell.Dyw, Dyw / y)):
        np.testing.assert_allclose(found.detach(), wanted, rtol=1e-12)


def test_it_is_fitted_again_and_in_windows():
    train = oscillator()
    options: dict[str, Any] = {"nx": 2, "nz": 1, "nw": 1, "nn": 4, "starts": 2, "fixed": PHYSICAL}
    options["trainer"] = lfrtorch.LevenbergMarquardt(max_iter=25)
    dataset = Dataset("oscillator", [train], [oscillator(seed=2)], [])
    for more in ({"refit": True}, {"horizon": 100}):
        run = lfrtorch.identify(dataset, Settings(**{**options, **more}))
        assert run.model.lfr.cell.A[0].tolist() == [1.0, 0.1]
        assert lfrtorch.rmse(train, run.model.simulate(train)) < 0.1 * np.std(train.y)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"D": [[1.0]]}, "fixed names 'D'; the matrices are A, Bu"),
        ({"Cy": [1.0, 0.0]}, r"fixed Cy has the shape \(2,\); give \(1, 2\), the model's"),
        ({"Cy": [[NAN, NAN]]}, "give some finite numbers"),
        ({"Cy": [[np.inf, 0.0]]}, "give some finite numbers"),
    ],
)
def test_what_is_no_matrix_is_refused(given: dict[str, Any], message: str):
    record = oscillator(100)
    model = initialise(lfrtorch.estimate_bla(record, nx=2), record, nz=1, nw=1, nn=2)
    with pytest.raises(InputError, match=message):
        with_given(model, given)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"nz": 2, "fixed": {"Dzu": [[1.0]]}}, r"give \(2, 1\), the model's"),
        ({"fixed": {"Cy": [[1.0, 0.0, 0.0]]}}, r"give \(1, 2\), the model's"),
    ],
)
def test_settings_are_refused_before_any_fit(
    settings: dict[str, Any], message: str, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("lfrtorch.fitting.linear_start.linear_model", None)
    with pytest.raises(InputError, match=message):
        identified(**settings)
