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
from lfrtorch.reporting.diagnosis import coherent_part, evidence, falling, noise_of_periods
from lfrtorch.reporting.simulations import Response

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
    louder={"test": 1.0},
)
"""A fit of which nothing is to be said but that nonlinear behaviour is left."""


@pytest.mark.parametrize(
    ("rule", "change", "said"),
    [
        (advice.diverges, {"diverged": ["sweep"]}, "ridge=1e-3"),
        (advice.diverges, {"diverged": ["sweep"], "ridge": True}, "larger ridge"),
        (advice.starts_in_a_transient, {"transient": 4.0}, "skip=N"),
        (advice.still_falling, {"falling": 0.05}, "trainer=LevenbergMarquardt(max_iter=400)"),
        (advice.still_falling, {"falling": 0.05, "trainer": "Adam"}, "trainer=Adam(max_iter=400)"),
        (advice.overfits, {"validation": 0.05}, "nn=5, ridge=1e-3, or more data"),
        (advice.linear_part_incomplete, {"linear": 0.5}, "nx=4, nx=5 or nx='auto'"),
        (advice.hardly_better, {"validation": 0.19}, "nn=20, nz=2 or nw=2"),
        (
            advice.hardly_better,
            {"validation": 0.19, "linear_train": 0.01},
            "linear model is enough",
        ),
        (advice.outputs_left_out, {"outputs": {"y1": 0.95, "y2": 0.1}}, "nw=2, nz=2"),
        (advice.best_start_alone, {"starts": (0.02, 0.03)}, "starts=16"),
        (advice.one_start, {"started": 1}, "starts=8"),
        (advice.tests_are_louder, {"louder": {"arrow": 1.5}}, "train on inputs as loud"),
        (advice.noise_unknown, {"noise": None}, "nx='auto', nz='auto', nw='auto', nn='auto'"),
        (
            advice.noise_unknown,
            {"noise": None, "searched": True},
            "of a periodic input for training.",
        ),
        (advice.hardly_better, {"validation": 0.199, "searched": True}, "sizes that were searched"),
        (advice.at_the_noise, {"train": 0.0105, "validation": 0.011}, "nothing to gain"),
    ],
)
def test_a_rule_speaks_if_its_number_says_so(rule, change, said):
    assert rule(GOOD) is None
    found = rule(replace(GOOD, **change))
    assert said in found.text
    assert found.evidence
    assert found in advise(replace(GOOD, **change))


def test_nonlinear_behaviour_is_left_where_the_error_is_neither_noise_nor_linear():
    rule = advice.nonlinear_part_incomplete
    polynomial = replace(GOOD, sizes={"nx": 3, "nz": 1, "nw": 1, "degree": 3})
    seen = replace(GOOD, noise=None, nonlinear=0.3)
    for found, said in (
        (rule(GOOD), "nn=20, nz=2 or nw=2. (training error 2.00 times the noise"),
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
        GOOD, train=0.01, validation=0.011, linear=0.5, falling=0.05, started=1,
        louder={"test": 2.0},
    )  # fmt: skip
    assert [item.text.split(":")[0] for item in advise(noisy)] == [
        "Noise-limited",
        "Some tests extrapolate",
    ]
    # Below the noise on training and above it on validation is overfit.
    assert advise(replace(noisy, train=0.007, linear=0.0, falling=0.0))[0].text.startswith(
        "Overfit"
    )


def test_missing_states_come_before_a_larger_map():
    useless = replace(GOOD, train=0.2, validation=0.2, linear=0.9, outputs={}, noise=None)
    assert [item.text for item in advise(useless)] == [
        "The linear part is incomplete: nx=4, nx=5 or nx='auto'."
    ]


def test_what_spoils_the_linear_model_as_much_is_no_overfit():
    assert advice.overfits(replace(GOOD, validation=0.06, linear_validation=0.6)) is None


def test_a_model_that_diverges_everywhere_has_advice():
    texts = [
        item.text for item in advise(Evidence(None, 0.2, None, 0.2, starts=(), diverged=["a", "b"]))
    ]
    assert texts[0].startswith("The model is not usable yet")


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
    found = evidence(result, responses, noise_rms=0.1)
    deviation = responses[0].record.y.std(axis=0)
    assert found.noise == pytest.approx(np.sqrt(np.mean((0.1 / deviation) ** 2)))
    expected = np.sqrt(np.mean(np.mean(responses[0].error ** 2, axis=0) / deviation**2))
    assert found.train == pytest.approx(expected)
    assert (found.validation, found.linear_validation) == (None, None)
    assert found.transient is not None
    assert found.transient > 10.0
    assert found.falling == 0.5
    assert list(found.starts) == [1.0, 1.5]
    assert found.started == 3
    assert set(found.outputs) == {"a", "b"}
    offset = result.model.scaler.u_offset
    test, train = (np.abs(r.record.u - offset).max() for r in responses[::-1])
    assert found.louder == {"loud": pytest.approx(test / train)}
    texts = [item.text for item in advise(found)]
    assert any(text.startswith("The records do not begin at rest") for text in texts)


def test_a_diverging_simulation_is_evidence_and_no_error(fitted):
    result, responses = fitted
    lost = replace(responses[1], y_hat=np.full_like(responses[1].y_hat, np.inf))
    found = evidence(result, [responses[0], lost])
    assert found.diverged == ["loud"]
    first = replace(responses[0], y_hat=np.full_like(responses[0].y_hat, np.nan))
    found = evidence(result, [first, lost])
    assert (found.train, found.linear, found.nonlinear) == (None, None, None)
    assert found.outputs == {}


def test_a_search_that_converged_or_rose_is_not_still_falling(fitted):
    result, _ = fitted
    assert falling(replace(result, reason="converged: the cost no longer falls")) == 0.0
    assert falling(replace(result, history=history([1.0, 0.5, 0.8]))) == 0.0
    assert falling(replace(result, history=history([1.0]))) == 0.0
