"""Advice is what the numbers of a fit say: each rule speaks when it should, and only then."""

from __future__ import annotations

import ast
import re
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lfrtorch
from lfrtorch.cli.composition import composed, spelt
from lfrtorch.data.records import Record
from lfrtorch.reporting import advice
from lfrtorch.reporting.advice import RULES, Advice, advise
from lfrtorch.reporting.diagnosis import Evidence
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
    parameters=60,
    samples=4000,
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


OVERTRAINED = {"risen": 1.3, "fell": 0.7, "samples": 400, "parameters": 80}

GUESSED = {"searched": False}

USELESS = GUESSED | {"train": 0.19, "validation": 0.199}

UNUSABLE = verdict(Kind.LINEAR, NEITHER)

LITTLE = "system_is_linear", "nothing_at_any_size", "hardly_better", "gain_is_small"
LEFT = "nonlinear_part_left_at_any_size", "nonlinear_part_incomplete"


def one_of(names: Sequence[str], e: Evidence) -> Advice | None:
    """What one of these rules says, if any of them does: no two of them."""
    found = [item for name in names if (item := RULES[name](e)) is not None]
    assert len(found) <= 1
    return found[0] if found else None


SETTINGS = lfrtorch.Settings(nx=3, nz=1, nw=1, nn=10)


@pytest.mark.parametrize(
    ("rule", "change", "said"),
    [
        ("diverges", {"diverged": ["sweep"]}, "use ridge='auto'."),
        ("diverges", {"diverged": ["sweep"], "continued": True}, "use ridge=1e-3."),
        ("diverges", {"diverged": ["sweep"], "ridge": True, "searched": False}, "larger ridge"),
        ("diverges", {"diverged": ["sweep"], "ridge": True}, "or noise='innovation' if"),
        ("diverges", {"diverged": [f"sweep {k}" for k in range(99)]}, "use ridge='auto'"),
        ("starts_in_a_transient", {"transient": 4.0, "free": 0.9}, "skip=N"),
        ("nothing_held_out", {"validation": None, "linear_validation": None}, "hold out"),
        ("validation_is_unlike", {"linear_validation": 0.4}, "(validation=0.4)"),
        ("validation_is_unlike", {"linear_validation": 0.1}, "validation=[NAME]"),
        ("still_falling", {"falling": 0.05}, "max_iter=400"),
        ("still_falling", {"falling": 0.05, "trainer": lfrtorch.Adam()}, "max_iter=400"),
        ("overfits", {"validation": 0.05}, "Overfit: more data"),
        ("overfits", {"validation": 0.05, "samples": 400}, "Overfit: more data"),
        ("overfits", GUESSED | {"validation": 0.05, "ridge": True}, "Overfit: more data"),
        (
            "overfits_without_ridge",
            GUESSED | {"validation": 0.05},
            "Overfit: ridge='auto', or more data",
        ),
        ("overfits_without_ridge", GUESSED | OVERTRAINED, "Overfit: ridge='auto', or more data"),
        ("linear_part_incomplete", {"linear": 0.5}, "nx=4, nx=5 or nx='auto'"),
        (
            "system_is_linear",
            {"validation": 0.19, "linear_train": 0.01, "linear_validation": 0.01},
            "linear model is enough",
        ),
        ("outputs_left_out", {"outputs": {"y1": 0.95, "y2": 0.1}}, "nw=2, nz=2"),
        ("best_start_alone", {"starts": (0.02, 0.03)}, "starts=16"),
        ("one_start", {"started": 1}, "starts=8"),
        ("tests_are_louder", {"louder": {"arrow": 1.5}}, "train on inputs as large"),
        ("noise_unknown", {"noise": None}, "in steady state for training."),
        ("choose_sizes", {"searched": False}, "nx='auto', nz='auto', nw='auto', nn='auto'"),
        ("nothing_at_any_size", {"validation": 0.199}, "at any size searched"),
        (
            "hardly_better",
            USELESS | {"linear": None, "started": 1},
            "starts=8, nx=4, nn=20, nz=2, nw=2",
        ),
        ("hardly_better", USELESS | {"samples": 900, "started": 1}, "starts=8."),
        ("hardly_better", USELESS | {"samples": 900}, "more data."),
        ("at_the_noise", {"train": 0.0105, "validation": 0.011}, "gain nothing"),
        ("holds_in_training_alone", {"verdict": UNUSABLE}, "good in training only"),
        (
            "inputs_explain_little",
            {"verdict": UNUSABLE, "train": 0.95, "linear_train": 0.97, "linear_validation": 0.98},
            "check the columns",
        ),
        ("gain_is_lost", {"test": 0.03, "linear_test": 0.02}, "measure longer"),
        ("overfits", {"test": 0.06, "linear_test": 0.3}, "Overfit: more data"),
        (
            "ended_by_limit_of_choice",
            {"spent": True},
            "continue this fit with init_from=RUN, trainer.max_it",
        ),
        ("ended_by_limit", GUESSED | {"spent": True}, "every start: trainer.max_iter=400."),
        ("nothing_moves", {"settled": True}, "test=FILE.csv"),
        (
            "nothing_left",
            {"noise": None, "white": True, "guess": 0.018},
            "Nothing is left to find",
        ),
    ],
)
def test_a_rule_speaks_if_its_number_says_so(rule, change, said):
    assert RULES[rule](GOOD) is None
    found = RULES[rule](replace(GOOD, **change))
    assert found is not None
    assert said in found.text
    assert found.evidence
    assert max(len(found.text), len(found.evidence)) <= 160
    assert found in advise(replace(GOOD, **change))
    if found.change is not None:
        assert replace(SETTINGS, **found.change) != SETTINGS


def test_two_periods_are_measured_where_nothing_else_is_to_be_done():
    unknown = replace(GOOD, noise=None)
    (alone,) = advise(unknown)
    assert "two periods" in alone.text
    for change in ({"guess": 0.018}, {"validation": 0.05}, {"spent": True}):
        assert not any("two periods" in item.text for item in advise(replace(unknown, **change)))


def test_white_errors_at_the_guessed_noise_are_the_end():
    done = replace(GOOD, noise=None, guess=0.018, white=True, started=1, spent=True)
    (found,) = advise(done)
    assert found.text.startswith("Nothing is left to find")
    for change in ({"white": False}, {"guess": 0.01}, {"validation": 0.05}, {"falling": 0.1}):
        assert not any(
            item.text.startswith("Nothing is left") for item in advise(replace(done, **change))
        )


def test_a_gap_to_the_tests_is_no_overfit_if_they_are_louder_or_the_linear_model_has_it():
    gap = {"test": 0.06, "linear_test": 0.3}
    for change in ({"louder": {"test": 2.0}}, {"linear_test": 0.6}, {"settled": True}):
        assert RULES["overfits"](replace(GOOD, **gap | change)) is None


def test_advice_ends_with_the_command_of_the_run_and_what_is_changed():
    run = "lfrtorch fit 'a b.csv' fs=10 data.validation=0 ridge=1e-3 starts=2"
    starts = RULES["one_start"](replace(GOOD, started=1))
    held_out = RULES["nothing_held_out"](replace(GOOD, validation=None, linear_validation=None))
    falling = RULES["still_falling"](replace(GOOD, falling=0.05))
    assert starts is not None
    assert held_out is not None
    assert falling is not None
    assert starts.command(run) == run.replace("starts=2", "starts=8")
    assert (
        held_out.command(run) == "lfrtorch fit 'a b.csv' fs=10 ridge=1e-3 starts=2 validation=0.2"
    )
    assert falling.command(run).endswith(" trainer.max_iter=400")
    assert Advice("Measure longer.", "").command(run) == ""


def test_louder_tests_say_by_how_much_the_starts_differ_there():
    loud = replace(GOOD, louder={"arrow": 1.5, "other": 1.0}, apart={"arrow": 0.12})
    found = RULES["tests_are_louder"](loud)
    assert found is not None
    assert found.evidence.endswith(
        "'arrow' up to 1.50 times; "
        "there the starts differ by 12.0 % of the output's standard deviation"
    )


def test_nonlinear_behaviour_is_left_where_the_error_is_neither_noise_nor_linear():
    rule = partial(one_of, LEFT)
    guessed = replace(GOOD, searched=False)
    polynomial = replace(guessed, sizes={"nx": 3, "nz": 1, "nw": 1, "degree": 3}, samples=9000)
    seen = replace(GOOD, noise=None, nonlinear=0.3)
    for found, said in (
        (rule(GOOD), "at any size searched; more data may allow a larger map."),
        (rule(guessed), "nn=20, nz=2, nw=2. (training error 2.00 times the noise"),
        (rule(replace(guessed, samples=1300)), "left: nn=20. (training"),
        (rule(replace(guessed, samples=1100)), "left: more data would allow a larger map."),
        (rule(replace(guessed, validation=0.025)), "left: more data would allow a larger map."),
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
    noisy = replace(GOOD, train=0.01, validation=0.011, linear=0.5, started=1)
    noisy = replace(noisy, louder={"test": 2.0})
    said = [item.text.split(":")[0] for item in advise(noisy)]
    assert said == ["Noise-limited", "Some tests extrapolate"]
    # Below the noise on training and above it on validation is overfit.
    assert advise(replace(noisy, train=0.007, linear=0.0))[0].text.startswith("Overfit")
    # A search that goes on, or an error below the noise, says that the noise is not known so well.
    for change in ({"falling": 0.05}, {"train": 0.005, "validation": 0.005}):
        assert RULES["at_the_noise"](replace(noisy, **change)) is None


def test_missing_states_come_before_a_larger_map():
    useless = replace(GOOD, train=0.2, validation=0.2, linear=0.9, outputs={}, noise=None)
    useless = replace(useless, searched=False)
    states, sizes = (item.text for item in advise(useless))
    assert states == "The linear part is incomplete: nx=4, nx=5 or nx='auto'."
    assert sizes.startswith("Let the data choose the sizes")


def test_what_spoils_the_linear_model_as_much_is_no_overfit():
    unlike = replace(GOOD, validation=0.06, linear_validation=0.6)
    assert RULES["overfits"](unlike) is None
    assert RULES["overfits"](replace(unlike, validation=0.027, linear_validation=0.27)) is None


def test_where_training_goes_on_with_noise_nothing_larger_is_advised():
    useless = {"validation": 0.19, "train": 0.18, "started": 1, "searched": False}
    larger = ("Nonlinear behaviour is left", "Hardly better", "Some outputs gain nothing")
    for fit in (GOOD, replace(GOOD, **useless), replace(GOOD, outputs={"y1": 0.95, "y2": 0.1})):
        assert any(str(item).startswith(larger) for item in advise(fit))
        items = advise(replace(fit, **OVERTRAINED))
        assert sum(item.text.startswith("Overfit") for item in items) == 1
        assert not any(str(item).startswith(larger) for item in items)
    for other in (
        {"samples": 4000},  # enough for the parameters
        {"risen": 1.01},  # the search has come to rest
        {"fell": 1.0},  # training is at rest, too
        {"linear": 0.5},  # states are missing
        {"linear_validation": 0.5},  # the parts are unlike
    ):
        assert RULES["overfits"](replace(GOOD, **OVERTRAINED | other)) is None


def test_starts_are_not_compared_on_parts_that_are_unlike():
    unlike = replace(GOOD, linear_validation=0.5, started=1, starts=(0.02, 0.03))
    assert RULES["one_start"](unlike) is None
    assert RULES["best_start_alone"](unlike) is None


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
    assert not any("auto" in text or "still falls" in text for text in texts)
    assert RULES["one_start"](replace(alone, started=1)) is None


def test_a_model_that_diverges_everywhere_has_advice():
    first, *_ = advise(Evidence(None, 0.2, None, 0.2, starts=(), diverged=["a", "b"]))
    assert first.text.startswith("The model is not usable yet")


@pytest.mark.parametrize("searched", [True, False])
def test_what_the_verdict_calls_better_is_not_called_hardly_better(searched: bool):
    small = replace(GOOD, validation=0.19, started=1, searched=searched)
    quiet = {"linear_train": 0.0105, "linear_validation": 0.0105, "validation": 0.01}
    for change in ({}, quiet):
        said = str(one_of(LITTLE, replace(small, **change)))
        assert "linear at this level" in said
        seen = replace(small, verdict=verdict(Kind.BETTER, "NL-LFR"), **change)
        found = str(one_of(LITTLE, seen))
        assert "linear at this level" not in found
        assert "Hardly better" not in found


def test_no_system_is_called_linear_where_neither_model_is_usable():
    useless = replace(GOOD, train=0.95, linear_train=0.97, validation=0.98, linear_validation=1.0)
    useless = replace(useless, noise=None, verdict=UNUSABLE)
    texts = [item.text for item in advise(useless)]
    assert texts[0].startswith("The inputs explain little")
    assert not texts[1:]
    lost = replace(useless, train=0.8, validation=0.8, test=1.5, linear_test=1.0)
    assert lost.lost_on_tests
    assert RULES["gain_is_lost"](lost) is None
    usable = replace(useless, started=1, searched=False)
    assert advise(usable) == advise(useless)
    assert len(advise(replace(usable, verdict=verdict(Kind.LINEAR)))) > 1
    first, *_ = advise(replace(usable, linear=0.5))
    assert first.text.startswith("The linear part is incomplete")


def test_a_gain_that_the_tests_have_not_asks_for_no_larger_map():
    lost = replace(GOOD, test=0.023, linear_test=0.018, outputs={"y1": 0.95, "y2": 0.1})
    texts = [item.text for item in advise(lost)]
    assert texts[0].startswith("The gain on validation is lost on the tests")
    assert not any("nw=" in text for text in texts)
    shown = replace(lost, validation=None, linear_validation=None)
    assert not any("Overfitting would not show" in item.text for item in advise(shown))
    for change in ({"linear_test": 0.05}, {"verdict": verdict(Kind.BETTER, "NL-LFR")}):
        texts = [item.text for item in advise(replace(lost, **change))]
        assert texts[0].startswith("Some outputs gain nothing")


@pytest.mark.parametrize(("samples", "nn", "is_said"), [(80, 16, True), (600, 3, False)])
def test_a_fit_of_few_noisy_samples_is_overfit_and_one_of_many_is_not(samples, nn, is_said):
    rng = np.random.default_rng(2)
    u, y = rng.standard_normal(samples + 300), np.zeros(samples + 300)
    for k in range(len(y) - 1):
        y[k + 1] = 0.7 * y[k] + np.tanh(u[k])
    y += 0.3 * rng.standard_normal(len(y))
    train = Record(u[:samples], y[:samples], name="train")
    validation = Record(u[samples:], y[samples:], name="validation", skip=20)
    trainer = lfrtorch.LevenbergMarquardt(max_iter=25)
    settings = lfrtorch.Settings(nx=1, nz=1, nw=1, nn=nn, starts=1, trainer=trainer)
    run = lfrtorch.identify(lfrtorch.Dataset("noisy", [train], [validation], []), settings)
    assert any(item.text.startswith("Overfit:") for item in run.advice) is is_said
    assert not (is_said and any(item.text.startswith("Hardly better") for item in run.advice))


def test_advice_asks_for_settings_that_there_are():
    """In every text of the rules each NAME=VALUE is a setting, of the fit or of its files."""
    known = dict(spelt(composed("config", ["data=file"])))
    source = ast.parse(Path(advice.__file__).read_text(encoding="utf-8"))
    constants = [n.value for n in ast.walk(source) if isinstance(n, ast.Constant)]
    texts = [text for text in constants if isinstance(text, str)]
    asked = re.findall(r"(?<![\w.])([a-z_.]+)=", "\n".join(texts))
    assert {"validation", "ridge", "nx", "skip", "init_from"} <= set(asked)
    assert [name for name in asked if name not in known] == []


@pytest.mark.parametrize("guarantee", ["contracting", 0.98, "stable"])
def test_nothing_is_to_be_chosen_beside_a_proof_of_every_step(guarantee: Any):
    trainer = lfrtorch.LevenbergMarquardt(guarantee=guarantee)
    e = replace(GOOD, searched=False, ridge=False, trainer=trainer)
    assert (RULES["choose_sizes"](e) is None) == (guarantee != "stable")
    assert e.proven == (guarantee != "stable")
