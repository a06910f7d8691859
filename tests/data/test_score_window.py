"""Which samples are scored of an estimated start, and that it costs little to score nearly all."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from experiments import cut_from, noise_of, resonance

import lfrtorch
from lfrtorch import Dataset, LinearModel, Record
from lfrtorch.data.score_window import score_window, with_window
from lfrtorch.model.model import state_moment

INTEGRATOR = replace(resonance(0.5, 1.0), A=np.array([[1.0, 0.3], [0.0, 0.6]]))


@pytest.mark.parametrize("samples", [2, 3, 5, 9, 10, 28, 128, 241, 249, 250, 308, 500, 999, 10**6])
def test_four_fifths_of_any_record_are_scored(samples: int):
    window = score_window(samples)
    assert 1 <= window <= 50
    assert samples - window >= (0.8 * samples if samples >= 5 else 1)


def test_windows_that_are_given_stay_and_other_starts_have_none():
    record = Record(np.ones(300), np.ones(300), start="estimated")
    given = replace(record, skip=3), replace(record, start="zero"), replace(record, skip=150)
    dataset = Dataset("d", [record], [*given[::2]], [record, given[1]], selection=[record[:40]])
    found = dataset.with_windows()
    assert [*found.validation, found.tests[1], *found.selection] == [
        given[0], given[2], given[1], dataset.selection[0],
    ]  # fmt: skip
    assert found.tests[0].skip == 50
    assert found.train == [record]
    assert found.with_windows().tests == found.tests
    assert with_window(Record(np.ones(1), np.ones(1), start="estimated")).skip == 0


@pytest.mark.numeric
@pytest.mark.parametrize("memory", [0.0, 0.8])
@pytest.mark.parametrize(
    ("model", "T"),
    [
        (resonance(0.7, 0.5), 60),
        (resonance(0.99, 0.3), 300),  # lightly damped: memory of 100 samples
        (resonance(0.97, 0.1, ny=2), 200),
        (resonance(0.999, 0.0), 240),  # slower than the record
        (INTEGRATOR, 600),
    ],
)
def test_scores_are_the_errors_of_the_model(model: LinearModel, T: int, memory: float):
    """The mean square over some records, to a third: what the start state may add, and chance."""
    long = [cut_from(model, 4000, memory, seed)[0] for seed in (90, 91)]
    known = replace(model, state_covariance=state_moment(model.to_model(), long).numpy())
    found: list[float] = []
    true: list[float] = []
    for seed in range(12):
        record, e = cut_from(model, T, memory, seed)
        test = with_window(record)
        error = test.errors(known.simulate(test))
        found.append(float(np.mean(error**2)))
        true.append(float(np.mean(e[test.skip :] ** 2)))
    assert np.mean(found) < 1.33 * np.mean(true)


@pytest.mark.numeric
def test_the_states_of_the_training_data_say_what_few_outputs_do_not():
    """Of 10 noisy outputs, least squares makes more error than the model has."""
    model = resonance(0.97, 0.05)
    long, _ = cut_from(model, 4000, 0.0, 90)
    known = replace(model, state_covariance=state_moment(model.to_model(), long).numpy())
    unlikely = replace(model, state_covariance=1e12 * np.eye(2))
    errors: dict[str, list[float]] = {"known": [], "unlikely": [], "best": []}
    for seed in range(20):
        record, e = cut_from(model, 50, 0.0, seed, level=3.0)
        test = with_window(record)
        assert test.skip == 10
        errors["best"].append(float(np.mean(e[10:] ** 2)))
        for name, each in (("known", known), ("unlikely", unlikely)):
            errors[name].append(float(np.mean(test.errors(each.simulate(test)) ** 2)))
    best, known_error, unlikely_error = (
        np.mean(errors[name]) for name in ("best", "known", "unlikely")
    )
    assert known_error - best < 0.7 * (unlikely_error - best)


@pytest.mark.numeric
def test_a_fit_chooses_on_samples_that_its_start_is_not_fitted_to():
    model = resonance(0.9, 0.2)
    (train, _), (validation, _) = (cut_from(model, 200, 0.0, seed) for seed in (0, 1))
    start = lfrtorch.initialise(model, [train], nz=1, nw=1, nn=2)
    trainer = lfrtorch.LevenbergMarquardt(max_iter=1)
    result = lfrtorch.fit(start, train, validation, trainer=trainer)
    test = replace(validation, skip=40)
    expected = lfrtorch.rmse(test, result.model.simulate(test))
    assert result.history[result.chosen_iteration].validation == pytest.approx(expected, rel=1e-3)


@pytest.mark.numeric
def test_a_model_that_diverges_is_scored():
    record, _ = cut_from(resonance(0.9, 0.2), 300, 0.0, 0)
    unstable = replace(resonance(0.9, 0.2), A=np.diag([40.0, 0.5])).to_model()
    test = with_window(record)
    assert not np.isfinite(lfrtorch.rmse(test, unstable.simulate(test)))


def test_noise_has_the_memory_that_is_asked_for():
    e = noise_of(20_000, 0.8, seed=0)
    assert np.mean(e**2) == pytest.approx(1.0, rel=0.1)
    assert np.mean(e[1:] * e[:-1]) == pytest.approx(0.8, rel=0.1)
