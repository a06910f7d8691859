"""Evidence on the errors of a fit, in numbers from records, simulations and the fit's history.

Errors are root mean squares relative to the standard deviation of the training outputs, so that
outputs in any unit have the same weight.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.special import fdtrc

from lfrtorch._support.reasons import SPENT, Reason
from lfrtorch._support.types import Array
from lfrtorch.analysis.densities import noise_of_periods
from lfrtorch.analysis.residual_analysis import Residuals
from lfrtorch.data.metrics import rms
from lfrtorch.data.paired_blocks import BLOCKS, blocked_mean, in_blocks
from lfrtorch.data.records import Record
from lfrtorch.fitting.trainer import FitResult, Trainer
from lfrtorch.least_squares.levenberg_marquardt import LevenbergMarquardt
from lfrtorch.linear.model import LinearModel
from lfrtorch.linear.order_scan import UNLIKE
from lfrtorch.reporting.evaluation import Response, has_settled, training_deviations
from lfrtorch.reporting.explained import explained_parts
from lfrtorch.reporting.verdict import NEITHER, Kind, Verdict
from lfrtorch.survey.signal import survey_signal

NOISE_LIMITED = 1.1
"""Largest training error, over the noise, that counts as noise: the share of the model itself,
√(1.1² - 1), is then below half of the noise."""

SOUND = 0.8
"""Smallest training error over the noise at which the noise is credible: a model with few
parameters has no error far below the noise."""

FALLING = 0.02
"""The error still falls if it falls by more than this part in a tenth of the iterations, at the
pace of the last ones. At that pace, as many iterations again would lower it by 18 %."""

OVERFIT = 1.5
"""Growth of the NL-LFR's error from training to validation, over the growth of the linear model's.
The linear model's growth shows how the records differ."""

USELESS = 0.9
"""Error over the linear model's error, above which the NL-LFR is hardly better."""

UNEXPLAINED = 0.7
"""Training error above which half of the outputs' power is unexplained."""

LINEAR = 0.25
"""Part of the error's power that is linear in the inputs, above which states are missing. It is
0.48 for Bouc-Wen at an order one too low, and 0.01 at the right order; 0.97 and 0.08 for
Silverbox."""

NONLINEAR = 0.1
"""Part of the error's power that squares and cubes of the outputs explain, above which the static
map is too small. It is 0.39 and 0.93 for the linear models of Bouc-Wen and Silverbox, 0.00 and 0.10
for good NL-LFRs."""

EXTRAPOLATES = 1.25
"""Largest input of a test, over that in training, above which the model extrapolates."""

AS_GUESSED = 1.25
"""Largest training error over the estimated noise at which white residuals count as noise. A wrong
estimate is half or twice the noise."""

_BEGINNING = 0.05  # part of a record that is its beginning

_CHANCE = 0.01  # correlations of a larger probability count as chance

LAST = 5
"""The pace of a search is that of at least so many iterations, in a long search of the last
tenth."""


@dataclass(frozen=True)
class Evidence:
    """Numbers of a fit; None for a number that is not known."""

    train: float | None  # error of the NL-LFR on the training records
    linear_train: float | None  # error of the linear model on the training records
    validation: float | None = None  # error on the records that chose the iterate
    linear_validation: float | None = None
    outputs: Mapping[str, float] = field(default_factory=dict)  # error / linear's, if several
    parameters: int = 0  # number without gauge directions
    samples: int = 0  # scored samples in training
    noise: float | None = None  # noise of the outputs, known or from differences between periods
    linear: float | None = None  # part of the error's power that a filter of the inputs explains
    nonlinear: float | None = None  # further part that squares and cubes of the outputs explain
    transient: float | None = None  # training error at the beginning over the error in the rest
    free: float | None = None  # part of the power at the beginning that a free response explains
    unlike_chance: float = 0.0  # probability that linear errors in both parts differ so by chance
    risen: float = 1.0  # median of later validation errors over that of the kept iterate
    fell: float = 1.0  # training error at the end over that of the kept iterate
    falling: float = 0.0  # part by which the error lately fell over a tenth of the iterations
    iterations: int = 0
    starts: Sequence[float] = ()  # errors of all starts that ran to the end, the best first
    started: int = 1  # number of starts
    continued: bool = False  # whether the fit started from a model, so without other starts
    sizes: Mapping[str, int] = field(default_factory=dict)  # nx is the linear model's
    known: bool = False  # whether a part of the model is known; sizes are those of the rest
    searched: bool = False  # whether the data chose the sizes
    trainer: Any = field(default_factory=LevenbergMarquardt)
    ridge: bool = False  # whether there is a ridge
    louder: Mapping[str, float] = field(default_factory=dict)  # largest input / training's, by test
    apart: Mapping[str, float] = field(default_factory=dict)  # standard deviation among starts
    diverged: Sequence[str] = ()  # names of records on which the NL-LFR diverges
    test: float | None = None  # error on all tests together
    linear_test: float | None = None
    guess: float | None = None  # noise estimated from the spectra, if it is not known
    white: bool = False  # whether the residuals are white and independent of the inputs
    spent: bool = False  # whether the limit ended every start, and the last iterate was kept
    settled: bool = False  # whether all records that were held out have settled
    verdict: Verdict | None = None  # advice must agree with it

    @property
    def better(self) -> bool:
        """True if the verdict is that the NL-LFR is the better model."""
        return self.verdict is not None and self.verdict.kind == Kind.BETTER

    @property
    def neither(self) -> bool:
        """True if the verdict is that neither model is usable."""
        return self.verdict is not None and self.verdict.use == NEITHER

    @property
    def judged(self) -> tuple[float | None, float | None, str]:
        """Errors of the NL-LFR and the linear model on validation or in training, and its name."""
        if self.validation is None:
            return self.train, self.linear_train, "training"
        return self.validation, self.linear_validation, "validation"

    @property
    def gain(self) -> float | None:
        """The NL-LFR's error over the linear model's, as ``judged``; 0 without a linear error."""
        error, linear_error, _ = self.judged
        if error is None:
            return None
        return error / linear_error if linear_error else 0.0

    @property
    def behind(self) -> dict[str, float]:
        """Outputs on which the NL-LFR is hardly better than the linear model, and the ratios."""
        return {name: ratio for name, ratio in self.outputs.items() if ratio > USELESS}

    @property
    def nx(self) -> int:
        """States of the linear model; with a known part, the states besides it."""
        return self.sizes.get("nx", 0)

    @property
    def second(self) -> float | None:
        """The error of the second best start over that of the best."""
        best, *others = sorted(self.starts) or [0.0]
        return others[0] / best if others and best > 0 else None

    @property
    def linear_over_noise(self) -> float:
        """The linear model's error in training over the noise; infinite if one is not known."""
        return self.linear_train / self.noise if self.linear_train and self.noise else math.inf

    @property
    def useless(self) -> bool:
        """True if the NL-LFR is hardly better than the linear model."""
        return self.gain is not None and self.gain > USELESS

    @property
    def unexplained(self) -> bool:
        """True if neither model explains the training outputs, and more states would not help."""
        if not self.neither or self.train is None or not self.linear_train:
            return False
        return min(self.train, self.linear_train) > UNEXPLAINED and not self.states_missing

    @property
    def lost_on_tests(self) -> bool:
        """True if there is a gain over the linear model, but not on the tests."""
        if self.tests is None or self.gain is None or self.useless or self.better:
            return False
        return self.tests > USELESS

    @property
    def tests(self) -> float | None:
        """The NL-LFR's error over the linear model's on all tests together."""
        return self.test / self.linear_test if self.test and self.linear_test else None

    @property
    def growths(self) -> dict[str, float]:
        """Growth of the error from training to other parts, over the linear model's growth."""
        # If the linear model's error grows too, the records differ. Louder tests extrapolate.
        parts = {"validation": (self.validation, self.linear_validation)}
        if not self.settled and all(ratio <= EXTRAPOLATES for ratio in self.louder.values()):
            parts["test"] = self.test, self.linear_test
        return {
            name: error / self.train / max(1.0, linear / self.linear_train)
            for name, (error, linear) in parts.items()
            if error and linear and self.train and self.linear_train
        }

    @property
    def overfit(self) -> float | None:
        """The largest of ``growths``."""
        return max(self.growths.values(), default=None)

    @property
    def overtrained(self) -> bool:
        """True if validation rose after the kept iterate, while the training error fell."""
        # With few samples a parameter, training then fits noise.
        crowded = not (self.bears(1.0) or self.states_missing)
        return crowded and self.risen >= 1.05 and self.fell <= 0.99

    def bears(self, growth: float) -> bool:
        """Tell if the samples suffice for ``growth`` times the parameters."""
        # With ten samples a parameter, p/M = 0.1, the error is √((1 + p/M) / (1 - p/M)) = 1.1 times
        # as large on other samples, if the model fits white noise. With more samples a parameter,
        # the map is rather too small: with 11 and 21 a larger map was better on the coupled drives
        # and the tanks. So a larger map must leave more than ten, or the next fit would overfit.
        return self.samples > 10 * growth * self.parameters

    @property
    def noise_limited(self) -> bool:
        """True if the training error is noise, the search has converged, and validation agrees."""
        if not self.noise or self.train is None or self.falling > FALLING:
            return False
        if not SOUND * self.noise <= self.train <= NOISE_LIMITED * self.noise:
            return False
        return self.overfit is None or self.overfit <= OVERFIT

    @property
    def nothing_left(self) -> bool:
        """Tell whether the residuals are white, and about as large as the estimated noise."""
        if not self.guess or not self.white or self.train is None or self.noise:
            return False
        if self.falling > FALLING or (self.overfit or 0.0) > OVERFIT:
            return False
        return self.train <= AS_GUESSED * self.guess

    @property
    def states_missing(self) -> bool:
        """True if a large part of the error is linear in the inputs."""
        return (self.linear or 0.0) > LINEAR

    @property
    def structured(self) -> bool:
        """True if a part of the training error is not noise: it follows from inputs or outputs."""
        return self.states_missing or (self.nonlinear or 0.0) > NONLINEAR

    @property
    def parts_differ(self) -> bool:
        """True if validation and training records differ, and not by chance."""
        if not self.linear_train or self.linear_validation is None:
            return False
        ratio = self.linear_validation / self.linear_train
        return not 1.0 / UNLIKE <= ratio <= UNLIKE and self.unlike_chance <= 0.01

    @property
    def proven(self) -> bool:
        """True if the trainer keeps a proof in every step: then no sizes or ridge can be chosen."""
        return getattr(self.trainer, "guarantee", None) not in (None, "stable")

    @property
    def given(self) -> bool:
        """True if sizes and ridge cannot be chosen from the data."""
        return self.continued or self.proven or self.known


def evidence(
    result: FitResult,
    responses: Sequence[Response],
    *,
    bla: LinearModel | None = None,  # its free responses reveal a wrong start
    noise_rms: float | None = None,  # noise of the training outputs in their unit, if it is known
    continued: bool = False,  # whether the fit started from a model
    ridge: bool = False,  # whether there is a ridge
    searched: bool = False,  # whether the data chose the sizes
    trainer: Trainer | None = None,  # default: Levenberg-Marquardt
    verdict: Verdict | None = None,
    residuals: Residuals | None = None,
) -> Evidence:
    """Compute the numbers behind advice, from the responses of all records."""
    train, validation, tests = (
        [response for response in responses if response.use == use]
        for use in ("train", "validation", "test")
    )
    y = np.concatenate([response.scored for response in train])
    scale = np.std(y, axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    noise = noise_of_periods([response.record for response in train])
    if noise is None and noise_rms is not None:
        noise = np.full(len(scale), noise_rms)
    linear, nonlinear = explained_parts(train)
    if any(response.record.start == "measured" for response in train):
        linear = None  # the states are the outputs, so none can be missing
    here, there = ([r.linear_error / scale for r in part] for part in (train, validation))
    risen, fell = after_kept(result)
    peak = _peak(train, result.model.scaler.u_offset)
    loud = {
        test.record.name: float(
            np.max(_peak([test], result.model.scaler.u_offset) / np.where(peak > 0, peak, 1.0))
        )
        for test in tests
    }
    transient, free = (None, None) if bla is None else _transient(train, scale, bla)
    held_out = [r for r in responses if r.use != "train"]
    deviations = training_deviations(responses)
    known = result.model.known_states > 0
    return Evidence(
        train=_error([r.error for r in train], scale),
        linear_train=_error([r.linear_error for r in train], scale),
        validation=_error([r.error for r in validation], scale),
        linear_validation=_error([r.linear_error for r in validation], scale),
        outputs=_by_output(validation or train),
        parameters=result.model.net_parameter_count,
        samples=sum(len(r.scored) for r in train),
        noise=None if noise is None else float(rms(noise / scale)),
        linear=linear,
        nonlinear=nonlinear,
        transient=transient,
        free=free,
        unlike_chance=chance_of_ratio(here, there),
        risen=risen,
        fell=fell,
        falling=falling(result),
        iterations=result.iterations,
        starts=_finished(result),
        started=max(1, len(result.starts)),
        continued=continued,
        sizes=result.model.sizes | ({} if bla is None or known else {"nx": bla.nx}),
        known=known,
        searched=searched,
        trainer=LevenbergMarquardt() if trainer is None else trainer,
        ridge=ridge,
        louder=loud,
        apart={
            r.record.name: _apart(result, r, scale)
            for r in tests
            if loud[r.record.name] > EXTRAPOLATES
        },
        diverged=[r.record.name for r in responses if r.use != "train" and r.diverged],
        test=_error([r.error for r in tests], scale),
        linear_test=_error([r.linear_error for r in tests], scale),
        guess=_guess([response.record for response in train], scale) if noise is None else None,
        white=residuals is not None
        and all(p > _CHANCE for part in residuals.parts for p in part.p.values()),
        spent=result.chosen_iteration == result.iterations > 0
        and all(reason in SPENT for reason in [s.reason for s in result.starts] or [result.reason]),
        settled=bool(held_out) and all(has_settled(r, deviations) for r in held_out),
        verdict=verdict,
    )


def _guess(train: Sequence[Record], scale: Array) -> float | None:
    """The noise that preview estimates in the longest record, over the scale; None if it cannot."""
    record = max(train, key=lambda record: record.samples)
    y, u = record.y[record.skip :], record.u[record.skip :]
    if record.valid is not None or not len(y):
        return None
    found = [
        survey_signal(own, slice(None), channel, inputs=u).noise
        for own, channel in zip(y.T, record.outputs, strict=True)
    ]
    known = [noise for noise in found if noise is not None]
    return float(rms(known / scale)) if len(known) == len(found) else None


def _apart(result: FitResult, response: Response, scale: Array) -> float:
    """Standard deviation of the outputs among the starts of a mean, over the scale; 0 without."""
    if not result.members:
        return 0.0
    outputs = [model.simulate(response.record) for model in result.members]
    return float(rms(np.std(outputs, axis=0, ddof=1)[response.record.skip :] / scale))


def falling(result: FitResult) -> float:
    """Part by which the judging error falls in a tenth of the iterations, at the last pace."""
    # The pace is that of the last tenth, but of at least five iterations. The part is 0 unless the
    # limit ended the search.
    history = result.history
    iterations = len(history) - 1
    if result.reason not in SPENT or not iterations:
        return 0.0
    last = min(max(LAST, iterations // 10), iterations)
    before = min(p.score for p in history[:-last])
    after = min(p.score for p in history)
    lately = min(p.score for p in history[-math.ceil(last / 2) :])
    if not (math.isfinite(before) and before > 0) or lately > after:
        return 0.0
    return 1.0 - math.sqrt(after / before) ** (iterations / 10 / last)


def after_kept(result: FitResult) -> tuple[float, float]:
    """Median of the later validation errors, and last training error, over the kept iterate's."""
    # Both are 1 if validation did not choose, or if fewer than five iterations follow.
    if not result.history:
        return 1.0, 1.0
    kept, *later = result.history[result.chosen_iteration :]
    if len(later) < LAST or not kept.validation > 0 or not kept.train > 0:
        return 1.0, 1.0
    errors = [p.validation if math.isfinite(p.validation) else math.inf for p in later]
    return float(np.median(errors)) / kept.validation, later[-1].train / kept.train


def chance_of_ratio(here: Sequence[Array], there: Sequence[Array]) -> float:
    """Probability that errors of the same size differ in power at least as much as these do."""
    # This is an F test. Its degrees of freedom follow from the scatter over ten blocks of time, on
    # the side that varies more (Satterthwaite, Biometrics Bulletin 2(6), 1946): slow errors, or a
    # few large errors, have few. The result is 1 if a side has fewer samples than blocks, or no
    # error.
    powers, samples, spread = [], [], 0.0
    for errors in (here, there):
        squares = [np.mean(error**2, axis=1) for error in errors]
        if sum(map(len, squares)) < BLOCKS:
            return 1.0
        blocks = in_blocks(squares)
        sums, counts = (np.array([of(block) for block in blocks]) for of in (np.sum, len))
        power, error = blocked_mean(sums, counts)
        if not 0 < power < math.inf:
            return 1.0
        powers.append(power)
        samples.append(counts.sum())
        spread = max(spread, counts.sum() * float(error / power) ** 2)  # variance of one sample
    high, low = np.argsort(powers)[::-1]
    freedom = 2.0 * np.array(samples) / max(spread, np.finfo(float).tiny)
    one_side = fdtrc(freedom[high], freedom[low], powers[high] / powers[low])
    return min(1.0, 2.0 * float(one_side))


def _error(errors: Sequence[Array], scale: Array) -> float | None:
    """RMS of errors in units of the scale; None without records or if one diverges."""
    if not errors:
        return None
    error = float(rms(rms(np.concatenate(errors), axis=0) / scale))
    return error if math.isfinite(error) else None


def _by_output(responses: Sequence[Response]) -> dict[str, float]:
    """The NL-LFR's error over the linear model's by output, if there are several."""
    outputs = responses[0].record.outputs
    linear, error = (
        rms(np.concatenate(errors), axis=0)
        for errors in ([r.linear_error for r in responses], [r.error for r in responses])
    )
    if len(outputs) == 1 or not np.isfinite(error).all():
        return {}
    return {c.name: float(e / b) for c, e, b in zip(outputs, error, linear, strict=True) if b > 0}


def _transient(
    train: Sequence[Response], scale: Array, bla: LinearModel
) -> tuple[float | None, float | None]:
    """Error at the beginning over the rest, and the part of it that free responses explain."""
    # States of the linear model are fitted to the first half of the beginning, and judged on all of
    # the beginning. The result is None if the starts are known or fitted.
    first, rest, left = [], [], []
    for response in train:
        if response.record.start in ("periodic", "estimated"):
            continue
        error = response.error / scale
        count = math.ceil(_BEGINNING * len(error))
        first.append(error[:count])
        rest.append(error[count:])
        x, free = np.linalg.matrix_power(bla.A, response.record.skip), []
        for _ in range(count):
            free.append(bla.C @ x / scale[:, None])
            x = bla.A @ x
        half = max(1, count // 2)
        if half * len(scale) > bla.nx and np.isfinite(error[:count]).all():
            response_to = np.array(free)
            state = np.linalg.lstsq(
                response_to[:half].reshape(-1, bla.nx), error[:half].ravel(), rcond=None
            )[0]
            left.append(error[:count] - response_to @ state)
    if not first or not sum(map(len, rest)):
        return None, None
    beginning, usual = (float(np.mean(rms(np.concatenate(part), axis=0))) for part in (first, rest))
    if not (0 < usual < math.inf and math.isfinite(beginning)):
        return None, None
    free_part = None
    if len(left) == len(first) and beginning > 0:
        powers = [sum(float(np.sum(part**2)) for part in parts) for parts in (left, first)]
        free_part = max(0.0, 1.0 - powers[0] / powers[1])
    return beginning / usual, free_part


def _peak(responses: Sequence[Response], offset: Array) -> Array:
    """Largest distance (nu,) of the inputs from the operating point."""
    return np.max([np.abs(r.record.u - offset).max(axis=0) for r in responses], axis=0)


def _finished(result: FitResult) -> list[float]:
    """Sorted errors of the starts that ran to the end, on validation if there is one."""
    found = [
        start.train if math.isnan(start.validation) else start.validation
        for start in result.starts
        if start.reason != Reason.OTHERS_BETTER
    ]
    return sorted(error for error in found if math.isfinite(error))
