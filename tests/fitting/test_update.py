"""Updates with new data: the old data count as if they were there, and only where they should."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
import torch
from reference import measure, planted, random_cell, random_model

from lfrtorch import (
    Dataset,
    InputError,
    Known,
    LevenbergMarquardt,
    Model,
    Parameter,
    Record,
    Settings,
    estimate_bla,
    fit,
    identify,
    initialise,
    load,
    rmse,
    update,
)
from lfrtorch.fitting.information import informed
from lfrtorch.least_squares.problem import Problem

pytestmark = pytest.mark.numeric
ONE = LevenbergMarquardt(max_iter=1)


def saturation(seed: int, samples: int = 400, gain: float = 1.0, noise: float = 0.05) -> Record:
    """A first-order system that saturates at its input, measured with noise."""
    rng = np.random.default_rng(seed)
    u, y = rng.standard_normal(samples), np.zeros(samples)
    for k in range(samples - 1):
        y[k + 1] = 0.7 * y[k] + gain * np.tanh(u[k])
    return Record(u, y + noise * rng.standard_normal(samples), start="zero")


@pytest.fixture(scope="module")
def old() -> tuple[Model, Record]:
    record = saturation(0)
    model = initialise(estimate_bla(record, nx=1), record, nz=1, nw=1, nn=3)
    return fit(model, record, trainer=LevenbergMarquardt(max_iter=60), monitors=[]).model, record


def test_it_is_a_fit_to_all_data_of_the_same_system():
    first, second, unseen = saturation(0, 3000), saturation(1, 3000), saturation(2, 2000).u
    begun = initialise(estimate_bla(first, nx=1), first, nz=1, nw=1, nn=2)
    begun = fit(begun, first, monitors=[]).model
    whole = fit(deepcopy(begun), [first, second], monitors=[]).model.simulate(unseen)
    found = update(begun, second, prior=first, weight=1.0).model.simulate(unseen)
    before = begun.simulate(unseen)
    # What is left is of second order in the step, and of the term that holds undetermined ones.
    assert np.std(found - whole) < 0.7 * np.std(before - whole)
    # In pieces, one step each.
    model = informed(begun, first)
    for at in range(0, 3000, 500):
        piece = replace(second[at : at + 500], start="estimated" if at else "zero")
        model = update(model, piece, weight=1.0, trainer=ONE).model
    assert np.std(model.simulate(unseen) - found) < 0.5 * np.std(before - found)


def test_few_data_of_a_changed_system(old):
    begun, first = old
    few, test = saturation(3, 60, gain=1.3), saturation(4, 2000, gain=1.3)
    found = update(begun, few, prior=first)
    assert found.weight < 0.1
    noise = 0.05
    assert rmse(test, begun.simulate(test)) > 3.0 * noise
    assert rmse(test, found.model.simulate(test)) < 1.2 * noise
    assert found.before[0] > 3.0 * found.after[0]
    assert found.steps["all"][0] > 3.0
    assert "The old data count" in str(found)
    assert "static.Wz" in str(found)


def test_data_without_information_do_not_move_it(old):
    begun, first = old
    still = Record(np.zeros(50), np.zeros(50) + begun.simulate(np.zeros(50))[:, 0], start="zero")
    found = update(begun, still, prior=first)
    assert found.weight == 1.0
    assert found.steps["all"][0] < 0.01
    short = update(begun, saturation(5, 12), prior=first)  # too short for cross-validation
    assert short.weight == 1.0


def test_the_information_is_that_of_the_jacobian():
    model, train, _ = planted(200, nx=2, nz=2, nw=1, nn=2)
    records = [train[0], replace(train[1], start="estimated")]
    found = informed(model, records).information
    assert found is not None
    total = 0.0
    for record in records:
        problem = Problem.of(model, record)
        J = problem.jacobian(problem.theta)
        own, states = J[:, : problem.errors.parameters.own], J[:, problem.errors.parameters.own :]
        left = own - states @ torch.linalg.pinv(states) @ own
        total = total + left.mT @ left
    given = found.R.double().mT @ found.R.double() * found.rmse**2
    assert torch.linalg.matrix_norm(given - total) < 1e-6 * torch.linalg.matrix_norm(total)


def test_a_model_keeps_what_its_data_told(old, tmp_path):
    begun, first = old
    model, new = informed(begun, first), saturation(6, 100)
    again = load(model.save(tmp_path / "model"))
    one, two = (update(each, new, weight=0.1) for each in (model, again))
    np.testing.assert_allclose(one.model.simulate(new), two.model.simulate(new), atol=1e-6)
    later = load(one.model.save(tmp_path / "later"))
    assert update(later, saturation(7, 100), weight=1.0).after[0] < 0.07
    other = deepcopy(again)
    with torch.no_grad():
        other.lfr.cell.A.mul_(0.9)
    for unknown in (begun, other):
        with pytest.raises(InputError, match="does not know what its data told"):
            update(unknown, new)
    assert informed(model.resample(200.0).model, replace(first, fs=200.0)).information is not None
    with pytest.raises(InputError, match="weight is 0"):
        update(model, new, weight=0)
    with pytest.raises(InputError, match="sampled at"):
        update(model, replace(new, fs=50.0))


def test_a_predictor_is_updated_as_one(old):
    _, first = old
    linear = estimate_bla(first, nx=1, refine="prediction")
    begun = initialise(linear, first, nz=1, nw=1, nn=3)
    begun = fit(begun, first, noise="innovation", monitors=[]).model
    new = saturation(8, 200, gain=1.3)
    found = update(begun, new, prior=first).model
    assert found.K is not None
    before, after = (np.std(new.y - one.predict(new)) for one in (begun, found))
    assert after < 0.8 * before
    assert update(found, saturation(9, 100, gain=1.3)).weight > 0  # it knows of both


def test_windows_and_single_precision():
    cell = random_cell(nx=2, nu=1, ny=1, nz=1, nw=1, nn=3).float()
    model = random_model(cell)
    first, second = (measure(model, 300, seed=s) for s in (0, 1))
    found = update(model, second, prior=first, horizon=50)
    assert found.model.lfr.cell.A.dtype == torch.float32
    assert found.after[0] < 1e-4


def resonance(seed: int, samples: int, radius: float, noise: float = 0.02) -> Record:
    """A resonance behind a saturation."""
    rng, pole = np.random.default_rng(seed), radius * np.exp(0.3j)
    u, y, x = rng.standard_normal(samples), np.zeros(samples), 0.0j
    for k in range(samples):
        y[k] = x.real + noise * rng.standard_normal()
        x = pole * x + 0.1 * np.tanh(u[k])
    return Record(u, y, start="zero")


def test_a_stable_model_stays_stable_at_rest():
    first, second = resonance(0, 1500, 0.99), resonance(1, 150, 1.01)
    begun = initialise(estimate_bla(first, nx=2), first, nz=1, nw=1, nn=3)
    begun = fit(begun, first, trainer=LevenbergMarquardt(max_iter=40), monitors=[]).model
    found = update(begun, second, prior=first, weight=1e-4)
    assert found.weight > 1e-4
    later = found.model.simulate(resonance(2, 4000, 0.99))
    assert np.abs(later).max() < 10.0 * np.abs(first.y).max()


def test_values_of_known_equations():
    def equations(x, u, p):
        return (-p.rate * x.level + u[0],)

    known = Known(
        equations, states=["level"], outputs=lambda x, u, p: (x.level,),
        parameters={"rate": Parameter(0.6, low=0.0)},
    )  # fmt: skip
    model = identify(
        Dataset("tank", [tank(0, 0.5)], [], []), Settings(known=known, nn=0, starts=1)
    ).model
    found = update(model, tank(1, 0.8, 100))
    before, after = found.values["rate"]
    assert before == pytest.approx(0.5, abs=0.02)
    assert after == pytest.approx(0.8, abs=0.02)
    assert "rate" in str(found)


def tank(seed: int, rate: float, samples: int = 400) -> Record:
    """A first-order system whose input is held, at 10 Hz."""
    rng = np.random.default_rng(seed)
    u, y, stays = rng.standard_normal(samples), np.zeros(samples), np.exp(-0.1 * rate)
    for k in range(samples - 1):
        y[k + 1] = stays * y[k] + (1.0 - stays) / rate * u[k]
    return Record(u, y + 1e-3 * rng.standard_normal(samples), fs=10.0, start="zero")
