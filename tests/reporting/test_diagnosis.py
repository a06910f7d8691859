"""The numbers of a fit come from its records and history, and tell one cause from another."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.signal

import lfrtorch
from lfrtorch._support.reasons import Reason
from lfrtorch.data.records import Channel, Record
from lfrtorch.fitting.trainer import FitResult, Progress, RestartSummary
from lfrtorch.reporting.advice import RULES, advise
from lfrtorch.reporting.diagnosis import (
    after_kept,
    chance_of_ratio,
    evidence,
    falling,
    noise_of_periods,
)
from lfrtorch.reporting.evaluation import Response

pytestmark = pytest.mark.numeric


def test_noise_is_what_differs_between_periods():
    rng = np.random.default_rng(1)
    u = np.tile(rng.standard_normal(500), 4)
    y = np.column_stack([u + 0.1 * rng.standard_normal(2000), 3 * u])
    found = noise_of_periods([Record(u, y, period=500)])
    assert found is not None
    # 1500 degrees of freedom: 2 %; 4 σ.
    assert found[0] == pytest.approx(0.1, rel=0.08)
    assert found[1] < 1e-12
    for record in (Record(u, y), Record(u[:500], y[:500], start="periodic")):
        assert noise_of_periods([record]) is None


def with_output(response: Response, y_hat: np.ndarray) -> Response:
    return replace(response, simulated={**response.simulated, "NL-LFR": y_hat})


def history(scores: list[float]) -> list[Progress]:
    return [Progress(i, 100, s, s, 1.0, True, {}, s**2) for i, s in enumerate(scores)]


@pytest.fixture(scope="module")
def fitted() -> tuple[FitResult, list[Response]]:
    """A first-order system with a wrong start, two outputs, the NL-LFR as its linear start."""
    rng = np.random.default_rng(0)
    u = rng.standard_normal((1200, 1))
    y = np.asarray(scipy.signal.lfilter([0.0, 0.5], [1.0, -0.9], u, axis=0), dtype=np.float64)
    y = np.hstack([y, 2 * y]) + 50.0 * 0.9 ** np.arange(1200)[:, None]
    outputs = (Channel("a", "m"), Channel("b"))
    train = Record(u[:800], y[:800], outputs=outputs, name="train")
    test = Record(2 * u[800:], y[800:], outputs=outputs, name="loud")
    bla = lfrtorch.estimate_bla(Record(u[100:800], y[100:800], outputs=outputs), nx=1)
    model = lfrtorch.initialise(bla, train, nz=1, nw=1, nn=2)
    starts = (
        RestartSummary(0, 20, 1.0, np.nan, np.nan, "converged"),
        RestartSummary(1, 20, 1.5, np.nan, np.nan, "converged"),
        RestartSummary(2, 2, 1.2, np.nan, np.nan, Reason.OTHERS_BETTER),
    )
    reason = "maximum number of iterations"
    result = FitResult(model, history([4.0, 2.0, 1.0]), 2, 1.0, 1.0, reason, starts)
    responses = [
        Response(r, use, {"linear": bla.simulate(r), "NL-LFR": model.simulate(r)})
        for r, use in ((train, "train"), (test, "test"))
    ]
    return result, responses


def test_evidence_is_measured_on_the_records(fitted):
    result, responses = fitted
    bla = lfrtorch.estimate_bla(responses[0].record[100:], nx=1)
    found = evidence(result, responses, noise_rms=0.1, bla=bla)
    deviation = responses[0].record.y.std(axis=0)
    assert found.noise == pytest.approx(np.sqrt(np.mean((0.1 / deviation) ** 2)))
    expected = np.sqrt(np.mean(np.mean(responses[0].error ** 2, axis=0) / deviation**2))
    assert found.train == pytest.approx(expected)
    assert (found.validation, found.linear_validation) == (None, None)
    assert found.transient is not None
    assert found.transient > 10.0
    assert found.free == pytest.approx(1.0, abs=0.2)
    assert (found.parameters, found.samples) == (result.model.net_parameter_count, 800)
    assert found.falling == 1.0 - 0.25**0.1  # of two iterations: a tenth of them, at their pace
    assert list(found.starts) == [1.0, 1.5]
    assert found.started == 3
    relaxed = lfrtorch.initialise(bla, responses[0].record, nz=1, nw=1, nn=2, relaxations=2)
    larger = replace(result, model=relaxed)
    assert evidence(larger, responses, bla=bla).sizes["nx"] == 1  # what a user gives
    assert set(found.outputs) == {"a", "b"}
    offset = result.model.scaler.u_offset
    test, train = (np.abs(r.record.u - offset).max() for r in responses[::-1])
    assert found.louder == {"loud": pytest.approx(test / train)}
    assert found.apart == {"loud": 0.0}  # the model is no mean
    of_two = replace(result, members=(result.model, relaxed))
    outputs = [model.simulate(responses[-1].record) for model in of_two.members]
    spread = (np.abs(outputs[0] - outputs[1]) / np.sqrt(2.0) / deviation)[
        responses[-1].record.skip :
    ]
    apart = evidence(of_two, responses).apart["loud"]
    assert apart == pytest.approx(np.sqrt(np.mean(spread**2)))
    texts = [item.text for item in advise(found)]
    assert any(text.startswith("The records do not begin at the model's rest") for text in texts)


def test_a_diverging_simulation_is_evidence_and_no_error(fitted):
    result, responses = fitted
    lost = with_output(responses[1], np.full_like(responses[1].y_hat, np.inf))
    found = evidence(result, [responses[0], lost])
    assert found.diverged == ["loud"]
    assert RULES["diverges"](found) is not None
    first = with_output(responses[0], np.full_like(responses[0].y_hat, np.nan))
    found = evidence(result, [first, lost])
    assert (found.train, found.linear, found.nonlinear) == (None, None, None)
    assert found.outputs == {}


def test_a_search_that_converged_or_rose_is_not_still_falling(fitted):
    result, _ = fitted
    assert falling(replace(result, reason="converged: the cost no longer falls")) == 0.0
    assert falling(replace(result, history=history([1.0, 0.5, 0.8]))) == 0.0
    assert falling(replace(result, history=history([1.0]))) == 0.0
    # 1 % at each of the last iterations but one, which is no better.
    pace = falling(replace(result, history=history([*(0.99**k for k in range(100)), 0.99**99])))
    assert 0.05 < pace < 1.0 - 0.99**10


def test_the_history_says_whether_validation_rose_while_training_fell(fitted):
    result, _ = fitted

    def told(train: list[float], validation: list[float], chosen: int) -> tuple[float, float]:
        pairs = zip(history(train), validation, strict=True)
        entries = [replace(progress, validation=v) for progress, v in pairs]
        return after_kept(replace(result, history=entries, chosen_iteration=chosen))

    falls = [1.0 / (k + 1) for k in range(12)]
    rises = [2.0, 1.0, *(1.1 + 0.1 * k for k in range(10))]
    assert told(falls, rises, 1) == (pytest.approx(1.55), pytest.approx(1 / 6))
    assert told(falls, [*rises[:-1], np.nan], 1)[0] == pytest.approx(1.55)
    assert told(falls, falls, 11) == (1.0, 1.0)
    assert told(falls, rises, 8) == (1.0, 1.0)  # too few to tell
    assert told(falls, 12 * [np.nan], 0) == (1.0, 1.0)


def system(samples: int = 2000, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Input and output, both of about 1 rms, of a resonance."""
    u = np.random.default_rng(seed).standard_normal((samples, 1))
    return u, 0.36 * resonant(u)


def resonant(u: np.ndarray) -> np.ndarray:
    return np.asarray(scipy.signal.lfilter([0.0, 0.0, 1.0], [1.0, -1.2, 0.8], u, axis=0))


@pytest.fixture(scope="module")
def resonance() -> tuple[FitResult, lfrtorch.LinearModel]:
    """A fit of it, and its linear model."""
    record = Record(*system())
    bla = lfrtorch.estimate_bla(record, nx=2)
    model = lfrtorch.initialise(bla, record, nz=1, nw=1, nn=4)
    return FitResult(model, history([1.0, 1.0]), 1, 1.0, 1.0, Reason.COST_SETTLED), bla


def told(resonance, *parts: tuple[str, np.ndarray, np.ndarray], **options) -> str:
    """Advice for records of these uses with these errors of the NL-LFR and the linear model."""
    result, bla = resonance
    responses = []
    for use, error, linear_error in parts:
        u, y = system(len(error))
        record = Record(u, y + error, name=use, **options)
        responses.append(Response(record, use, {"linear": record.y - linear_error, "NL-LFR": y}))
    return "\n".join(map(str, advise(evidence(result, responses, bla=bla))))


WHITE = np.random.default_rng(7).standard_normal((2000, 1))


def test_a_filtered_input_in_the_error_asks_for_states_and_white_noise_does_not(resonance):
    filtered = 0.1 * scipy.signal.lfilter([0.3], [1.0, -0.95], system()[0], axis=0)
    said = "The linear part is incomplete"
    for error, is_said in ((filtered, True), (0.1 * WHITE, False), (0.1 * system()[1] ** 2, False)):
        parts = [(use, error, error) for use in ("train", "validation")]
        assert (said in told(resonance, *parts)) is is_said


def test_squares_in_the_error_ask_for_a_larger_map_and_white_noise_does_not(resonance):
    square = 0.05 * (system()[1] ** 2 - 1.0)
    said = "Nonlinear behaviour is left"
    for error, is_said in ((square, True), (0.05 * WHITE, False), (0.05 * system()[0], False)):
        parts = [(use, error, 3 * error) for use in ("train", "validation")]
        assert (said in told(resonance, *parts)) is is_said


def test_a_free_response_is_a_wrong_start_and_a_loud_beginning_is_not(resonance):
    free = resonant(np.eye(2000, 1)) + 0.01 * WHITE
    loud = 0.01 * WHITE * np.where(np.arange(2000) < 60, 20.0, 1.0)[:, None]
    said = "do not begin at the model's rest"
    assert said in told(resonance, ("train", free, WHITE))
    assert said not in told(resonance, ("train", loud, WHITE))
    assert said not in told(resonance, ("train", free, WHITE), start="estimated")


@pytest.mark.parametrize("noisy", [True, False])
def test_what_differs_between_periods_is_noise_if_it_is_steady(noisy: bool, resonance):
    result, bla = resonance
    u = np.tile(system(1000)[0], (3, 1))
    u, y, error = u[1000:], 0.36 * resonant(u)[1000:], 0.05 * WHITE  # in steady state
    transient = 0.0 if noisy else 2.0 * 0.97 ** np.arange(2000)[:, None]
    record = Record(u, y + error * noisy + transient, period=1000)
    # An error that is as large as the differences would have it.
    size = np.sqrt(np.mean(np.diff(record.y.reshape(2, 1000), axis=0) ** 2) / 2)
    y_hat = y if noisy else record.y + size * WHITE
    seen = Response(record, "train", {"linear": 0.0 * y, "NL-LFR": y_hat})
    found = evidence(result, [seen], bla=bla)
    assert (RULES["at_the_noise"](found) is not None) is noisy


def test_validation_like_the_training_is_not_called_unlike(resonance):
    said = "The validation part is unlike"
    for factor, is_said in ((1.0, False), (1.3, False), (2.2, True)):
        parts = ("train", 0.1 * WHITE, 0.3 * WHITE), ("validation", WHITE, factor * 0.3 * WHITE)
        assert (said in told(resonance, *parts)) is is_said


def slow_errors(samples: int, seed: int) -> np.ndarray:
    """Errors with a memory of 30 samples, of the same size in each draw."""
    white = np.random.default_rng(seed).standard_normal(samples + 300)
    return np.asarray(scipy.signal.lfilter([0.24], [1.0, -0.97], white))[300:, None]


def test_a_short_part_with_slow_errors_is_unlike_by_chance(resonance):
    draws = [(slow_errors(1000, k), slow_errors(60, 100 + k)) for k in range(100)]
    ratios = [np.sqrt(np.mean(there**2) / np.mean(here**2)) for here, there in draws]
    differ = [not 1 / 1.5 < ratio < 1.5 for ratio in ratios]
    said = [chance_of_ratio([here], [there]) <= 0.01 for here, there in draws]
    # Beyond 1.5 in some 40 of 100 draws; by chance in some 3, of which the standard deviation is 2.
    assert sum(differ) > 25
    assert sum(d and s for d, s in zip(differ, said, strict=True)) <= 9
    at = max(range(100), key=lambda k: ratios[k] if not said[k] else 0.0)
    for factor, is_said in ((1.0, False), (10.0, True)):
        here, there = draws[at]
        parts = ("train", WHITE[:1000], here), ("validation", WHITE[:60], factor * there)
        assert ("The validation part is unlike" in told(resonance, *parts)) is is_said


def test_a_few_large_errors_are_a_few_degrees_of_freedom():
    burst = WHITE[:300] * np.where(np.arange(300) // 5 == 30, 20.0, 1.0)[:, None]
    assert np.sqrt(np.mean(burst**2)) > 1.5
    assert chance_of_ratio([WHITE], [burst]) > 0.1
    assert chance_of_ratio([WHITE], [2.0 * WHITE[:300]]) < 1e-3
    assert chance_of_ratio([WHITE], [WHITE[:5]]) == 1.0
    assert chance_of_ratio([0.0 * WHITE], [WHITE]) == 1.0
