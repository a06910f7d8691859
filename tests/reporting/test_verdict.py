"""The verdict on a fit follows from errors on what was not fitted, and from their uncertainty."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest

from lfrtorch._support.reasons import Reason
from lfrtorch.data.metrics import rms
from lfrtorch.data.records import Record
from lfrtorch.fitting.trainer import FitResult
from lfrtorch.reporting import verdict
from lfrtorch.reporting.evaluation import CROSS, Response
from lfrtorch.reporting.verdict import Comparison, Kind, Verdict

judge = partial(verdict.judge, linear_nx=2)
judge_predictions = partial(verdict.judge_predictions, linear_nx=2)
LONG = "a_measurement_with_a_name_that_is_longer_than_any_line_of_a_terminal" * 2


def result(reason: str = Reason.COST_SETTLED, chosen: int = 3) -> FitResult:
    unused: Any = None
    return FitResult(unused, [], chosen, 1.0, 1.0, reason)


def response(
    use: str, part: float | np.ndarray, *, name: str = "", noise: float = 0.0, linear: float = 0.1
) -> Response:
    """An NL-LFR with a part of the linear model's error, and an error of its own."""
    rng = np.random.default_rng(len(name))
    y, error, own = rng.standard_normal((3, 1000, 1))
    part = np.reshape(part, (-1, 1))
    y_hat = y + linear * (part * error + noise * own)
    simulated = {"linear": y + linear * error, "NL-LFR": y_hat}
    return Response(Record(y, y, name=name or use), use, simulated)


def cut(whole: Response, samples: int) -> Response:
    """The beginning of a record with its simulations."""
    simulated = {name: y[:samples] for name, y in whole.simulated.items()}
    return Response(whole.record[:samples], whole.use, simulated)


def compared(found: Verdict) -> Comparison:
    assert found.evidence.whole is not None
    return found.evidence.whole


TRAIN = response("train", 0.2)
BURST = np.where(np.arange(1000) // 20 == 30, 25.0, 0.2)
"""0.2 of the linear model's error, but for twenty samples."""


@pytest.mark.parametrize(
    ("kind", "use", "colour", "said", "others"),
    [
        ("better", "NL-LFR", "green", "on test the NL-LFR's error is 50.0 %",
         [response("test", 0.5)]),
        ("better", "NL-LFR", "green", "on 2 test records",
         [response("test", 0.5, name="a"), response("test", 0.8, name="b")]),
        ("better", "NL-LFR", "green", "on validation", [response("validation", 0.5)]),
        # Better on validation, which chose the iterate, and not on the test.
        ("linear", "linear model", "amber", "As the linear model (nx 2): on test the errors are",
         [response("validation", 0.5), response("test", 1.0)]),
        # Better by less than what is worth a choice, and worse by as little.
        ("linear", "linear model", "amber", "use the linear model", [response("test", 0.97)]),
        ("linear", "linear model", "amber", "use the linear model", [response("test", 1.03)]),
        ("worse", "linear model", "red", "on test 'b' the NL-LFR's error is 3.00 times",
         [response("test", 0.1, name="a"), response("test", 3.0, name="b"),
          response("test", 1.5, name="c")]),
        ("worse", "linear model", "red", "on validation", [response("validation", 1.2)]),
        ("worse", "linear model", "red", "on test ", [response("test", BURST)]),
        ("diverges", "linear model", "red", "diverges on test 'b' and 1 more",
         [response("test", 0.1), response("test", np.inf, name="b"),
          response("test", np.nan, name="c")]),
        ("diverges", "neither", "red", "neither is usable", [response("test", np.nan, linear=2.0)]),
        ("better", "neither", "red", "Neither model is usable", [response("test", 0.7, linear=3)]),
        ("linear", "neither", "red", "Neither model is usable", [response("test", 1.0, linear=2)]),
        ("unjudged", "NL-LFR", "grey", "nothing held out", []),
    ],
)  # fmt: skip
def test_records_that_were_not_fitted_make_the_verdict(kind, use, colour, said, others):
    found = judge(result(), [TRAIN, *others])
    assert (found.kind, found.use, found.colour) == (kind, use, colour)
    assert said in found.text


def test_a_difference_is_judged_by_its_standard_error():
    # Errors that share nothing: 0.93 of the linear model's, by chance or by many samples.
    few, many = (response("test", 0.0, noise=0.93, name=name) for name in ("few", "many"))
    few = cut(few, 60)
    more = [response("test", 0.0, noise=0.93, name="n" * k) for k in range(1, 30)]
    assert judge(result(), [TRAIN, few]).kind == Kind.LINEAR
    assert judge(result(), [TRAIN, many, *more]).kind == Kind.BETTER


def test_better_in_every_block_is_better_where_one_resonance_has_the_error():
    rng = np.random.default_rng(1)
    linear = rng.normal(size=(1000, 1))
    linear[400:500] *= 30.0
    y = rng.normal(size=(1000, 1))
    own = (0.5 + 0.2 * rng.random((1000, 1))) * linear
    record = Record(np.zeros((1000, 1)), y)
    found = judge(result(), [Response(record, "test", {"linear": y - linear, "NL-LFR": y - own})])
    assert found.kind == Kind.BETTER, found.text


@pytest.mark.parametrize(
    ("poor", "cross", "other"),
    [(2.2, Kind.BETTER, Kind.LINEAR), (30.0, Kind.BETTER, Kind.WORSE)],
)
def test_one_poor_stretch_does_not_decide_in_cross_validation(
    poor: float, cross: Kind, other: Kind
):
    part = np.where(np.arange(1000) // 100 == 4, poor, 0.4)
    kinds = [
        judge(result(), [TRAIN, response("validation", part, name=name)]).kind
        for name in (CROSS, "other")
    ]
    assert kinds == [cross, other]


def test_a_verdict_that_a_runaway_hides_speaks_of_most_blocks():
    part = np.where(np.arange(1000) // 100 == 4, 30.0, 0.4)
    found = judge(result(), [TRAIN, response("validation", part, name=CROSS)])
    assert compared(found).ratio > 1.0
    assert "on cross-validation the NL-LFR's error is in most blocks 5" in found.text
    alike = judge(result(), [TRAIN, response("validation", 0.4, name=CROSS)])
    assert "is 40.0 % of the linear model's" in alike.text


def test_a_runaway_of_the_linear_model_in_one_stretch_is_no_merit_of_the_other():
    """Elsewhere the NL-LFR is worse: by the error of all it is better by far."""
    whole = response("validation", 1.3, name=CROSS)
    there = np.arange(1000)[:, None] // 100 == 4
    y_linear = np.where(there, whole.y_linear + 10.0, whole.y_linear)
    y_hat = np.where(there, whole.record.y, whole.y_hat)
    found = replace(whole, simulated={"linear": y_linear, "NL-LFR": y_hat})
    assert rms(found.error) < 0.1 * rms(found.linear_error)
    assert judge(result(), [TRAIN, found]).kind == Kind.LINEAR


@pytest.mark.parametrize("part", [0.1, 0.8, 3.0])
def test_the_standard_error_is_how_far_the_ratio_varies(part: float):
    rng = np.random.default_rng(5)
    still = np.zeros((1000, 1))
    found = []
    for _ in range(200):
        shared, own = rng.standard_normal((2, 1000, 1))
        y = rng.standard_normal((1000, 1))
        parts = {"linear": y + shared, "NL-LFR": y + part * (0.8 * shared + 0.6 * own)}
        found.append(compared(judge(result(), [Response(Record(still, y), "test", parts)])))
    ratios, errors = (
        np.array([getattr(each, key) for each in found]) for key in ("ratio", "ratio_std")
    )
    # 200 draws tell a standard deviation to 5 %, and ten blocks have a bias of 3 %.
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(ratios.std(), rel=0.2)


def test_a_fit_that_kept_its_start_is_as_the_linear_model():
    almost = response("test", 1.0 + 1e-9)
    assert "the fit kept its start" in judge(result(chosen=0), [TRAIN, almost]).text
    other = judge(result(chosen=0), [TRAIN, response("test", 0.97, noise=0.2)])
    assert other.text.startswith("Not better than the linear model")


def test_one_of_many_records_is_worse_by_chance():
    # Thirty comparisons at one in forty each: one would be called worse without a share of each.
    tests = [response("test", 0.0, noise=1.0, name="n" * k) for k in range(1, 31)]
    assert max(compared(judge(result(), [TRAIN, test])).deviations for test in tests) > 2.0
    assert judge(result(), [TRAIN, *tests]).kind == Kind.LINEAR


def test_a_failed_search_is_no_model():
    found = judge(result(Reason.GRADIENT_DIVERGED, 0), [TRAIN, response("test", 1.0)])
    assert (found.kind, found.use) == (Kind.DIVERGES, "linear model")
    assert "not trained" in found.text
    kept = judge(result(Reason.GRADIENT_DIVERGED, 5), [TRAIN, response("test", 0.3)])
    assert kept.kind == Kind.BETTER


@pytest.mark.parametrize(
    ("parts", "kind", "said"),
    [
        ((0.97, 0.78, 0.69), "better", "error 10 ahead is 78.0 % of the linear model's, 97.0"),
        ((0.97, 0.97, 0.69), "better", "error 100 ahead is 69.0 % of the linear model's, 97.0"),
        ((0.97, 0.97, 0.97), "linear", "use the linear model"),
        ((0.97, 0.78, 1.50), "linear", "use the linear model"),
        ((0.97, 0.78, np.inf), "linear", "use the linear model"),
        ((0.68, 0.78, 0.95), "better", "1, 10 and 100 samples ahead are 68.0, 78.0 and 95.0 % of"),
        ((0.68, 0.78, 15.0), "worse", "68.0 % of its, but 15.0 times as large 100 samples ahead"),
        ((0.68, 1.30, 0.90), "worse", "68.0 % of its, but 1.30 times as large 10 samples ahead"),
        ((0.68, 0.78, np.nan), "diverges", "but it diverges 100 samples ahead; use the"),
        ((3.00, 0.50, 0.50), "worse", "prediction error is 3.00 times as large"),
    ],
)  # fmt: skip
def test_predictions_are_judged_near_and_far(parts, kind, said):
    views = {
        ahead: [TRAIN, response("test", part, name=LONG)]
        for ahead, part in zip((1, 10, 100), parts, strict=True)
    }
    found = judge_predictions(result(), views)
    assert found.kind == kind
    assert said in found.text
    assert len(found.text) <= 160
    assert (found.use == "NL-LFR") == (kind == "better")


def test_where_nothing_can_be_foreseen_a_small_loss_is_none():
    near, far = response("test", 0.7), response("test", 1.1, linear=3.0)
    assert judge_predictions(result(), {1: [TRAIN, near], 100: [TRAIN, far]}).kind == Kind.BETTER
    lost = response("test", 1e5, linear=3.0)
    assert judge_predictions(result(), {1: [TRAIN, near], 100: [TRAIN, lost]}).kind == Kind.WORSE


@pytest.mark.parametrize("part", [0.1, 0.97])
def test_a_model_with_smaller_errors_can_be_refused(part: float):
    refusal = verdict.Refusal("it does not forget where it began")
    responses = [TRAIN, response("test", part, name=LONG)]
    found = judge(result(), responses, error="prediction error", refusals=[refusal])
    assert found.use == "linear model"
    assert (found.kind == "worse") == (refusal.text in found.text) == (part == 0.1)
    assert len(found.text) <= 160


def settled(use: str, part: float, *, noise: float = 0.01, name: str = "") -> Response:
    """The end of a step, where nothing but noise is left, with errors as large as that."""
    rng = np.random.default_rng(3)
    y = 2.0 + noise * rng.standard_normal((1000, 1))
    linear = y + noise * rng.standard_normal((1000, 1))
    simulated = {"linear": linear, "NL-LFR": y + part * (linear - y)}
    return Response(Record(np.ones(1000), y, name=name or use), use, simulated)


def test_a_test_that_has_settled_shows_no_better_model():
    found = judge(result(), [TRAIN, settled("test", 0.1)])
    assert (found.kind, found.use, found.colour) == ("unjudged", "linear model", "grey")
    assert "test settled and shows only the static gain; use the linear model" in found.text
    # Other parts that move decide in its place.
    moving = judge(result(), [TRAIN, response("validation", 0.5), settled("test", 0.1)])
    assert (moving.kind, moving.use) == ("better", "NL-LFR")
    assert "on validation" in moving.text
    assert "(test settled)" in moving.text
    both = judge(result(), [TRAIN, response("test", 0.5, name="a"), settled("test", 0.1)])
    assert "settled" not in both.text
    # A gain that is wrong is seen there.
    assert judge(result(), [TRAIN, settled("test", 60.0)]).kind == Kind.WORSE


def test_an_input_that_goes_on_is_no_end_of_a_step():
    u = np.random.default_rng(1).standard_normal((1000, 1))
    quiet = settled("test", 0.1)
    moved = Response(Record(u, quiet.record.y, name="test"), "test", quiet.simulated)
    assert judge(result(), [TRAIN, moved]).kind == Kind.BETTER


def test_errors_are_relative_to_what_all_records_do():
    # As large as the deviation of the test, and a hundredth of that in training.
    u = np.random.default_rng(1).standard_normal((1000, 1))
    quiet = settled("test", 1.0)
    moved = Response(Record(u, quiet.record.y, name="test"), "test", quiet.simulated)
    found = judge(result(), [TRAIN, moved])
    assert (found.kind, found.use) == ("linear", "linear model")
    assert compared(found).linear_nrmse == pytest.approx(0.01, rel=0.1)


def test_an_opponent_that_is_worse_than_a_constant_is_called_so():
    found = judge(result(), [TRAIN, response("test", 0.2, linear=1.3)])
    assert found.text.startswith(
        "Better than the linear model (nx 2), itself worse than a constant"
    )
    assert "constant" not in judge(result(), [TRAIN, response("test", 0.2, linear=0.8)]).text


def test_the_training_error_alone_is_no_verdict():
    assert judge(result(), [response("train", 1.0)]).use == "linear model"
    short = cut(response("test", 3.0), 5)
    assert judge(result(), [TRAIN, short]).kind == Kind.UNJUDGED
    assert judge(result(), [short]).kind == Kind.UNJUDGED


def test_outputs_that_rest_are_no_error():
    rest = np.zeros((1000, 1))
    still = Response(Record(rest, rest, name="rest"), "test", {"linear": rest, "NL-LFR": rest})
    assert judge(result(), [TRAIN, still]).use == "linear model"


@pytest.mark.parametrize("part", [0.1, 0.999, 1.0, 12345.6, np.nan])
@pytest.mark.parametrize("linear", [0.1, 2.0])
@pytest.mark.parametrize("use", ["train", "validation", "test"])
def test_a_verdict_is_one_line(part: float, linear: float, use: str):
    many = [response(use, part, name=LONG, linear=linear)] * 12
    for responses in (many[:1], many):
        found: Verdict = judge(result(), responses, linear_nx=12, error="prediction error")
        assert "nx 12" in found.text or found.kind == Kind.DIVERGES
        assert len(found.text) <= 160
        assert found.text.endswith(".")
        assert str(found) == found.text


def test_a_linear_model_that_explains_nothing_is_called_so():
    good, bad = response("test", 0.0, linear=0.25), response("test", 0.0, linear=2.5)
    judged = verdict.judge_linear([TRAIN, good])
    assert judged.nrmse == pytest.approx(0.25, rel=0.1)
    assert judged.text == (
        f"On test the linear model's error is {100 * (judged.nrmse or 0.0):.1f} % of the standard "
        "deviation of the output."
    )
    found = verdict.judge_linear([TRAIN, response("validation", 0.0), bad])
    assert not found.usable
    assert found.text.startswith("Not usable: on test ")
    assert "of the output, worse than a constant (in training 1" in found.text
    assert verdict.judge_linear([TRAIN]).on == "train"
    lost = Response(good.record, "test", {"linear": np.full((1000, 1), np.nan)})
    assert not verdict.judge_linear([TRAIN, lost]).usable
    rest = np.zeros((1000, 1))
    still = Response(Record(rest, rest, name="rest"), "test", {"linear": rest})
    assert verdict.judge_linear([still]).usable is None


def test_a_linear_model_of_a_step_is_usable():
    found = verdict.judge_linear([TRAIN, settled("test", 1.0)])
    assert found.usable
    assert found.nrmse == pytest.approx(0.01, rel=0.1)
    assert found.text.endswith("; test has settled and shows only the static gain.")
