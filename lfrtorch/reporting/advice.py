"""Advice after a fit, from numbers alone: a table with a rule in each row.

:mod:`lfrtorch.reporting.diagnosis` computes the numbers, and has the thresholds that several rules
share.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

from lfrtorch._support.tables import number, percent
from lfrtorch.reporting.diagnosis import (
    EXTRAPOLATES,
    FALLING,
    NOISE_LIMITED,
    NONLINEAR,
    OVERFIT,
    SOUND,
    UNEXPLAINED,
    Evidence,
)
from lfrtorch.reporting.sentences import Said, said

_TRANSIENT = 3.0  # error in the first twentieth of the scored samples over the error in the rest
_CLOSE = 1.2  # largest growth (as for OVERFIT) with which a larger map is advised
_FEW = 3  # at most so many records or outputs are named


class Advice(NamedTuple):
    """A sentence that says what to do or to know."""

    text: str  # the sentence, in at most 160 characters
    evidence: str  # the numbers behind the sentence
    change: Mapping[str, Any] | None = None  # changed settings; None if the advice changes none
    words: str = ""  # words of the command line in place of those of the change

    def command(self, before: str) -> str:
        """The command ``before``, changed to follow the advice; empty if no words follow it.

        Example:
            >>> Advice("", "", {"ridge": "auto"}).command("lfrtorch fit x.csv fs=10 ridge=1e-3")
            'lfrtorch fit x.csv fs=10 ridge=auto'
        """
        words = shlex.split(self.words) or _words(self.change or {})
        # A run has its words spelt out: data.validation=0.2.
        named = tuple(f"{word.partition('=')[0]}=" for word in words)
        kept = [w for w in shlex.split(before) if not w.removeprefix("data.").startswith(named)]
        return shlex.join([*kept, *words]) if words and before else ""

    def __str__(self) -> str:
        return f"{self.text} ({self.evidence})"


class Rule(NamedTuple):
    """A row of the table: when the rule applies, its advice and evidence, and what to change."""

    when: Callable[[Evidence], bool]
    text: Said
    because: Said  # the evidence; if it is empty, the rule gives no advice
    change: Callable[[Evidence], Mapping[str, Any]] = lambda _: {}
    words: str = ""
    instead: str = ""  # text in place of {change}, if the rule changes no setting

    def __call__(self, e: Evidence) -> Advice | None:
        """Advice of the rule; None if the rule does not apply."""
        if not self.when(e):
            return None
        change = self.change(e)
        text = said(self.text, e, change=_written(change) or self.instead)
        because = said(self.because, e)
        return Advice(text, because, change or None, self.words) if because else None


def advise(evidence: Evidence) -> list[Advice]:
    """List the advice that the numbers suggest, the most useful first."""
    # If the error is noise, or the inputs explain little, other sizes or a longer search do not
    # help.
    e = evidence
    without = e.noise_limited or e.nothing_left or e.unexplained
    rules = [*_OF_DATA.values(), *([] if without else _OF_MODEL.values()), *_OF_USE.values()]
    found = [advice for rule in rules if (advice := rule(e)) is not None]
    # To measure more is advised only if there is no other advice.
    return found or [advice for advice in [RULES["noise_unknown"](e)] if advice is not None]


def _above(value: float | None, limit: float) -> bool:
    return value is not None and value > limit


def _of_ridge(e: Evidence) -> dict[str, Any]:
    """Change that has the ridge chosen; empty if there is a ridge, or none can be chosen."""
    return {} if e.ridge or e.given else {"ridge": "auto"}


def _ridge(e: Evidence) -> str:
    if e.ridge and e.searched:  # no ridge helps
        return "integrators=1 or noise='innovation' if the system integrates or was in a loop"
    return "a larger ridge" if e.ridge else "ridge=1e-3"


def _overfit(e: Evidence) -> str:
    """Tell how far the error grows beyond training, or during it; empty if it does not grow."""
    part, growth = max(e.growths.items(), key=lambda item: item[1], default=("", 0.0))
    if growth <= OVERFIT:
        return (
            f"after the kept iterate the validation error is {number(e.risen)} times as large, and "
            f"training fell to {percent(e.fell)}; {number(e.samples / max(1, e.parameters))} "
            "samples a parameter"
        ) * e.overtrained
    return (
        f"{part} error {percent(e.test if part == 'test' else e.validation)}, training error "
        f"{percent(e.train)}: {number(growth)} times the growth of the linear model's error"
    ) * (part != "test" or not e.lost_on_tests)  # else gain_is_lost says it


def _gains_little(e: Evidence) -> bool:
    """Tell if the NL-LFR is hardly better than the linear model, and no other rule says why."""
    return e.useless and not (e.parts_differ or e.neither or e.states_missing or e.overtrained)


def _is_small(e: Evidence) -> bool:
    """Tell if larger sizes may give a gain: the sizes are given, and the error is not noise."""
    return _gains_little(e) and e.linear_over_noise > NOISE_LIMITED and not e.searched


def _more(e: Evidence) -> dict[str, Any]:
    """Change to more starts and larger sizes."""
    states = {"nx": e.nx + 1} if e.linear is None and e.nx else {}
    return {**({} if e.continued or e.started >= 8 else {"starts": 8}), **_larger(e, states)}


def _more_outputs(e: Evidence) -> dict[str, int]:
    return {name: e.sizes.get(name, 0) + 1 for name in ("nw", "nz")}


def _is_spent(e: Evidence) -> bool:
    return e.spent and e.falling <= FALLING and (e.overfit or 0.0) <= _CLOSE


def _longer(e: Evidence) -> dict[str, Any]:
    return {"trainer": replace(e.trainer, max_iter=4 * max(e.iterations, 1))}


def _map_is_small(e: Evidence) -> bool:
    """Tell if the NL-LFR has a gain, and no other rule explains the error that is left."""
    other = e.useless or e.lost_on_tests or e.states_missing or e.overtrained
    return e.gain is not None and not other


def _not_noise(e: Evidence) -> str:
    """Evidence that the error is not noise; empty without evidence."""
    if not e.noise or e.train is None:
        part = f"explain {percent(e.nonlinear)} of the error's power"
        return f"squares and cubes of the outputs {part}" * _above(e.nonlinear, NONLINEAR)
    times = f"training error {number(e.train / e.noise)} times the noise"
    if e.linear is not None:
        times += f", and only {percent(e.linear)} of its power is linear in the inputs"
    return times * (e.train > 1.5 * e.noise)  # the model's share is then larger than the noise


def _far(e: Evidence) -> dict[str, float]:
    """Tests with larger inputs than the training, and the ratio of their largest inputs."""
    return {name: ratio for name, ratio in e.louder.items() if ratio > EXTRAPOLATES}


def _louder(e: Evidence) -> str:
    """Tell how large the inputs of these tests are, and how far the starts' outputs differ."""
    ratios = _listed(f"'{name}' up to {number(ratio)} times" for name, ratio in _far(e).items())
    apart = max((e.apart.get(name, 0.0) for name in _far(e)), default=0.0)
    more = f"; there the starts differ by {percent(apart)} of the output's standard deviation"
    return f"largest input, relative to training: {ratios}{more * bool(apart)}"


def _both_errors(e: Evidence) -> str:
    error, linear_error, which = e.judged
    return f"{which} error: NL-LFR {percent(error)}, linear model {percent(linear_error)}"


def _larger(e: Evidence, states: Mapping[str, int] | None = None) -> dict[str, int]:
    """Sizes of a larger static map, and of more states; empty if there are too few samples."""
    if e.known and not (e.sizes.get("nn") or e.sizes.get("degree")):
        return {"nz": 2, "nw": 1, "nn": 4}
    signals = {name: max(2, e.sizes.get(name, 0) + 1) for name in ("nz", "nw")}
    static = {"degree": e.sizes["degree"] + 2} if e.sizes.get("degree") else {}
    if e.sizes.get("nn"):
        static = {"nn": 2 * e.sizes["nn"]}
    own = {**(states or {}), **static}
    tried = {**own, **signals}, own
    return next((change for change in tried if change and _borne(e, change)), {})


def _borne(e: Evidence, change: Mapping[str, int]) -> bool:
    """Tell if the data allow larger sizes: the error hardly grows, and the samples suffice."""
    growth = _weights({**e.sizes, **change}) / _weights(e.sizes)
    return (e.overfit or 0.0) <= _CLOSE and e.bears(growth)


def _weights(sizes: Mapping[str, int]) -> int:
    """A product of sizes that grows at least as fast as the number of parameters."""
    nz, nw = sizes.get("nz", 0), sizes.get("nw", 0)
    static = (nz + 1 + nw) * max(1, sizes.get("nn", 0))
    if sizes.get("degree"):
        static = nw * math.comb(nz + sizes["degree"], nz)
    return max(1, static) * max(1, sizes.get("nx", 0))


_OF_DATA = {
    "diverges": Rule(
        lambda e: bool(e.diverged),
        lambda e: (
            "The model is not usable yet: "
            + "train on inputs as large as the tests', or " * any(n in _far(e) for n in e.diverged)
            + f"use {_written(_of_ridge(e)) or _ridge(e)}."
        ),
        lambda e: f"the NL-LFR diverges on {_listed(map(repr, e.diverged))}",
        _of_ridge,
    ),
    "inputs_explain_little": Rule(
        lambda e: e.unexplained and not e.diverged,
        "The inputs explain little of the outputs: check the columns, delays and units, and look "
        "for other inputs (lfrtorch preview).",
        "training error: NL-LFR {train:%}, linear model {linear_train:%}",
    ),
    "holds_in_training_alone": Rule(
        # If the parts differ, another rule says so; with a large training error no model is good.
        lambda e: (
            e.neither
            and bool(e.linear_train)
            and not (e.diverged or e.unexplained)
            and e.train is not None
            and not (e.parts_differ or e.train > UNEXPLAINED)
        ),
        "The models are good in training only: the other parts are unlike it, too short or at "
        "rest, or begin in another state (start='estimated').",
        "training error: NL-LFR {train:%}, linear model {linear_train:%}",
    ),
    "validation_is_unlike": Rule(
        lambda e: e.parts_differ,
        "The validation part is unlike the training part: hold out a longer one (validation=0.4), "
        "or records by name (validation=[NAME]).",
        "error of the linear model: validation {linear_validation:%}, training {linear_train:%}",
        words="validation=0.4",
    ),
    "gain_is_lost": Rule(
        lambda e: e.lost_on_tests and not e.parts_differ and not e.neither,
        "The gain on {judged[2]} is lost on the tests: these are unlike it, or the model is "
        "overfit; hold out a longer part (validation=0.4), or measure longer.",
        "error relative to the linear model's: {judged[2]} {gain:%}, tests {tests:%}",
        words="validation=0.4",
    ),
    "nothing_held_out": Rule(
        lambda e: e.validation is None and e.linear_validation is None and e.train is not None,
        lambda e: (
            ("Hold" if e.lost_on_tests else "Overfitting would not show: hold")
            + " out a part (validation=0.2) to choose iterations and sizes, then fit all samples."
        ),
        "{parameters} parameters are fitted to {samples} samples",
        words="validation=0.2",
    ),
    "starts_in_a_transient": Rule(
        lambda e: _above(e.transient, _TRANSIENT) and _above(e.free, 0.5),
        "The records do not begin at the model's rest: skip more samples (skip=N), or estimate "
        "the initial states (start='estimated').",
        "in the first twentieth of the records the error is {transient} times that of the rest; a "
        "free response explains {free:%} of its power",
        words="start=estimated",
    ),
    "nothing_moves": Rule(
        lambda e: e.settled,
        "All data held out have settled: test on another record (test=FILE.csv), or on a part of "
        "this record that moves.",
        "inputs and outputs held out move at most a tenth as much as in training",
        words="test=FILE.csv",
    ),
    "at_the_noise": Rule(
        lambda e: e.noise_limited,
        "Noise-limited: more neurons, states or starts gain nothing; more data or less noise make "
        "the model better.",
        "training error {train:%}, noise {noise:%} of the output's standard deviation",
    ),
    "nothing_left": Rule(
        lambda e: e.nothing_left,
        "Nothing is left to find: the errors are white, and about as large as the estimated noise.",
        "training error {train:%}, noise {guess:%} of the output's standard deviation; the noise "
        "is estimated from the quietest part of the spectrum",
    ),
}
"""Rules that concern the records and their noise."""

_OF_MODEL = {
    "overfits": Rule(
        lambda e: not e.parts_differ and bool(e.searched or not _of_ridge(e)),
        lambda e: f"Overfit: {'a larger ridge, or ' * e.known}more data.",
        _overfit,
    ),
    "overfits_without_ridge": Rule(
        lambda e: not e.parts_differ and not e.searched and bool(_of_ridge(e)),
        "Overfit: {change}, or more data.",
        _overfit,
        _of_ridge,
    ),
    "linear_part_incomplete": Rule(
        lambda e: e.states_missing,
        lambda e: "The linear part is incomplete: {}.".format(
            f"add nx={e.nx + 1} or nx={e.nx + 2} states to the known ones"
            if e.known
            else (f"nx={e.nx + 1}, nx={e.nx + 2} or nx='auto'" if e.nx else "a higher nx")
        ),
        "a linear filter of the inputs explains {linear:%} of the error's power",
        lambda e: {"nx": e.nx + 1} if e.nx or e.known else {},
    ),
    "system_is_linear": Rule(
        lambda e: (
            _gains_little(e) and not e.better and SOUND <= e.linear_over_noise <= NOISE_LIMITED
        ),
        "The system is linear at this level: the linear model is enough.",
        _both_errors,
    ),
    "nothing_at_any_size": Rule(
        lambda e: (
            _gains_little(e) and e.linear_over_noise > NOISE_LIMITED and e.searched and not e.better
        ),
        "Hardly better than the linear model at any size searched: the system is linear at this "
        "level, or the rest is not a static map of few signals.",
        _both_errors,
    ),
    "hardly_better": Rule(
        lambda e: _is_small(e) and not e.better,
        "Hardly better than the linear model: the system is linear at this level, or the search or "
        "the sizes are too small: {change}.",
        _both_errors,
        _more,
        instead="more data",
    ),
    "gain_is_small": Rule(
        lambda e: _is_small(e) and e.better,
        "The gain on {judged[2]} is small; more starts or larger sizes may increase it: {change}.",
        _both_errors,
        _more,
        instead="more data",
    ),
    "outputs_left_out": Rule(
        lambda e: (
            bool(e.behind)
            and e.gain is not None
            and not (e.useless or e.lost_on_tests)
            and _borne(e, _more_outputs(e))
        ),
        "Some outputs gain nothing, or are linear: try {change}.",
        lambda e: (
            f"{e.judged[2]} error relative to the linear model's: "
            + _listed(f"{percent(ratio)} on '{name}'" for name, ratio in e.behind.items())
            + ", and less on the others"
        ),
        _more_outputs,
    ),
    "nonlinear_part_left_at_any_size": Rule(
        lambda e: _map_is_small(e) and e.searched,
        "Nonlinear behaviour is left at any size searched; more data may allow a larger map.",
        _not_noise,
    ),
    "nonlinear_part_incomplete": Rule(
        lambda e: _map_is_small(e) and not e.searched,
        "Nonlinear behaviour is left: {change}.",
        _not_noise,
        _larger,
        instead="more data would allow a larger map",
    ),
    "choose_sizes": Rule(
        lambda e: not (e.searched or e.given or e.validation is None or e.parts_differ),
        "Let the data choose the sizes: {change}.",
        "the sizes were given",
        lambda e: dict.fromkeys(
            ["nx", "nz", "nw", "degree" if e.sizes.get("degree") else "nn"], "auto"
        ),
    ),
    "best_start_alone": Rule(
        lambda e: _above(e.second, 1.2) and not e.parts_differ,  # the best start may be luck
        "The minimum may be a poor one: {change}.",
        "the error of the second best of {started} starts is {second} times that of the best",
        lambda e: {"starts": 2 * max(e.started, 4)},
    ),
    "one_start": Rule(
        # Without validation, the start with the largest overfit would be chosen.
        lambda e: (
            not (e.started > 1 or e.continued or e.known or e.validation is None)
            and not (e.parts_differ or (e.useless and not e.overtrained))
        ),
        "Try several starts: {change}.",
        "the fit had one start, and may have ended in a poor minimum",
        lambda _: {"starts": 8},
    ),
    "still_falling": Rule(
        lambda e: e.falling > FALLING and e.validation is not None,
        "The error still falls: {change}, or continue this fit with init_from=RUN.",
        "at the last pace, the validation error falls by {falling:%} in a tenth of the "
        "{iterations} iterations",
        _longer,
    ),
    "ended_by_limit": Rule(
        lambda e: _is_spent(e) and not e.searched,
        "The limit of {iterations} iterations ended every start: {change}.",
        "kept iteration {iterations} of {iterations}",
        _longer,
    ),
    "ended_by_limit_of_choice": Rule(
        lambda e: _is_spent(e) and e.searched,
        lambda e: (
            f"The limit of {e.iterations} iterations ended every start: continue this fit with "
            f"init_from=RUN, {_written(_longer(e))}."
        ),
        "kept iteration {iterations} of {iterations}; a new search with another limit would "
        "choose the ridge anew",
    ),
}
"""Rules that concern the sizes and the search."""

_OF_USE = {
    "tests_are_louder": Rule(
        lambda e: bool(_far(e)),
        "Some tests extrapolate: train on inputs as large as those that the model is for.",
        _louder,
    ),
}
"""Rules that concern the inputs that the model is for."""

_LAST = {
    "noise_unknown": Rule(
        lambda e: e.noise is None and e.guess is None and e.train is not None and not e.structured,
        "It is unknown whether the remaining error is noise: measure two periods of a periodic "
        "input in steady state for training.",
        "the training error is {train:%} of the output's standard deviation, and the training "
        "records have no repeated periods",
    ),
}
"""The rule that is tried if no other rule applies."""

RULES = _OF_DATA | _OF_MODEL | _OF_USE | _LAST
"""All rules by name, the most useful first."""


def _words(change: Mapping[str, Any], write: Callable[[Any], str] = str) -> list[str]:
    """The change as words of the command line; ``write`` makes a word of a value."""
    limits = {f"{n}.max_iter": v.limit for n, v in change.items() if n == "trainer"}
    values = limits or change
    return [f"{name}={write(value)}" for name, value in values.items()]


def _written(change: Mapping[str, Any]) -> str:
    """The change as it is written in Python."""
    return ", ".join(_words(change, repr))


def _listed(items: Iterable[str]) -> str:
    """The first items, and the number of the others."""
    listed = [*items]
    more = f" and {len(listed) - _FEW} more" * (len(listed) > _FEW)
    return ", ".join(listed[:_FEW]) + more
