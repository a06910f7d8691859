"""What to try next after a fit, from numbers alone. Each rule names the numbers that it rests on.

The numbers, and the thresholds that several rules share, are those of
:mod:`lfrtorch.reporting.diagnosis`.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
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
    USELESS,
    Evidence,
)

_TRANSIENT = 3.0  # error in the first twentieth of the scored samples over that in the rest
_CLOSE = 1.2  # growth as of OVERFIT, up to which a larger map is advised
_FEW = 3  # most records or outputs that are named


class Advice(NamedTuple):
    """A sentence that says what to do or to know."""

    text: str  # the sentence, in at most 160 characters
    evidence: str  # the numbers that it rests on
    change: Mapping[str, Any] | None = None  # fields of the settings, if a program can follow it
    words: str = ""  # of the command line, if they are not those of the change

    def command(self, before: str) -> str:
        """The command of the run with what is advised; empty if no word of it follows it.

        Example:
            >>> Advice("", "", {"ridge": "auto"}).command("lfrtorch fit x.csv fs=10 ridge=1e-3")
            'lfrtorch fit x.csv fs=10 ridge=auto'
        """
        words = shlex.split(self.words) or _typed(self.change or {})
        # A run has its words spelt out: data.validation=0.2.
        named = tuple(f"{word.partition('=')[0]}=" for word in words)
        kept = [w for w in shlex.split(before) if not w.removeprefix("data.").startswith(named)]
        return shlex.join([*kept, *words]) if words and before else ""

    def __str__(self) -> str:
        return f"{self.text} ({self.evidence})"


class Row(NamedTuple):
    """A rule as a row of a table: it speaks where a number is beyond its limit."""

    number: Callable[[Evidence], float | None]
    limit: float
    sentence: Callable[[Evidence], str]
    because: Callable[[Evidence], str]
    change: Callable[[Evidence], Mapping[str, Any] | None] = lambda _: None
    words: str = ""

    def __call__(self, e: Evidence) -> Advice | None:
        """What it advises, if anything."""
        number = self.number(e)
        if number is None or number <= self.limit:
            return None
        return Advice(self.sentence(e), self.because(e), self.change(e), self.words)


def advise(evidence: Evidence) -> list[Advice]:
    """All that the numbers suggest, the most useful first."""
    # At the noise, and where the inputs explain little, there is no advice on sizes and search.
    e = evidence
    without = e.noise_limited or e.nothing_left or e.unexplained
    rules = [rule for rule, on_the_model in _RULES if not (on_the_model and without)]
    found = [advice for rule in rules if (advice := rule(e)) is not None]
    # More is not to be measured while there is something else to do.
    return found or [advice for advice in [noise_unknown(e)] if advice is not None]


def diverges(e: Evidence) -> Advice | None:
    """A record on which the simulation runs away."""
    if not e.diverged:
        return None
    change = {} if e.ridge or e.given else {"ridge": "auto"}
    ridge = _written(change) if change else "a larger ridge" if e.ridge else "ridge=1e-3"
    loud = any(e.louder.get(name, 0.0) > EXTRAPOLATES for name in e.diverged)
    return Advice(
        "The model is not usable yet: "
        + (f"train on inputs as loud as the tests', or use {ridge}." if loud else f"use {ridge}."),
        f"the NL-LFR diverges on {_listed([repr(name) for name in e.diverged])}",
        change or None,
    )


def starts_in_a_transient(e: Evidence) -> Advice | None:
    """An error at the beginning of the records that another start state removes."""
    if e.transient is None or e.transient <= _TRANSIENT or e.free is None or e.free <= 0.5:
        return None
    return Advice(
        "The records do not begin at the model's rest: skip more samples (skip=N), or estimate "
        "their starts (start='estimated').",
        f"in their first twentieth the training error is {number(e.transient)} times that of "
        f"the rest, and a free response explains {percent(e.free)} of its power",
        words="start=estimated",
    )


def nothing_held_out(e: Evidence) -> Advice | None:
    """No validation record: overfitting cannot be seen, nor sizes be chosen."""
    if e.validation is not None or e.linear_validation is not None or e.train is None:
        return None
    return Advice(
        ("Hold" if e.lost_on_tests else "Overfitting would not show: hold")
        + " out a part (validation=0.2) to choose iterations and sizes, then fit all with them.",
        f"{e.parameters} parameters are fitted to {e.samples} samples",
        words="validation=0.2",
    )


def validation_is_unlike(e: Evidence) -> Advice | None:
    """A validation part on which the linear model does much better or worse than in training."""
    if not e.parts_differ:
        return None
    return Advice(
        "The validation part is unlike the training part: hold out a longer one "
        "(validation=0.4), or records by name (validation=[NAME]).",
        f"error of the linear model: validation {percent(e.linear_validation)}, "
        f"training {percent(e.linear_train)}",
        words="validation=0.4",
    )


def neither_usable(e: Evidence) -> Advice | None:
    """Inputs that do not explain the outputs, whatever the model, or only those in training."""
    if not e.neither or e.diverged or e.train is None or not e.linear_train:
        return None
    evidence = f"training error {percent(e.train)}, of the linear model {percent(e.linear_train)}"
    if e.unexplained:
        return Advice(
            "The inputs explain little of the outputs: look at the columns, delays and units, and "
            "for other inputs (lfrtorch preview).",
            evidence,
        )
    if e.parts_differ or e.train > UNEXPLAINED:  # said there, or not even that
        return None
    return Advice(
        "The models hold in training alone: the other parts are unlike, too short or at rest, or "
        "begin in another state (start='estimated').",
        evidence,
    )


def gain_is_lost(e: Evidence) -> Advice | None:
    """A gain over the linear model that the tests have not."""
    if not e.lost_on_tests or e.parts_differ or e.neither:
        return None
    which = e.judged[2]
    return Advice(
        f"The gain on {which} is lost on the tests: they are unlike, or the model is overfit; "
        "hold out a longer part (validation=0.4), or measure longer.",
        f"error over the linear model's: {which} {percent(e.gain)}, tests {percent(e.tests)}",
        words="validation=0.4",
    )


def at_the_noise(e: Evidence) -> Advice | None:
    """Nothing to gain from a larger model."""
    if not e.noise_limited:
        return None
    return Advice(
        "Noise-limited: nothing to gain from more neurons, states or starts; more data or less "
        "noise make the model better.",
        f"training error {percent(e.train)}, noise {percent(e.noise)} of the output's "
        "standard deviation",
    )


nothing_moves = Row(
    lambda e: float(e.settled),
    0.0,
    lambda e: (
        "Nothing held out moves: test with another record (test=FILE.csv), or put the part "
        "that moves last."
    ),
    lambda e: "inputs and outputs of all parts that were held out have settled",
    words="test=FILE.csv",
)

nothing_left = Row(
    lambda e: float(e.nothing_left),
    0.0,
    lambda e: (
        "Nothing is left to find: the errors are white, and as large as the noise seems to be."
    ),
    lambda e: (
        f"training error {percent(e.train)}, noise by the quietest part of the spectrum "
        f"{percent(e.guess)} of the output's standard deviation"
    ),
)

ended_by_limit = Row(
    lambda e: float(e.spent and e.falling <= FALLING and (e.overfit or 0.0) <= _CLOSE),
    0.0,
    lambda e: (
        f"The limit of {e.iterations} iterations ended every start: "
        + ("init_from=RUN goes on from here, " if e.searched else "")
        + f"trainer.max_iter={4 * e.iterations}."
    ),
    lambda e: (
        f"kept iteration {e.iterations} of {e.iterations}"
        + ("; where sizes are chosen the limit is what their ridge was chosen with" * e.searched)
    ),
    lambda e: None if e.searched else {"trainer": replace(e.trainer, max_iter=4 * e.iterations)},
)


def still_falling(e: Evidence) -> Advice | None:
    """The iterations ended before the search did, and the error that falls is on validation."""
    if e.falling <= FALLING or e.validation is None:
        return None
    limit = 4 * max(e.iterations, 1)
    return Advice(
        f"Still falling: trainer.max_iter={limit}; init_from=RUN goes on from here.",
        f"at the pace of the last iterations the validation error falls by {percent(e.falling)} "
        f"in a tenth of the {e.iterations}",
        {"trainer": replace(e.trainer, max_iter=limit)},
    )


def overfits(e: Evidence) -> Advice | None:
    """Validation much above training, or rising while training goes on."""
    if e.parts_differ:
        return None
    part, growth = max(e.growths.items(), key=lambda item: item[1], default=("", 0.0))
    if growth > OVERFIT:
        if part == "test" and e.lost_on_tests:
            return None  # said there
        evidence = (
            f"{part} error {percent(e.test if part == 'test' else e.validation)}, training error "
            f"{percent(e.train)}: {number(growth)} times the growth of the linear model's"
        )
    elif e.overtrained:
        evidence = (
            f"after the kept iterate validation is at {number(e.risen)} times its error, and "
            f"training fell to {percent(e.fell)}; {number(e.samples / max(1, e.parameters))} "
            "samples a parameter"
        )
    else:
        return None
    change = {} if e.searched or e.ridge or e.given else {"ridge": "auto"}
    ridge = f"{_written(change)}, or " if change else "a larger ridge, or " if e.known else ""
    return Advice(f"Overfit: {ridge}more data.", evidence, change or None)


def linear_part_incomplete(e: Evidence) -> Advice | None:
    """An error that is linear in the inputs: states are missing."""
    if not e.states_missing:
        return None
    nx = e.sizes.get("nx", 0)
    order = f"nx={nx + 1}, nx={nx + 2} or nx='auto'" if nx else "a higher nx"
    if e.known:
        order = f"nx={nx + 1} or nx={nx + 2} states beside the known ones"
    return Advice(
        f"The linear part is incomplete: {order}.",
        f"a linear filter of the inputs explains {percent(e.linear)} of the error's power",
        {"nx": nx + 1} if nx or e.known else None,
    )


def hardly_better(e: Evidence) -> Advice | None:
    """No gain over the linear model, of which no states are missing."""
    if not e.useless or e.parts_differ or e.neither or e.states_missing or e.overtrained:
        return None
    error, linear_error, which = e.judged
    gain = f"{which} error {percent(error)}, of the linear model {percent(linear_error)}"
    if e.linear_train and e.noise and e.linear_train <= NOISE_LIMITED * e.noise:
        if e.better or e.linear_train < SOUND * e.noise:
            return None
        return Advice("The system is linear at this level: the linear model is enough.", gain)
    if e.searched:
        if e.better:
            return None
        return Advice(
            "Hardly better than the linear model at any size searched: the system is linear at "
            "this level, or the rest is no static map of a few signals.",
            gain,
        )
    states = {"nx": e.sizes["nx"] + 1} if e.linear is None and e.sizes.get("nx") else {}
    change: dict[str, Any] = _larger(e, states)
    if not e.continued and e.started < 8:
        change = {"starts": 8, **change}
    more = _written(change) or "more data"
    return Advice(
        f"The gain on {which} is small; a longer search or larger sizes may have more: {more}."
        if e.better
        else "Hardly better than the linear model: the system is linear at this level, or the "
        f"search or the sizes are too small: {more}.",
        gain,
        change or None,
    )


def outputs_left_out(e: Evidence) -> Advice | None:
    """Outputs without gain, while others have one: the static map has too few outputs."""
    behind = {name: ratio for name, ratio in e.outputs.items() if ratio > USELESS}
    change = {name: e.sizes.get(name, 0) + 1 for name in ("nw", "nz")}
    if not behind or e.gain is None or e.useless or e.lost_on_tests or not _borne(e, change):
        return None
    ratios = _listed([f"{number(ratio)} times on '{name}'" for name, ratio in behind.items()])
    return Advice(
        f"Some outputs gain nothing, or are linear: {_written(change)}.",
        f"{e.judged[2]} error {ratios} that of the linear model, and less on the others",
        change,
    )


def nonlinear_part_incomplete(e: Evidence) -> Advice | None:
    """An error that is neither noise nor linear: the static map is too small."""
    if e.gain is None or e.useless or e.lost_on_tests or e.states_missing or e.overtrained:
        return None
    if e.noise and e.train is not None:
        # From there on the model's own share is above the noise.
        if e.train <= 1.5 * e.noise:
            return None
        evidence = f"training error {number(e.train / e.noise)} times the noise"
        if e.linear is not None:
            evidence += f", and only {percent(e.linear)} of its power linear in the inputs"
    elif e.nonlinear is not None and e.nonlinear > NONLINEAR:
        part = percent(e.nonlinear)
        evidence = f"squares and cubes of the outputs explain {part} of the error's power"
    else:
        return None
    change = _larger(e)
    larger = _written(change) or "more data would bear a larger map"
    text = "at any size searched; more data may bear a larger map" if e.searched else larger
    return Advice(
        f"Nonlinear behaviour is left: {text}.", evidence, None if e.searched else change or None
    )


def best_start_alone(e: Evidence) -> Advice | None:
    """Starts that end far apart: a better minimum may not have been met."""
    found = sorted(e.starts)
    # Beyond that ratio the best may be luck.
    if len(found) < 2 or found[0] <= 0 or found[1] <= 1.2 * found[0] or e.parts_differ:
        return None
    starts = 2 * max(e.started, 4)
    return Advice(
        f"The minimum may be a poor one: starts={starts}.",
        f"the second best start's error is {number(found[1] / found[0])} times that of the best, "
        f"of {e.started}",
        {"starts": starts},
    )


def one_start(e: Evidence) -> Advice | None:
    """Nothing to compare the minimum with."""
    said = e.useless and not e.overtrained
    if e.started > 1 or e.continued or e.known or said or e.validation is None or e.parts_differ:
        return None  # without validation the start that overfits most would be chosen
    return Advice(
        "Try several starts: starts=8.",
        "one start; fits end in one of several minima",
        {"starts": 8},
    )


def tests_are_louder(e: Evidence) -> Advice | None:
    """Tests beyond the amplitudes of the training data."""
    far = {name: ratio for name, ratio in e.louder.items() if ratio > EXTRAPOLATES}
    if not far:
        return None
    ratios = _listed([f"'{name}' up to {number(ratio)} times" for name, ratio in far.items()])
    apart = max((e.apart.get(name, 0.0) for name in far), default=0.0)
    more = (
        f"; by {percent(apart)} of the output's deviation the starts differ there" if apart else ""
    )
    return Advice(
        "Some tests extrapolate: train on inputs as loud as those the model is for.",
        f"the largest input, over that in training: {ratios}{more}",
    )


def choose_sizes(e: Evidence) -> Advice | None:
    """Sizes that were guessed, and validation records that can choose them."""
    if e.searched or e.given or e.validation is None or e.parts_differ:
        return None
    static = "degree" if e.sizes.get("degree") else "nn"
    change: dict[str, Any] = dict.fromkeys(["nx", "nz", "nw", static], "auto")
    return Advice(
        f"Let the data choose the sizes: {_written(change)}.",
        "the sizes were given",
        change,
    )


def noise_unknown(e: Evidence) -> Advice | None:
    """No telling whether the error is noise."""
    if e.noise is not None or e.guess is not None or e.train is None or e.structured:
        return None
    return Advice(
        "It is unknown whether the remaining error is noise: measure two periods of a periodic "
        "input in steady state for training.",
        f"training error {percent(e.train)} of the output's standard deviation, no repeated "
        "periods in the training records",
    )


_RULES = (  # the most useful first, and whether a rule is on the sizes or the search
    (diverges, False),
    (neither_usable, False),
    (validation_is_unlike, False),
    (gain_is_lost, False),
    (nothing_held_out, False),
    (starts_in_a_transient, False),
    (nothing_moves, False),
    (at_the_noise, False),
    (nothing_left, False),
    (overfits, True),
    (linear_part_incomplete, True),
    (hardly_better, True),
    (outputs_left_out, True),
    (nonlinear_part_incomplete, True),
    (choose_sizes, True),
    (best_start_alone, True),
    (one_start, True),
    (still_falling, True),
    (ended_by_limit, True),
    (tests_are_louder, False),
)


def _larger(e: Evidence, states: Mapping[str, int] = MappingProxyType({})) -> dict[str, int]:
    """Sizes of a larger static map, and of more states; none if the samples do not bear them."""
    if e.known and not (e.sizes.get("nn") or e.sizes.get("degree")):
        return {"nz": 2, "nw": 1, "nn": 4}
    signals = {name: max(2, e.sizes.get(name, 0) + 1) for name in ("nz", "nw")}
    static = {"degree": e.sizes["degree"] + 2} if e.sizes.get("degree") else {}
    if e.sizes.get("nn"):
        static = {"nn": 2 * e.sizes["nn"]}
    tried = ({**states, **static, **signals}, {**states, **static})
    return next((change for change in tried if change and _borne(e, change)), {})


def _borne(e: Evidence, change: Mapping[str, int]) -> bool:
    """Whether larger sizes are advised: validation has not grown, and the samples bear them."""
    growth = _weights({**e.sizes, **change}) / _weights(e.sizes)
    return (e.overfit or 0.0) <= _CLOSE and e.bears(growth)


def _weights(sizes: Mapping[str, int]) -> int:
    """A product of sizes that grows at least as the parameters do."""
    nz, nw = sizes.get("nz", 0), sizes.get("nw", 0)
    static = (nz + 1 + nw) * max(1, sizes.get("nn", 0))
    if sizes.get("degree"):
        static = nw * math.comb(nz + sizes["degree"], nz)
    return max(1, static) * max(1, sizes.get("nx", 0))


def _typed(change: Mapping[str, Any]) -> list[str]:
    """The change as words of the command line."""
    return [
        f"trainer.max_iter={value.limit}" if name == "trainer" else f"{name}={value}"
        for name, value in change.items()
    ]


def _written(change: Mapping[str, Any]) -> str:
    """The change as one writes it."""
    return ", ".join(f"{name}={value!r}" for name, value in change.items())


def _listed(items: Sequence[str]) -> str:
    """The first of them, and how many more there are."""
    more = f" and {len(items) - _FEW} more" if len(items) > _FEW else ""
    return ", ".join(items[:_FEW]) + more
