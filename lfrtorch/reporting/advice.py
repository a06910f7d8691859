"""What to try next after a fit, from numbers alone. Each rule names the numbers that it rests on.

Errors are root mean squares relative to the standard deviation of the training outputs, so that
outputs of any unit count alike.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from lfrtorch._support.tables import number, percent

NOISE_LIMITED = 1.1
"""Training error over the noise up to which the model's own share, √(1.1² - 1), is below half of
the noise."""

BEYOND_NOISE = 1.5
"""Training error over the noise from which on the model's own share is above the noise."""

FALLING = 0.02
"""Part by which the error must have fallen over the last tenth of the iterations to count as still
falling: as many iterations again would bring 18 % at that pace."""

OVERFIT = 1.5
"""Growth from training to validation of the NL-LFR's error over that of the linear model's, which
sees how the records differ."""

USELESS = 0.9
"""Error over the linear model's from which on the NL-LFR is hardly better."""

LINEAR = 0.25
"""Part of the error's power that is linear in the inputs: 0.48 of Bouc-Wen at an order one too low,
0.01 at the right one; 0.97 and 0.08 of Silverbox."""

NONLINEAR = 0.1
"""Part that squares and cubes of the outputs explain: 0.39 and 0.93 for the linear models of
Bouc-Wen and Silverbox, 0.00 and 0.10 for good NL-LFRs."""

TRANSIENT = 3.0
"""Error in the first twentieth of the scored samples over that in the rest."""

ALONE = 1.2
"""Error of the second best start over that of the best above which the best may be luck."""

LOUDER = 1.25
"""Largest test input over the largest in training above which the model extrapolates."""


class Advice(NamedTuple):
    """A sentence that says what to do or to know, and the numbers that it rests on."""

    text: str
    evidence: str

    def __str__(self) -> str:
        return f"{self.text} ({self.evidence})"


@dataclass(frozen=True)
class Evidence:
    """Numbers of a fit; None if one is not known.

    Args:
        train, linear_train: errors of the NL-LFR and of the linear model on the training records.
        validation, linear_validation: on those that chose the iterate.
        outputs: the NL-LFR's error over the linear model's by output, if there are several.
        noise: of the outputs, known or from the differences between periods.
        linear: part of the training error's power that a linear filter of the inputs explains.
        nonlinear: part that squares and cubes of the outputs explain beyond that.
        transient: error at the beginning of the training records over that in the rest.
        falling: part by which the error fell over the last tenth of the iterations, 0 if the
            search ended for another reason than its limit.
        iterations: of the fit.
        starts: errors of all starts that went to the end, the best first.
        started: number of starts.
        continued: whether the fit went on from a model, so that there are no other starts.
        sizes: nx, nz, nw, and nn or degree.
        searched: whether validation chose them.
        trainer: class of the trainer.
        ridge: whether there was one.
        louder: largest test input over the largest in training, by test.
        diverged: tests on which the NL-LFR diverges.
    """

    train: float | None
    linear_train: float | None
    validation: float | None = None
    linear_validation: float | None = None
    outputs: Mapping[str, float] = field(default_factory=dict)
    noise: float | None = None
    linear: float | None = None
    nonlinear: float | None = None
    transient: float | None = None
    falling: float = 0.0
    iterations: int = 0
    starts: Sequence[float] = ()
    started: int = 1
    continued: bool = False
    sizes: Mapping[str, int] = field(default_factory=dict)
    searched: bool = False
    trainer: str = "LevenbergMarquardt"
    ridge: bool = False
    louder: Mapping[str, float] = field(default_factory=dict)
    diverged: Sequence[str] = ()

    @property
    def judged(self) -> tuple[float | None, float | None, str]:
        """Errors of the NL-LFR and the linear model on validation, else on training; and which."""
        if self.validation is None:
            return self.train, self.linear_train, "training"
        return self.validation, self.linear_validation, "validation"

    @property
    def overfit(self) -> float | None:
        """Growth of the error from training to validation over that of the linear model."""
        errors = self.train, self.linear_train, self.validation, self.linear_validation
        if not all(errors):
            return None
        train, linear_train, validation, linear_validation = (error or 0.0 for error in errors)
        # What grows for the linear model as well lies in the records.
        return validation / train / max(1.0, linear_validation / linear_train)

    @property
    def noise_limited(self) -> bool:
        """Whether the training error is noise, and validation agrees."""
        if not self.noise or self.train is None or self.train > NOISE_LIMITED * self.noise:
            return False
        return self.overfit is None or self.overfit <= OVERFIT


def advise(evidence: Evidence) -> list[Advice]:
    """All that the numbers suggest, the most important first.

    At the noise there is no advice on how to make the model larger or the search longer.
    """
    rules = ALWAYS if evidence.noise_limited else (*ALWAYS[:2], *WHERE_NOT_NOISE, *ALWAYS[2:])
    return [found for rule in rules if (found := rule(evidence)) is not None]


def diverges(e: Evidence) -> Advice | None:
    """A test on which the simulation runs away."""
    if not e.diverged:
        return None
    return Advice(
        "The model is not usable yet: train on inputs as loud as the tests', or use "
        + ("a larger ridge." if e.ridge else "ridge=1e-3."),
        f"the NL-LFR diverges on {_listed(e.diverged)}",
    )


def starts_in_a_transient(e: Evidence) -> Advice | None:
    """An error at the beginning of the records: the start state is wrong there."""
    if e.transient is None or e.transient <= TRANSIENT:
        return None
    return Advice(
        "The records do not begin at rest: skip more samples (skip=N), or estimate "
        "their starts (start='estimated').",
        f"in their first twentieth the training error is {number(e.transient)} times that of "
        "the rest",
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


def still_falling(e: Evidence) -> Advice | None:
    """The iterations ended before the search did."""
    if e.falling <= FALLING:
        return None
    return Advice(
        f"Still falling: trainer={e.trainer}(max_iter={4 * max(e.iterations, 1)}); "
        "init_from=run.model goes on from here.",
        f"the error fell by {percent(e.falling)} over the last tenth of the {e.iterations} "
        "iterations",
    )


def overfits(e: Evidence) -> Advice | None:
    """Validation much above training."""
    if e.overfit is None or e.overfit <= OVERFIT:
        return None
    if e.sizes.get("degree"):
        smaller = f"degree={max(2, e.sizes['degree'] - 1)}"
    elif e.sizes.get("nn", 0) > 1:
        smaller = f"nn={e.sizes['nn'] // 2}"
    else:
        smaller = "smaller sizes"
    return Advice(
        f"Overfit: {smaller}, {'a larger ridge' if e.ridge else 'ridge=1e-3'}, or more data.",
        f"validation error {percent(e.validation)}, training error {percent(e.train)}: "
        f"{number(e.overfit)} times the growth of the linear model's",
    )


def linear_part_incomplete(e: Evidence) -> Advice | None:
    """An error that is linear in the inputs: states are missing."""
    if e.linear is None or e.linear <= LINEAR:
        return None
    nx = e.sizes.get("nx", 0)
    order = f"nx={nx + 1}, nx={nx + 2} or nx='auto'" if nx else "a higher nx"
    return Advice(
        f"The linear part is incomplete: {order}.",
        f"a linear filter of the inputs explains {percent(e.linear)} of the error's power",
    )


def hardly_better(e: Evidence) -> Advice | None:
    """No gain over the linear model, of which no states are missing."""
    error, linear_error, which = e.judged
    if e.linear is not None and e.linear > LINEAR:
        return None
    if error is None or not linear_error or error <= USELESS * linear_error:
        return None
    gain = f"{which} error {percent(error)}, of the linear model {percent(linear_error)}"
    if e.linear_train and e.noise and e.linear_train <= NOISE_LIMITED * e.noise:
        return Advice("The system is linear at this level: the linear model is enough.", gain)
    if e.searched:
        return Advice(
            "Hardly better than the linear model at any of the sizes that were searched: the "
            "system is linear at this level, or what is left is no static map of a few signals.",
            gain,
        )
    return Advice(
        "Hardly better than the linear model: the system is linear at this level, or the search "
        f"or the sizes are too small: {_more_starts(e)}{_larger(e)}.",
        gain,
    )


def outputs_left_out(e: Evidence) -> Advice | None:
    """Outputs without gain, while others have one: the static map has too few outputs."""
    error, linear_error, which = e.judged
    behind = {name: ratio for name, ratio in e.outputs.items() if ratio > USELESS}
    if not behind or error is None or not linear_error or error > USELESS * linear_error:
        return None
    ratios = ", ".join(f"{number(ratio)} times on '{name}'" for name, ratio in behind.items())
    return Advice(
        f"Some outputs gain nothing, or are linear: nw={e.sizes.get('nw', 0) + 1}, "
        f"nz={e.sizes.get('nz', 0) + 1}.",
        f"{which} error {ratios} that of the linear model, and less on the others",
    )


def nonlinear_part_incomplete(e: Evidence) -> Advice | None:
    """An error that is neither noise nor linear: the static map is too small."""
    error, linear_error, _ = e.judged
    if e.linear is not None and e.linear > LINEAR:
        return None
    if error is None or (linear_error and error > USELESS * linear_error):
        return None
    if e.noise and e.train is not None:
        if e.train <= BEYOND_NOISE * e.noise:
            return None
        evidence = f"training error {number(e.train / e.noise)} times the noise"
        if e.linear is not None:
            evidence += f", and only {percent(e.linear)} of its power linear in the inputs"
        return Advice(f"Nonlinear behaviour is left: {_larger(e)}.", evidence)
    if e.nonlinear is not None and e.nonlinear > NONLINEAR:
        return Advice(
            f"Nonlinear behaviour is left: {_larger(e)}.",
            f"squares and cubes of the outputs explain {percent(e.nonlinear)} of the error's power",
        )
    return None


def best_start_alone(e: Evidence) -> Advice | None:
    """Starts that end far apart: a better minimum may not have been met."""
    found = sorted(e.starts)
    if len(found) < 2 or found[0] <= 0 or found[1] <= ALONE * found[0]:
        return None
    return Advice(
        f"The minimum may be a poor one: starts={2 * max(e.started, 4)}.",
        f"the second best start's error is {number(found[1] / found[0])} times that of the best, "
        f"of {e.started}",
    )


def one_start(e: Evidence) -> Advice | None:
    """Nothing to compare the minimum with."""
    error, linear_error, _ = e.judged
    useless = error is not None and linear_error and error > USELESS * linear_error  # said there
    if e.started > 1 or e.continued or useless:
        return None
    return Advice("Try several starts: starts=8.", "one start; fits end in one of several minima")


def tests_are_louder(e: Evidence) -> Advice | None:
    """Tests beyond the amplitudes of the training data."""
    far = {name: ratio for name, ratio in e.louder.items() if ratio > LOUDER}
    if not far:
        return None
    ratios = ", ".join(f"'{name}' up to {number(ratio)} times" for name, ratio in far.items())
    return Advice(
        "Some tests extrapolate: train on inputs as loud as those the model is for.",
        f"the largest input, over that in training: {ratios}",
    )


def noise_unknown(e: Evidence) -> Advice | None:
    """No telling whether the error is noise."""
    structure = (e.linear or 0.0) > LINEAR or (e.nonlinear or 0.0) > NONLINEAR  # no noise
    if e.noise is not None or e.train is None or structure:
        return None
    static = "degree" if e.sizes.get("degree") else "nn"
    sizes = ", ".join(f"{name}='auto'" for name in ("nx", "nz", "nw", static))
    choose = f", or let validation choose the sizes: Settings({sizes})"
    return Advice(
        "It is unknown whether the remaining error is noise: give two periods of a periodic input "
        "for training"
        f"{'' if e.searched else choose}.",
        f"training error {percent(e.train)} of the output's standard deviation, no repeated "
        "periods in the training records",
    )


ALWAYS = (diverges, starts_in_a_transient, at_the_noise, tests_are_louder, noise_unknown)

WHERE_NOT_NOISE = (
    still_falling,
    overfits,
    linear_part_incomplete,
    hardly_better,
    outputs_left_out,
    nonlinear_part_incomplete,
    best_start_alone,
    one_start,
)


def _larger(e: Evidence) -> str:
    """Settings of a larger static map."""
    sizes = [f"{name}={max(2, e.sizes.get(name, 0) + 1)}" for name in ("nz", "nw")]
    if e.sizes.get("degree"):
        sizes.insert(0, f"degree={e.sizes['degree'] + 2}")
    elif e.sizes.get("nn"):
        sizes.insert(0, f"nn={2 * e.sizes['nn']}")
    return " or ".join([", ".join(sizes[:-1]), sizes[-1]])


def _more_starts(e: Evidence) -> str:
    return "" if e.continued or e.started >= 8 else "starts=8, "


def _listed(names: Sequence[str]) -> str:
    return ", ".join(f"'{name}'" for name in names)
