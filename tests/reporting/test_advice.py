"""Advice is what the numbers of a fit say: each rule speaks when it should, and only then."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.signal

import lfrtorch
from lfrtorch._support.reasons import Reason
from lfrtorch.fitting.trainer import FitResult, Progress, RestartSummary
from lfrtorch.records import Channel, Record
from lfrtorch.reporting import advice
from lfrtorch.reporting.advice import Evidence, advise
from lfrtorch.reporting.diagnosis import (
    coherent_part,
    evidence,
    falling,
    filtered_part,
    noise_of_periods,
)
from lfrtorch.reporting.simulations import Response
from lfrtorch.reporting.verdict import NEITHER, Kind, Verdict

pytestmark = pytest.mark.numeric

GOOD = Evidence(
    train=0.02,
    linear_train=0.2,
    validation=0.021,
    linear_validation=0.2,
    outputs={"y1": 0.1, "y2": 0.1},
    noise=0.01,
    linear=0.01,
    nonlinear=0.01,
    transient=1.0,
    iterations=100,
    starts=(0.021, 0.022, 0.03),
    started=8,
    sizes={"nx": 3, "nz": 1, "nw": 1, "nn": 10},
    searched=True,
    louder={"test": 1.0},
)
"""A fit of which nothing is to be said but that nonlinear behaviour is left."""


def verdict(kind: Kind, use: str = "linear model") -> Verdict:
    return Verdict(kind, "", use)


UNUSABLE = verdict(Kind.LINEAR, NEITHER)

SETTINGS = lfrtorch.Settings(nx=3, nz=1, nw=1, nn=10)


@pytest.mark.parametrize(
    ("rule", "change", "said"),
    [
        (advice.diverges, {"diverged": ["sweep"]}, "ridge=1e-3"),
        (advice.diverges, {"diverged": ["sweep"], "ridge": True}, "larger ridge"),
        (advice.diverges, {"diverged": [f"sweep {k}" for k in range(99)]}, "use ridge=1e-3"),
        (advice.starts_in_a_transient, {"transient": 4.0, "free": 0.9}, "skip=N"),
        (advice.nothing_held_out, {"validation": None, "linear_validation": None}, "hold out"),
        (advice.validation_is_unlike, {"linear_validation": 0.4}, "cross-validate"),
        (advice.validation_is_unlike, {"linear_validation": 0.1}, "cross-validate"),
        (advice.still_falling, {"falling": 0.05}, "trainer=LevenbergMarquardt(max_iter=400)"),
        (
            advice.still_falling,
            {"falling": 0.05, "trainer": lfrtorch.Adam()},
            "trainer=Adam(max_iter=400)",
        ),
        (advice.overfits, {"validation": 0.05}, "nn=5, ridge=1e-3, or more data"),
        (advice.linear_part_incomplete, {"linear": 0.5}, "nx=4, nx=5 or nx='auto'"),
        (
            advice.hardly_better,
            {"validation": 0.19, "linear_train": 0.01, "linear_validation": 0.01},
            "linear model is enough",
        ),
        (advice.outputs_left_out, {"outputs": {"y1": 0.95, "y2": 0.1}}, "nw=2, nz=2"),
        (advice.best_start_alone, {"starts": (0.02, 0.03)}, "starts=16"),
        (advice.one_start, {"started": 1}, "starts=8"),
        (advice.tests_are_louder, {"louder": {"arrow": 1.5}}, "train on inputs as loud"),
        (advice.noise_unknown, {"noise": None}, "in steady state for training."),
        (advice.choose_sizes, {"searched": False}, "nx='auto', nz='auto', nw='auto', nn='auto'"),
        (advice.largest_sizes, {"largest": ["nn"]}, "nn=10"),
        (advice.hardly_better, {"validation": 0.199}, "at any size searched"),
        (
            advice.hardly_better,
            {"validation": 0.199, "searched": False, "linear": None, "started": 1},
            "starts=8, nx=4, nn=20, nz=2, nw=2",
        ),
        (advice.at_the_noise, {"train": 0.0105, "validation": 0.011}, "nothing to gain"),
        (advice.neither_usable, {"verdict": UNUSABLE}, "hold in training alone"),
        (
            advice.neither_usable,
            {"verdict": UNUSABLE, "train": 0.95, "linear_train": 0.97, "linear_validation": 0.98},
            "look at the columns",
        ),
        (advice.gain_is_lost, {"tests": 1.5}, "measure longer"),
    ],
)
def test_a_rule_speaks_if_its_number_says_so(rule, change, said):
    assert rule(GOOD) is None
    found = rule(replace(GOOD, **change))
    assert said in found.text
    assert found.evidence
    assert max(len(found.text), len(found.evidence)) <= 160
    assert found in advise(replace(GOOD, **change))
    if found.change is not None:
        assert replace(SETTINGS, **found.change) != SETTINGS


def test_nonlinear_behaviour_is_left_where_the_error_is_neither_noise_nor_linear():
    rule = advice.nonlinear_part_incomplete
    polynomial = replace(GOOD, sizes={"nx": 3, "nz": 1, "nw": 1, "degree": 3})
    seen = replace(GOOD, noise=None, nonlinear=0.3)
    for found, said in (
        (rule(GOOD), "nn=20, nz=2, nw=2. (training error 2.00 times the noise"),
        (rule(polynomial), "degree=5"),
        (rule(seen), "30.0 % of the error's power"),
    ):
        assert said in str(found)
    for other in (
        {"linear": 0.5},  # states first
        {"noise": 0.015},  # 1.33 times the noise
        {"validation": 0.19},  # the linear model is as good
        {"noise": None},  # and no squares in the error
    ):
        assert rule(replace(GOOD, **other)) is None


def test_at_the_noise_nothing_larger_is_advised():
    noisy = replace(
        GOOD, train=0.01, validation=0.011, linear=0.5, started=1,
        louder={"test": 2.0},
    )  # fmt: skip
    assert [item.text.split(":")[0] for item in advise(noisy)] == [
        "Noise-limited",
        "Some tests extrapolate",
    ]
    # Below the noise on training and above it on validation is overfit.
    assert advise(replace(noisy, train=0.007, linear=0.0))[0].text.startswith("Overfit")
    # A search that goes on, or an error below the noise, says that the noise is not known so well.
    for change in ({"falling": 0.05}, {"train": 0.005, "validation": 0.005}):
        assert advice.at_the_noise(replace(noisy, **change)) is None


def test_missing_states_come_before_a_larger_map():
    useless = replace(GOOD, train=0.2, validation=0.2, linear=0.9, outputs={}, noise=None)
    useless = replace(useless, searched=False)
    states, sizes = (item.text for item in advise(useless))
    assert states == "The linear part is incomplete: nx=4, nx=5 or nx='auto'."
    assert sizes.startswith("Let validation choose the sizes")


def test_what_spoils_the_linear_model_as_much_is_no_overfit():
    unlike = replace(GOOD, validation=0.06, linear_validation=0.6)
    assert advice.overfits(unlike) is None
    assert advice.overfits(replace(unlike, validation=0.027, linear_validation=0.27)) is None


def test_what_is_seen_on_unlike_parts_is_not_the_system():
    """The linear model is as good on a validation part of which it is no model."""
    unlike = replace(GOOD, linear_train=0.01, validation=0.98, linear_validation=0.98)
    texts = [item.text for item in advise(unlike)]
    assert texts[0].startswith("The validation part is unlike the training part")
    assert not any("linear" in text for text in texts[1:])


def test_without_validation_nothing_rests_on_it():
    alone = replace(GOOD, validation=None, linear_validation=None, falling=0.1, searched=False)
    texts = [item.text for item in advise(alone)]
    assert texts[0].startswith("Overfitting would not show: hold out a part")
    assert not any("auto" in text or "Still falling" in text for text in texts)
    assert advice.one_start(replace(alone, started=1)) is None


def test_a_model_that_diverges_everywhere_has_advice():
    texts = [
        item.text for item in advise(Evidence(None, 0.2, None, 0.2, starts=(), diverged=["a", "b"]))
    ]
    assert texts[0].startswith("The model is not usable yet")


@pytest.mark.parametrize("searched", [True, False])
def test_what_the_verdict_calls_better_is_not_called_hardly_better(searched: bool):
    small = replace(GOOD, validation=0.19, started=1, searched=searched)
    quiet = {"linear_train": 0.0105, "linear_validation": 0.0105, "validation": 0.01}
    for change in ({}, quiet):
        said = str(advice.hardly_better(replace(small, **change)))
        assert "linear at this level" in said
        seen = replace(small, verdict=verdict(Kind.BETTER, "NL-LFR"), **change)
        found = str(advice.hardly_better(seen))
        assert "linear at this level" not in found
        assert "Hardly better" not in found


def test_no_system_is_called_linear_where_neither_model_is_usable():
    useless = replace(GOOD, train=0.95, linear_train=0.97, validation=0.98, linear_validation=1.0)
    useless = replace(useless, noise=None, verdict=UNUSABLE)
    texts = [item.text for item in advise(useless)]
    assert texts[0].startswith("The inputs explain little")
    assert not any("linear at this level" in text for text in texts)


def test_a_gain_that_the_tests_have_not_asks_for_no_larger_map():
    lost = replace(GOOD, tests=1.5, outputs={"y1": 0.95, "y2": 0.1})
    texts = [item.text for item in advise(lost)]
    assert texts[0].startswith("The gain on validation is lost on the tests")
    assert not any("nw=" in text for text in texts)
    shown = replace(lost, validation=None, linear_validation=None)
    assert not any("Overfitting would not show" in item.text for item in advise(shown))
    for change in ({"tests": 0.5}, {"verdict": verdict(Kind.BETTER, "NL-LFR")}):
        texts = [item.text for item in advise(replace(lost, **change))]
        assert texts[0].startswith("Some outputs gain nothing")


def test_a_linear_filter_of_the_input_is_seen_in_the_error():
    rng = np.random.default_rng(0)
    u, noise = rng.standard_normal((4000, 1)), rng.standard_normal((4000, 1))
    filtered = scipy.signal.lfilter([1.0], [1.0, -0.8], u, axis=0)
    both = filtered / filtered.std() + noise
    # Half of the power; Welch's bias is corrected to within 0.1 at 8 segments.
    assert coherent_part([u], [both]) == pytest.approx(0.5, abs=0.1)
    assert coherent_part([u], [noise]) == pytest.approx(0.0, abs=0.1)
    assert coherent_part([u, u], [filtered, filtered]) == pytest.approx(1.0, abs=0.05)
    assert coherent_part([u[:60]], [noise[:60]]) is None
    # Filters fitted in time: 300 samples and 37 lags leave a standard deviation of 0.06.
    assert coherent_part([u[:300]], [both[:300]]) == pytest.approx(0.5, abs=0.2)
    assert coherent_part([u[:300]], [noise[:300]]) == pytest.approx(0.0, abs=0.2)
    # An error as slow as the input is explained in part by chance.
    slow, other = (scipy.signal.lfilter([1.0], [1.0, -0.97], x, axis=0) for x in (u, noise))
    assert filtered_part([slow[:300]], [other[:300]], 37) == pytest.approx(0.0, abs=0.25)
    parts = [u[:300], u[300:600]], [filtered[:300], filtered[300:600]]
    assert coherent_part(*parts) == pytest.approx(1.0, abs=0.1)
    assert coherent_part([u], [0.0 * noise]) == 0.0
    assert coherent_part([0.0 * u], [noise]) == pytest.approx(0.0, abs=0.1)


def test_noise_is_what_differs_between_periods():
    rng = np.random.default_rng(1)
    u = np.tile(rng.standard_normal(500), 4)
    y = np.column_stack([u + 0.1 * rng.standard_normal(2000), 3 * u])
    found = noise_of_periods([Record(u, y, period=500)])
    assert found is not None
    # 1500 degrees of freedom: 2 %; 4 σ.
    assert found[0] == pytest.approx(0.1, rel=0.08)
    assert found[1] < 1e-12
    assert noise_of_periods([Record(u, y)]) is None
    assert noise_of_periods([Record(u[:500], y[:500], start="periodic")]) is None


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
    result = FitResult(
        model, history([4.0, 2.0, 1.0]), 2, 1.0, 1.0, "maximum number of iterations", starts
    )
    responses = [
        Response(r, use, bla.simulate(r), model.simulate(r))
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
    assert set(found.outputs) == {"a", "b"}
    offset = result.model.scaler.u_offset
    test, train = (np.abs(r.record.u - offset).max() for r in responses[::-1])
    assert found.louder == {"loud": pytest.approx(test / train)}
    texts = [item.text for item in advise(found)]
    assert any(text.startswith("The records do not begin at the model's rest") for text in texts)


def test_a_diverging_simulation_is_evidence_and_no_error(fitted):
    result, responses = fitted
    lost = replace(responses[1], y_hat=np.full_like(responses[1].y_hat, np.inf))
    found = evidence(result, [responses[0], lost])
    assert found.diverged == ["loud"]
    assert advice.diverges(found) is not None
    first = replace(responses[0], y_hat=np.full_like(responses[0].y_hat, np.nan))
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
        responses.append(Response(record, use, record.y - linear_error, y))
    return "\n".join(map(str, advise(evidence(result, responses, bla=bla))))


WHITE = np.random.default_rng(7).standard_normal((2000, 1))


def test_a_filtered_input_in_the_error_asks_for_states_and_white_noise_does_not(resonance):
    filtered = 0.1 * scipy.signal.lfilter([0.3], [1.0, -0.95], system()[0], axis=0)
    said = "The linear part is incomplete"
    assert said in told(
        resonance, ("train", filtered, filtered), ("validation", filtered, filtered)
    )
    for error in (0.1 * WHITE, 0.1 * system()[1] ** 2):
        assert said not in told(resonance, ("train", error, error), ("validation", error, error))


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
    found = evidence(result, [Response(record, "train", 0.0 * y, y_hat)], bla=bla)
    assert (advice.at_the_noise(found) is not None) is noisy


def test_validation_like_the_training_is_not_called_unlike(resonance):
    said = "The validation part is unlike"
    for factor, is_said in ((1.0, False), (1.3, False), (2.2, True)):
        parts = ("train", 0.1 * WHITE, 0.3 * WHITE), ("validation", WHITE, factor * 0.3 * WHITE)
        assert (said in told(resonance, *parts)) is is_said
