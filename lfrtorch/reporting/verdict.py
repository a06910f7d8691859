"""The verdict on a fit: is the NL-LFR better than the linear model on what was not fitted?

Both models see the same noise of a record. So they are compared by the ratio of their errors over
the same blocks of time, and by the standard error of its logarithm. (The standard error of the
difference is large if a few resonances make up most of the error, even if one model is better in
every block.) A ratio is clear if its logarithm is beyond Student's quantile, or if one error is
twice the other: a burst in which one model runs away has a large standard error, but is not chance.
Differences below 5 % do not count.

In cross-validation the whole record is left out in turn, and each quarter of a stretch is judged by
models that were fitted without the stretch and chosen without the quarter. There, 2.25 standard
errors and 0.3 % are enough (``benchmarks/first_try.md``): noise may be most of both errors. One
stretch in which a model runs away may have most of the error, but must not decide. So the mean log
ratio of the blocks, with each ratio limited to a factor of 3, has to point the same way. This mean
is enough by itself if it stands for a ratio below 0.85 and is 2 standard errors below 0.

A part in which inputs and outputs stand still, such as the end of a step test, shows only the
static gain. It can show that a model is worse, but not that it is better: only parts that move can.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any, NamedTuple

import numpy as np
from scipy.special import stdtrit

from lfrtorch._support.reasons import Reason
from lfrtorch._support.tables import number, percent
from lfrtorch._support.types import Array, Integers
from lfrtorch.data.metrics import nrmse, rms
from lfrtorch.data.paired_blocks import BLOCKS, Judge, in_blocks
from lfrtorch.fitting.trainer import FitResult
from lfrtorch.reporting.evaluation import CROSS, Response, has_settled, training_deviations

NL_LFR = "NL-LFR"
"""Value of ``use`` that recommends the NL-LFR."""

LINEAR_MODEL = "linear model"
"""Value of ``use`` that recommends the linear model."""

NEITHER = "neither"
"""Value of ``use`` that recommends neither model."""

SAME = 0.05
"""Difference of the errors, relative to the linear model's, below which neither is preferred."""

# SAME in cross-validation, and the standard errors by which a log ratio is clear there.
_CROSS_SAME, _CROSS_CLEAR = 0.003, 2.25
_TYPICAL, _TYPICAL_CLEAR = 0.85, 2.0  # mean ratio of the blocks that is enough, standard errors
_MOST = 3.0  # ratios of blocks are limited to this factor and its inverse
_CROSS_BLOCKS = 16  # blocks of a record in cross-validation: four in each stretch
_LEAST_ERROR = 1e-3  # smallest standard error of the mean log ratio: all blocks may be alike

_CLEAR = 2.0  # ratio of two errors that is not chance, whatever its standard error

CONFIDENCE = 0.975
"""One-sided probability of the quantile that a log ratio must exceed. If records are compared one
by one, the remaining 0.025 are divided among them."""

EXPLAINS_NOTHING = 0.9
"""Error over the output's standard deviation from which on a model is of no use. The standard
deviation is that of the record, or of the training records if it is larger there: a record may have
settled."""


_LONGEST_NAME = 28  # characters of a record's name in a sentence


class Kind(StrEnum):
    """Kinds of verdicts."""

    BETTER = "better"
    """The NL-LFR is clearly better than the linear model on records that were not fitted."""
    LINEAR = "linear"
    """The NL-LFR is not clearly better: the linear model does as well."""
    WORSE = "worse"
    """The NL-LFR is clearly worse on at least one of these records."""
    DIVERGES = "diverges"
    """The simulation of the NL-LFR runs away on a record, or the search failed."""
    UNJUDGED = "unjudged"
    """No record that moves was held out: only the training error, or the static gain, is known."""


class Comparison(NamedTuple):
    """Errors of both models on one or several records, with the same weight for each output."""

    name: str  # name of the records in a sentence, such as "test 'sweep'"
    ratio: float  # error of the NL-LFR over the error of the linear model
    ratio_std: float  # standard error of the ratio
    deviations: float  # logarithm of the ratio, in standard errors
    clear: float  # standard errors from which on the ratio is clear
    nrmse: float  # error of the NL-LFR over the output's standard deviation
    linear_nrmse: float  # the same for the linear model
    same: float = SAME  # relative differences below this do not count
    cross: bool = False  # whether these are errors of cross-validation
    middle: float = 1.0  # geometric mean of the blocks' ratios, each limited to 1/3 .. 3
    typical: bool = False  # whether ``middle`` is clearly small, in cross-validation

    @property
    def worse(self) -> bool:
        """True if the NL-LFR's error is clearly larger."""
        certain = self.deviations > self.clear or self.ratio >= _CLEAR
        return certain and self.ratio > 1.0 + SAME and not (self.cross and self.middle <= 1.0)

    @property
    def better(self) -> bool:
        """True if the NL-LFR's error is clearly smaller."""
        certain = self.deviations < -self.clear or self.ratio <= 1.0 / _CLEAR
        whole = certain and self.ratio < 1.0 - self.same
        # In cross-validation, one stretch in which a model runs away does not decide.
        return self.typical or (whole and not (self.cross and self.middle >= 1.0))

    @property
    def hidden(self) -> bool:
        """Tell whether a runaway in one stretch hides that most blocks are better."""
        return self.typical and not self.ratio < 1.0 - self.same

    @property
    def told(self) -> float:
        """The ratio for the sentence: ``middle`` if a runaway hides the gain."""
        return self.middle if self.hidden else self.ratio

    def entry(self) -> dict[str, Any]:
        """For ``metrics.json``."""
        numbers = self._asdict()
        return {"on": numbers.pop("name"), **numbers}


@dataclass(frozen=True)
class Comparisons:
    """Comparisons that a verdict rests on."""

    whole: Comparison | None = None  # comparison on all records that judge
    records: Sequence[Comparison] = ()  # comparison on each record that was not fitted
    diverges: Sequence[str] = ()  # names of records on which the NL-LFR runs away
    ahead: Mapping[int, Comparisons] = field(default_factory=dict)  # by the samples ahead

    def entry(self) -> dict[str, Any]:
        """For ``metrics.json``."""
        found: dict[str, Any] = {} if self.whole is None else self.whole.entry()
        found |= {"records": [c.entry() for c in self.records], "diverges": [*self.diverges]}
        ahead = {str(ahead): other.entry() for ahead, other in self.ahead.items()}
        return found | ({"ahead": ahead} if ahead else {})


@dataclass(frozen=True)
class Verdict:
    """Comparison of the NL-LFR with the linear model."""

    kind: Kind
    text: str  # the verdict as a sentence of at most 160 characters
    use: str  # the model to use: "NL-LFR", "linear model" or "neither"
    evidence: Comparisons = field(default_factory=Comparisons)

    @property
    def colour(self) -> str:
        """``"red"`` if bad, ``"amber"`` if linear, ``"green"`` if better, else ``"grey"``."""
        if self.use == NEITHER or self.kind in (Kind.WORSE, Kind.DIVERGES):
            return "red"
        return {Kind.BETTER: "green", Kind.LINEAR: "amber"}.get(self.kind, "grey")

    def __str__(self) -> str:
        return self.text

    def entry(self) -> dict[str, Any]:
        """For ``metrics.json``."""
        return {**vars(self), "evidence": self.evidence.entry()}


class Refusal(NamedTuple):
    """A reason not to call an NL-LFR better although its error is smaller."""

    text: str  # at most 42 characters, after "the error is 67 % of its, but"
    kind: Kind = Kind.WORSE  # kind of the verdict


REMEMBERS = Refusal("it does not forget where it began", Kind.LINEAR)
"""Refusal of a model whose output always depends on its start, unlike the system's."""


class _Errors(NamedTuple):
    """Relative squared errors of a record, summed over each block of time (B,)."""

    response: Response
    squares: Array  # of the NL-LFR
    linear: Array  # of the linear model
    counts: Integers  # samples of each block
    power: float  # mean square of the outputs, each without its mean and over its scale
    settled: bool  # whether the record has settled, so that it shows only the static gain


class _Case(NamedTuple):
    """Numbers that the rules of a verdict use."""

    result: FitResult
    lost: Sequence[Response]  # records on which the NL-LFR diverges
    whole: Comparison | None  # comparison on all records that judge
    worst: Comparison | None  # comparison on the record where it is worst, if clearly worse
    held_out: bool  # whether the records that judge were not fitted
    settled: str  # names of tests that have settled, if no test moves
    moves: bool  # whether a record that judges moves
    nx: int  # order of the linear model
    error: str  # name of the error that is compared
    refusals: Sequence[Refusal]

    @property
    def linear(self) -> str:
        """The linear model in words."""
        return f"the linear model (nx {self.nx})"


_Found = tuple[Kind, str, str]  # kind of the verdict, the model to use, and the sentence


def judge(
    result: FitResult,
    responses: Sequence[Response],
    *,
    linear_nx: int,
    error: str = "error",
    refusals: Sequence[Refusal] = (),
) -> Verdict:
    """Judge a fit by the errors on all records.

    If the NL-LFR is clearly worse on any record that was not fitted, the verdict is "worse". The
    NL-LFR is better if it is clearly better on all tests together and no refusal applies. If no
    test moves, validation takes the place of the tests. Records with fewer than ten scored samples
    do not count.

    """
    lost = [r for r in responses if not np.isfinite(rms(r.error))]
    errors = _errors([r for r in responses if r not in lost], responses)
    held_out = [e for e in errors if e.response.use != "train"]
    tests = [e for e in held_out if e.response.use == "test"]
    moving = [e for e in held_out if not e.settled]
    judged = [e for e in moving if e.response.use == "test"] or moving or tests or held_out
    still = [e.response for e in tests or held_out if e.settled]
    every = [_compared([e], len(held_out)) for e in held_out if not _is_cross(e.response)]
    if cross := [e for e in held_out if _is_cross(e.response)]:
        every.append(_compared(cross))
    whole = _compared(judged or errors) if errors else None
    evidence = Comparisons(whole, every, [_name(r) for r in lost])
    case = _Case(
        result=result,
        lost=lost,
        whole=whole,
        worst=max((c for c in every if c.worse), key=lambda c: c.ratio, default=None),
        held_out=bool(held_out),
        settled=_names(still) if still and not any(e in tests for e in moving) else "",
        moves=bool(moving),
        nx=linear_nx,
        error=error,
        refusals=refusals,
    )
    found = _unusable(case) or _unjudged(case)
    if found is None:
        assert whole is not None
        found = _judged(case, whole)
    kind, use, text = found
    if whole is not None and held_out and use != NEITHER:
        own = whole.told * whole.linear_nrmse if whole.hidden else whole.nrmse
        used = own if use == NL_LFR else whole.linear_nrmse
        if used >= EXPLAINS_NOTHING:
            use = NEITHER
            text = (
                f"Neither model is usable: on {whole.name} errors are {percent(whole.nrmse)} "
                f"(NL-LFR) and {percent(whole.linear_nrmse)} (linear, nx {linear_nx}) of the "
                "output's standard deviation"
            )
    advice = "; use the linear model" if use == LINEAR_MODEL else ""
    return Verdict(kind, f"{text}{advice}.", use, evidence)


def _unusable(c: _Case) -> _Found | None:
    """The verdict if the NL-LFR runs away, was not trained, or is clearly worse on a record."""
    lost = f"The NL-LFR diverges on {_names(c.lost)}" if c.lost else ""
    if lost and all(nrmse(r.record, r.y_linear) >= EXPLAINS_NOTHING for r in c.lost):
        nothing = f", where {c.linear} explains nothing, either: neither is usable"
        return Kind.DIVERGES, NEITHER, lost + nothing
    if lost:
        return Kind.DIVERGES, LINEAR_MODEL, lost
    failed = c.result.reason in (Reason.GRADIENT_DIVERGED, Reason.JACOBIAN_VANISHES)
    if failed and c.result.chosen_iteration == 0:
        return Kind.DIVERGES, LINEAR_MODEL, f"The NL-LFR was not trained: {c.result.reason}"
    if c.worst is not None:
        times = f"{number(c.worst.ratio)} times as large"
        on = f"on {c.worst.name} the NL-LFR's {c.error} is {times}"
        return Kind.WORSE, LINEAR_MODEL, f"Worse than {c.linear}: {on}"
    return None


def _unjudged(c: _Case) -> _Found | None:
    """The verdict if no record that is held out is long enough, or moves."""
    if c.whole is None:
        return Kind.UNJUDGED, NL_LFR, f"Not judged: no record has {BLOCKS} samples"
    if not c.held_out:
        on = f"on {c.whole.name} the {c.error} is {of_linear(c.whole.ratio)} (nx {c.nx})"
        use = NL_LFR if c.whole.ratio < 1.0 - SAME else LINEAR_MODEL
        return Kind.UNJUDGED, use, f"Not judged (nothing held out): {on}"
    if not c.moves:
        settled = f"{c.settled} settled and shows only the static gain"
        return Kind.UNJUDGED, LINEAR_MODEL, f"Not judged against {c.linear}: {settled}"
    return None


def _judged(c: _Case, whole: Comparison) -> _Found:
    """The verdict by the comparison on the records that were held out."""
    told = f"{percent(whole.told)} of its"
    on = f"on {whole.name} the"
    if whole.better and c.refusals:
        but = f"the {c.error} is {told}, but {c.refusals[0].text}"
        return c.refusals[0].kind, LINEAR_MODEL, f"Not better than {c.linear}: {but}"
    if whole.better:
        still = f" ({c.settled} settled)" if c.settled else ""
        constant = ", itself worse than a constant" * (whole.linear_nrmse > 1.0)
        told = told if constant or still else of_linear(whole.told)
        most = "in most blocks " * whole.hidden
        text = f"Better than {c.linear}{constant}: {on} NL-LFR's {c.error} is {most}{told}{still}"
        return Kind.BETTER, NL_LFR, text
    # Three digits show neither the difference nor its standard error.
    if abs(whole.ratio - 1.0) + whole.ratio_std < 5e-4:
        kept = "the fit kept its start, and " * (c.result.chosen_iteration == 0)
        return Kind.LINEAR, LINEAR_MODEL, f"As {c.linear}: {kept}{on} errors are the same"
    clearly = "clearly " * (whole.ratio < 1.0 - whole.same)
    ratio = f"{number(100 * whole.ratio)} ± {number(100 * whole.ratio_std, 2)} % of its"
    text = f"Not {clearly}better than {c.linear}: {on} {c.error} is {ratio}"
    return Kind.LINEAR, LINEAR_MODEL, text


def judge_predictions(
    result: FitResult,
    views: Mapping[int, Sequence[Response]],
    *,
    linear_nx: int,
    refusals: Sequence[Refusal] = (),
) -> Verdict:
    """Judge a fit by predictions; ``views`` are keyed by the samples ahead, the fewest first.

    A model with a small error one sample ahead is not better if it is worse farther ahead. If both
    models leave only sensor noise one sample ahead, the errors farther ahead decide.

    """
    farther = {
        ahead: judge(result, responses, linear_nx=linear_nx, error=f"error {ahead} ahead")
        for ahead, responses in [*views.items()][1:]
    }
    refusals = [*refusals, *(r for at in farther.items() if (r := _farther(*at)) is not None)]
    first = judge(
        result,
        next(iter(views.values())),
        linear_nx=linear_nx,
        error="prediction error",
        refusals=refusals,
    )
    seen = {ahead: other.evidence for ahead, other in farther.items()}
    found = replace(first, evidence=replace(first.evidence, ahead=seen))
    if first.use == NEITHER or first.kind not in (Kind.BETTER, Kind.LINEAR) or refusals:
        return found
    whole = first.evidence.whole
    assert whole is not None
    better = [each for each in farther.values() if each.kind == Kind.BETTER and each.use == NL_LFR]
    if first.kind == Kind.BETTER:
        every = [whole, *(e.evidence.whole for e in farther.values())]
        ratios = [each.ratio for each in every if each is not None]
        listed = " and ".join(", ".join(f"{number(100 * r)}" for r in ratios).rsplit(", ", 1))
        which = " and ".join(", ".join(map(str, views)).rsplit(", ", 1))
        text = (
            f"Better than the linear model (nx {linear_nx}): on {whole.name} the "
            f"errors {which} samples ahead are {listed} % of its."
        )
        return replace(found, text=text)
    if not better:
        return found
    text = f"{better[0].text[:-1]}, {percent(whole.ratio)} one ahead."
    return replace(better[0], text=text, evidence=found.evidence)


def _farther(ahead: int, verdict: Verdict) -> Refusal | None:
    """The refusal that follows from a verdict farther ahead; None if both models fail there."""
    whole = verdict.evidence.whole
    ratio = math.inf if whole is None else whole.ratio
    worse = verdict.kind == Kind.WORSE and (verdict.use != NEITHER or ratio >= _CLEAR)
    if verdict.kind == Kind.DIVERGES:
        return Refusal(f"it diverges {ahead} samples ahead", Kind.DIVERGES)
    return Refusal(f"{number(ratio)} times as large {ahead} samples ahead") if worse else None


class LinearVerdict(NamedTuple):
    """Judgement of a linear model alone."""

    usable: bool | None  # None if nothing is scored
    text: str
    on: str | None = None  # use of the records that judge
    output: str | None = None  # name of the output with the largest error
    nrmse: float | None = None  # error of this output over its standard deviation


def judge_linear(responses: Sequence[Response]) -> LinearVerdict:
    """Judge a linear model by its worst output on the tests, or on validation, or in training."""
    uses = "test", "validation", "train"
    parts = {use: [r for r in responses if r.use == use] for use in uses}
    errors = {use: _relative_errors(part, responses) for use, part in parts.items()}
    judged = next((use for use, found in errors.items() if found), None)
    if judged is None:
        return LinearVerdict(None, "Not judged: nothing is scored.")
    name, error = max(errors[judged].items(), key=lambda item: item[1])
    usable = error < EXPLAINS_NOTHING
    output = "the output" if len(errors[judged]) == 1 else f"'{name}'"
    size = f"{percent(error)} of the standard deviation of {output}"
    if not math.isfinite(error):
        size = f"without bound at {output}"
    where = "training" if judged == "train" else judged
    text = f"{'' if usable else 'Not usable: '}on {where} the linear model's error is {size}"
    fitted_error = errors["train"].get(name)
    if error > 1.0:
        text += ", worse than a constant"
    if not usable and judged != "train" and fitted_error is not None:
        text += f" (in training {percent(fitted_error)})"
    deviations = training_deviations(responses)
    if usable and judged != "train" and all(has_settled(r, deviations) for r in parts[judged]):
        text += f"; {where} has settled and shows only the static gain"
    return LinearVerdict(usable, f"{text[0].upper()}{text[1:]}.", judged, name, error)


def _relative_errors(part: Sequence[Response], every: Sequence[Response]) -> dict[str, float]:
    """Each output's error over its standard deviation, on all records of a part together."""
    _, common = training_deviations(every)
    powers: dict[str, Array] = {}
    for s in (response.score for response in part):
        own = zip(s.channels, s.lti_rmse_by_output, np.fmax(s.std_by_output, common), strict=True)
        for channel, error, deviation in own:
            if s.scored and deviation > 0:
                bounded = error if math.isfinite(error) else math.inf
                power = s.scored * np.square([bounded, deviation])
                powers[channel.name] = powers.get(channel.name, np.zeros(2)) + power
    return {name: float(np.sqrt(error / own)) for name, (error, own) in powers.items()}


def of_linear(ratio: float) -> str:
    """An error over the linear model's in words."""
    if ratio < 1.005:  # 1.00 in three digits
        return f"{percent(ratio)} of the linear model's"
    return f"{number(ratio)} times the linear model's"


def _errors(responses: Sequence[Response], every: Sequence[Response]) -> list[_Errors]:
    """Squared errors of all records that are long enough, each output over its scale."""
    if not every:
        return []
    u, y = training_deviations(every)
    scale = np.where(y > 0, y, 1.0)
    found = []
    for response in responses:
        if len(response.scored) < BLOCKS or not np.isfinite(rms(response.linear_error)):
            continue
        squares, linear = (
            [np.mean((error / scale) ** 2, axis=1)]
            for error in (response.error, response.linear_error)
        )
        count = _CROSS_BLOCKS if _is_cross(response) else BLOCKS
        blocks = in_blocks(squares, min(count, len(response.scored)))
        own = np.maximum(response.scored.std(axis=0), y) / scale
        found.append(
            _Errors(
                response,
                np.array([block.sum() for block in blocks]),
                np.array([block.sum() for block in in_blocks(linear, len(blocks))]),
                np.array([len(block) for block in blocks]),
                float(np.mean(own**2)),
                has_settled(response, (u, y)),
            )
        )
    return found


def _compared(
    errors: Sequence[_Errors],
    among: int = 1,  # number of records that are compared one by one
) -> Comparison:
    """Compare both models on records; errors are relative to the linear model's on each record."""
    counts = np.concatenate([e.counts for e in errors])
    samples = np.array([e.counts.sum() for e in errors])
    # If the linear model has no error on a record, such as one without motion, the scale is 1.
    levels = np.array([e.linear.sum() for e in errors]) / samples
    levels = np.where(levels > 0, levels, 1.0)
    squares, linear = (
        np.concatenate([e / level for e, level in zip(each, levels, strict=True)])
        for each in ([e.squares for e in errors], [e.linear for e in errors])
    )
    beside = Judge(np.array([linear, squares]), counts)
    ratio, ratio_std = beside.ratio()
    power = float(np.dot([e.power for e in errors], samples)) or math.nan
    first = errors[0].response
    several = f"{len(errors)} {_use(first)} records"
    cross = all(_is_cross(e.response) for e in errors)
    middle, far = beside.middle(_MOST, _LEAST_ERROR)
    clear = stdtrit(len(counts) - 1, 1.0 - (1.0 - CONFIDENCE) / max(1, among))
    return Comparison(
        name=_name(first) if len(errors) == 1 else several,
        ratio=ratio,
        ratio_std=ratio_std,
        deviations=math.log(ratio) * ratio / ratio_std if ratio_std > 0 else 0.0,
        clear=_CROSS_CLEAR if cross else float(clear),
        nrmse=math.sqrt(sum(e.squares.sum() for e in errors) / power),
        linear_nrmse=math.sqrt(sum(e.linear.sum() for e in errors) / power),
        same=_CROSS_SAME if cross else SAME,
        cross=cross,
        middle=math.exp(middle),
        typical=cross and middle < math.log(_TYPICAL) and far < -_TYPICAL_CLEAR,
    )


def _is_cross(response: Response) -> bool:
    """Tell whether a response is that of cross-validation, with other models in each stretch."""
    return response.record.name.endswith(CROSS)


def _use(response: Response) -> str:
    """The use of a record in a sentence."""
    return "training" if response.use == "train" else response.use


def _name(response: Response) -> str:
    """The name of a record in a sentence."""
    name, use = response.record.name, _use(response)
    if name == CROSS:
        return name
    if len(name) > _LONGEST_NAME:
        name = f"{name[: _LONGEST_NAME - 3]}..."
    return use if name in ("", response.use, use) else f"{use} '{name}'"


def _names(responses: Sequence[Response]) -> str:
    """The name of the first of several records, and the number of the others."""
    more = f" and {len(responses) - 1} more" if len(responses) > 1 else ""
    return f"{_name(responses[0])}{more}"
