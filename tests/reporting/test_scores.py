"""Scores, metrics.json and the table of a run."""

import json
import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import lfrtorch
from lfrtorch.data.dataset import Dataset, Published
from lfrtorch.data.records import Channel, Record
from lfrtorch.reporting import scores as report
from lfrtorch.reporting.evaluation import Evaluation, Response, of_samples
from lfrtorch.reporting.score_columns import use_of
from lfrtorch.reporting.verdict import Kind, Verdict

pytestmark = pytest.mark.numeric


@pytest.fixture(scope="module")
def result() -> tuple[lfrtorch.FitResult, lfrtorch.LinearModel, Dataset]:
    """A short fit of a saturating system in volts."""
    rng = np.random.default_rng(0)
    records = []
    for name in ("train", "validation", "test"):
        u = rng.standard_normal(300)
        y = np.tanh(np.convolve(u, [0.0, 0.6, 0.3])[:300])
        channel = (Channel("v", "V"),)
        records.append(Record(u, y, name=name, source="simulated", outputs=channel, skip=5))
    train, validation, test = ([record] for record in records)
    others = (
        Published("everybody", {"test": 0.5}, "A (2001)"),
        Published("small", {"test": 0.25}, "B (2002)", sizes=(1, 1)),
        Published("large", {"test": 0.125}, "C (2003)", sizes=(2, 2)),
    )
    data = Dataset(
        "saturation",
        train,
        validation,
        test,
        noise_rms=0.01,
        published=others,
        notes=("a note",),
        seed=3,
    )
    bla = lfrtorch.estimate_bla(train, nx=2)
    model = lfrtorch.initialise(bla, train, nz=1, nw=1, nn=3)
    return lfrtorch.fit(model, train, validation, trainer=lfrtorch.Adam(max_iter=2)), bla, data


SEEDS = [7, 1007, 2007]
SETTINGS = lfrtorch.Settings(nx=2)


def evaluated(
    fitted: lfrtorch.FitResult, bla: lfrtorch.LinearModel, data: Dataset, **own: Any
) -> Evaluation:
    return Evaluation(dataset=data, linear=bla, model=fitted.model, **own)


def metrics_of(
    fitted: lfrtorch.FitResult,
    evaluation: Evaluation,
    settings: lfrtorch.Settings = SETTINGS,
) -> Mapping[str, Any]:
    assert evaluation.linear is not None
    return lfrtorch.Run(
        dataset=evaluation.dataset,
        settings=settings,
        linear=evaluation.linear,
        order_scan=None,
        choice=None,
        fit=fitted,
        evaluation=evaluation,
        verdict=Verdict(Kind.UNJUDGED, "", "NL-LFR"),
        advice=[],
    ).metrics


def test_starts_are_ranked_in_files_and_in_a_table(result):
    _, bla, data = result
    models = [lfrtorch.initialise(bla, data.train, nz=1, nw=1, nn=3, seed=seed) for seed in SEEDS]
    trainer = lfrtorch.LevenbergMarquardt(max_iter=4)
    fitted = lfrtorch.fit(models, data.train, data.validation, trainer=trainer)
    settings = lfrtorch.Settings(nx=2, starts=3, seed=SEEDS[0])
    metrics = metrics_of(fitted, evaluated(fitted, bla, data), settings)
    assert json.loads(json.dumps(metrics, allow_nan=False)) == metrics
    assert metrics["starts"] == 3
    assert sorted(start["seed"] for start in metrics["ranking"]) == SEEDS
    assert {start["selection"] for start in metrics["ranking"]} == {None}
    assert metrics["ranking"][0]["validation"] == fitted.starts[0].validation
    lines = report.starts_table(fitted, SEEDS).splitlines()
    assert lines[2].split() == ["seed", "iterations", "training", "validation", "selection"]
    assert lines[4].split()[0] == str(metrics["ranking"][0]["seed"])
    assert len(lines) == 8  # two went to the end
    assert lines[-1] == "1 other ended earlier: see metrics.json."
    assert "earlier" not in report.starts_table(replace(fitted, starts=fitted.starts[:2]), SEEDS)


def test_a_test_may_have_a_linear_model_of_its_own(result):
    fitted, bla, data = result
    data = replace(data, linear={"test": ("train",)})
    own = lfrtorch.estimate_bla(data.train, nx=1)
    evaluation = evaluated(fitted, bla, data, own={"test": own})
    metrics = metrics_of(fitted, evaluation)
    expected = lfrtorch.rmse(data.tests[0], own.simulate(data.tests[0]))
    assert metrics["scores"]["test"]["lti_rmse"] == expected
    assert metrics["linear"] == {"test": ["train"]}
    text = report.table(evaluation)
    assert "linear: each of these has its own model: test from train\n" in text


def test_metrics_are_what_the_model_scores(result):
    fitted, bla, data = result
    metrics = metrics_of(fitted, evaluated(fitted, bla, data))
    test, validation = data.tests[0], data.validation[0]
    y_hat = fitted.model.simulate(test)
    assert metrics["scores"]["test"] == {
        "rmse": lfrtorch.rmse(test, y_hat),
        "lti_rmse": lfrtorch.rmse(test, bla.simulate(test)),
        "nrmse": pytest.approx(lfrtorch.rmse(test, y_hat) / float(np.std(test.y[5:])), rel=1e-12),
        "unit": "V",
        "source": "simulated",
        "samples": 300,
        "skip": 5,
        "use": "test",
        "scored": 295,
        "start_error": None,
    }
    expected = lfrtorch.rmse(validation, fitted.model.simulate(validation))
    assert metrics["validation"]["rmse"] == pytest.approx(expected, rel=1e-12)
    expected = {"samples": 300, "noise_rms": 0.01, "seed": 3, "notes": ["a note"]}
    assert metrics["data"] == expected
    assert metrics["sizes"] == {"nx": 2, "nz": 1, "nw": 1, "nn": 3}
    # A 4, Bu 2, Bw 2, Cz 2, Dzu 1, Cy 2, Dyu 1, Dyw 1, Wz 3, bz 3, Ww 3, bw 1; gauge 4 + 1 + 1.
    assert (metrics["parameters"], metrics["parameters_net"]) == (25, 19)
    assert metrics["fit"]["iterations"] == 2
    json.dumps(metrics, allow_nan=False)


def test_pooled_validation_weighs_samples(result):
    records = [Record(np.zeros(n), np.zeros(n), skip=n - m) for n, m in ((110, 100), (300, 300))]
    data = Dataset("two", [], records, [])
    evaluation = Evaluation(dataset=data, model=result[0].model)
    vars(evaluation)["simulations"] = [
        Response(record, "validation", {"NL-LFR": np.full_like(record.y, error)})
        for record, error in zip(records, (3.0, 4.0), strict=True)
    ]
    expected = math.sqrt((100 * 9 + 300 * 16) / 400)
    validation = report.scored(evaluation)["validation"]
    assert validation["rmse"] == pytest.approx(expected)
    assert validation["lti_rmse"] is None


def test_table_shows_published_results_of_these_sizes_only(result):
    fitted, bla, data = result
    evaluation = evaluated(fitted, bla, data)
    metrics = metrics_of(fitted, evaluation)
    lines = report.table(evaluation).splitlines()
    assert lines[0] == "Simulation RMSE (mV), nx 2, nz 1, nw 1, 3 neurons"
    head, row = lines[2].split(), lines[4].split()
    columns = ["record", "use", "source", "scored", "linear", "(nx", "2)"]  # ours has its own nx
    assert head == [*columns, "NL-LFR", "everybody", "small"]
    assert row[:7] == ["test", "test", "simulated", "last", "295", "of", "300"]
    assert float(row[8]) == pytest.approx(1e3 * metrics["scores"]["test"]["rmse"], rel=5e-3)
    assert row[9:] == ["500", "250"]
    assert lines[5].split()[:3] == ["validation", "validation", "simulated"]
    assert lines[-2:] == ["everybody: A (2001)", "small: B (2002)"]


@pytest.mark.parametrize("units", [("m", "Pa"), ("m", "")])
def test_outputs_of_several_units_have_a_relative_error_together(units: tuple[str, str]):
    """It decides in sweeps and comparisons: of pascals and nanometres it was the pascals'."""
    rng = np.random.default_rng(0)
    y, e = rng.standard_normal((2, 100, 2))
    found = []
    for scale in ([1.0, 1.0], [1e-9, 1e9]):
        channels = tuple(Channel(name, unit) for name, unit in zip("ab", units, strict=True))
        record = Record(y, y * scale, outputs=channels)
        models = {"linear": (y + e) * scale, "NL-LFR": (y + 0.1 * e) * scale}
        score = Response(record, "test", models).score
        found.append((score.rmse, score.lti_rmse, score.std))
        assert score.rmse == score.nrmse
        assert score.rmse_by_output[1] == pytest.approx(0.1 * scale[1], rel=0.2)
    assert found[0] == pytest.approx(found[1])
    assert found[0][:2] == pytest.approx((0.1, 1.0), rel=0.2)


def test_the_table_says_which_samples_are_scored():
    assert of_samples(295, 300, 5) == "last 295 of 300"
    assert of_samples(290, 300, 5) == "290 of 300"  # some are not valid
    assert of_samples(295, 300, 5, records=2) == "295 of 300"
    assert of_samples(300, 300, 0) == "300 of 300"
    assert of_samples(0, 300, 300) == "not scored"


def test_what_is_not_finite_becomes_null():
    assert report.finite({"a": {"b": math.nan}, "c": math.inf, "d": 1.5, "e": "x"}) == {
        "a": {"b": None},
        "c": None,
        "d": 1.5,
        "e": "x",
    }


def test_neurons_in_words():
    sizes = {"nx": 2, "nz": 1, "nw": 1, "nn": 0}
    assert report.in_words(sizes) == "nx 2, nz 1, nw 1, a map of one's own"


def test_a_mean_is_called_so_with_the_sizes_of_each_model():
    sizes = {"nx": 6, "nz": 9, "nw": 9, "nn": 48}
    each = "nx 2, nz 3, nw 3, 16 neurons"
    assert report.in_words(sizes, averaged=3) == f"mean of 3 models with {each}"
    assert report.in_words(sizes).startswith("nx 6")


def test_what_was_left_out_in_turn_chose_nothing():
    assert use_of("validation", "cross-validation") == "left out in turn"
    assert use_of("validation", "run, cross-validation") == "left out in turn"
    assert use_of("validation", "run") == "chooses the iterate"


@pytest.mark.parametrize("units", [("m", "V"), ("V", "V")])
def test_several_outputs_have_a_table_of_their_own(result, units: tuple[str, str]):
    fitted, _, _ = result
    y = np.random.default_rng(0).standard_normal((100, 3))
    channels = tuple(Channel(*of) for of in zip("abc", (*units, "V"), strict=True))
    record = Record(y, y, outputs=channels, name="test")
    models = {"linear": np.add(y, [2.0, 3.0, 4.0]), "NL-LFR": np.add(y, [1.0, np.nan, 5.0])}
    evaluation = Evaluation(dataset=Dataset("three", [], [], [record]), model=fitted.model)
    vars(evaluation)["simulations"] = [Response(record, "test", models)]
    _, shown = report.table(evaluation).split("RMSE of each output")
    assert [line.split() for line in shown.splitlines()[-3:]] == [
        ["test", "a", units[0], "2.00", "1.00"],
        ["test", "b", units[1], "3.00", "\N{EN DASH}"],
        ["test", "c", "V", "4.00", "5.00"],
    ]
    one = replace(record, y=y[:, :1], outputs=channels[:1])
    models = {name: y_hat[:, :1] for name, y_hat in models.items()}
    alone = Evaluation(dataset=Dataset("one", [], [], [one]), model=fitted.model)
    vars(alone)["simulations"] = [Response(one, "test", models)]
    assert "RMSE of each output" not in report.table(alone)
