"""Sizes of the static nonlinearity: a race of models, scored on records that are not fitted.

Fits of one size end in different minima, and only the good ones show what the size is worth. So
many models of random sizes and starts begin, and the best of them go on, in three rounds
(successive halving). The first round is long, as the error after a few iterations says little of
that after many if there is friction, or an integrator.

The fewest parameters that do as well as the best are chosen: ``lfrtorch.paired_blocks`` says what
that is. The models that left the race count, too: if more parameters bring nothing, the smallest
does as well after its first iterations.

A few hundred samples of validation do not tell sizes apart. There the models of the last round are
fitted again by cross-validation, each stretch of all records left out in turn.

References:
    Jamieson and Talwalkar, "Non-stochastic best arm identification and hyperparameter
    optimization", AISTATS 2016.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from itertools import product
from math import ceil, inf, isfinite, nan, sqrt
from threading import Event
from typing import Any, NamedTuple

import numpy as np
import torch

from lfrtorch._support import tables
from lfrtorch._support.arguments import typed
from lfrtorch._support.checks import integer
from lfrtorch._support.errors import InputError, brief
from lfrtorch._support.reasons import Reason
from lfrtorch._support.tables import number, quantity
from lfrtorch._support.threads import spread_by_hand
from lfrtorch._support.types import Array, Integers
from lfrtorch.distributed import ProcessLostError, Ranks
from lfrtorch.fitting.exclusions import refuse_together
from lfrtorch.fitting.folds import folds as folds_of
from lfrtorch.fitting.live_line import StartsLine
from lfrtorch.fitting.multistart import iterations_of
from lfrtorch.fitting.plain_settings import Noise
from lfrtorch.fitting.prediction import SIMULATION, predicting
from lfrtorch.fitting.refit import all_records
from lfrtorch.fitting.side_by_side import Together, any_of
from lfrtorch.fitting.trainer import Fit, Monitor, Stop, StoppedError, Trainer
from lfrtorch.least_squares.levenberg_marquardt import LevenbergMarquardt
from lfrtorch.least_squares.simulation_errors import Ridge
from lfrtorch.linear.model import LinearModel
from lfrtorch.model import Model
from lfrtorch.paired_blocks import (
    as_good,
    blocked_mean,
    in_blocks,
    squares_in_blocks,
    standard_errors_above,
)
from lfrtorch.records import Record, Scaler, as_records
from lfrtorch.score_window import with_window

Sizes = dict[str, Any]

_ROUNDS = ((8, 1 / 6), (4, 1 / 3), (1, 1.0))
"""Models that take part, over those of the last, and the part of the iterations they reach."""

LEGEND = """\
validation: rms error over that of the output. It compares sizes, and is smaller than on new data:
it chose the iterate, too, and by folds the linear model of the start has seen all samples.
above best: in standard errors of the difference.
chosen: the fewest net parameters with 1 at most and an error up to 5 % above the best, or with an
error up to 1 % above it; or fewer with a smaller error."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """A model that was tried: what it costs and what it buys.

    Args:
        sizes: nz, nw, and nn or degree; nx if it was searched, too.
        rounds, iterations: that it took part in; no iteration if it diverges at the start.
        parameters, parameters_net: all, and without the gauge directions.
        error, error_std: rms of the simulation error over the validation records, each output
            relative to its rms, and its standard error; infinite if the model diverges.
        ratio: of this error to the linear model's; NaN if there is none to compare with.
        squares: the sum of the squared errors in each block of time, (B,).
    """

    sizes: Sizes
    seed: int
    rounds: int
    iterations: int
    parameters: int
    parameters_net: int
    seconds: float
    error: float
    error_std: float
    ratio: float
    squares: Array = field(repr=False)

    def __str__(self) -> str:
        text = ", ".join(f"{name} {size}" for name, size in self.sizes.items())
        if not isfinite(self.error):
            return f"{text}: diverges"
        text += f": validation {number(self.error)} ± {number(self.error_std)}"
        return (
            text if np.isnan(self.ratio) else f"{text}, {number(self.ratio)} of the linear model's"
        )


@dataclass(frozen=True)
class SizeRound:
    """A round of the race that has ended.

    Args:
        number, count: its number, from 1, and the number of all rounds.
        models: that took part in it.
        iterations: that they have had.
        best: the one with the least error.
        seconds: since the beginning.
    """

    number: int
    count: int
    models: int
    iterations: int
    best: Candidate
    seconds: float

    def __str__(self) -> str:
        return (
            f"sizes, round {self.number} of {self.count}: {self.models} models to iteration "
            f"{self.iterations}, {quantity(self.seconds, 's')}; best: {self.best}"
        )


@dataclass(frozen=True, eq=False)
class SizeSearch:
    """Models of several sizes, the last round's first, each round by rising error.

    Args:
        candidates: each of them.
        counts: samples of each block of time, (B,).

    Example:
        >>> def start(sizes, seed):
        ...     return lfrtorch.initialise(bla, record, **sizes, seed=seed)
        >>> short = lfrtorch.LevenbergMarquardt(max_iter=2)
        >>> search = lfrtorch.search_sizes(
        ...     start, record, record, nz=1, nw=1, nn=(2, 4), seeds=(0,), trainer=short
        ... )
        >>> sorted(entry["nn"] for entry in search.entries())
        [2, 4]
    """

    candidates: tuple[Candidate, ...]
    counts: Integers = field(repr=False)

    @property
    def chosen(self) -> Candidate:
        """The one with the fewest net parameters whose error is near the best, see ``LEGEND``."""
        good = as_good([c.squares for c in self.candidates], self.counts)
        near = [c for c, enough in zip(self.candidates, good, strict=True) if enough]
        limit = min(near, key=lambda c: (c.parameters_net, c.error)).error
        below = [c for c in self.candidates if c.error <= limit]
        return min(below, key=lambda c: (c.parameters_net, c.error))

    @property
    def largest(self) -> tuple[str, ...]:
        """Names of the sizes chosen that are the largest of those tried."""
        found = []
        for name, size in self.chosen.sizes.items():
            tried = {candidate.sizes[name] for candidate in self.candidates}
            if len(tried) > 1 and size == max(tried):
                found.append(name)
        return tuple(found)

    @property
    def notes(self) -> tuple[str, ...]:
        """A note on each of those."""
        return tuple(
            f"{name} {self.chosen.sizes[name]} is the largest tried; a larger one may do better."
            for name in self.largest
        )

    def entries(self) -> list[dict[str, Any]]:
        """Numbers of each, by name."""
        chosen = self.chosen
        above = standard_errors_above([c.squares for c in self.candidates], self.counts)
        return [
            {
                **c.sizes,
                **{name: n for name, n in vars(c).items() if name not in ("sizes", "squares")},
                "standard_errors_above": float(far),
                "chosen": c is chosen,
            }
            for c, far in zip(self.candidates, above, strict=True)
        ]

    def table(self) -> str:
        """One line a model of the last round, by rising net parameters."""
        return f"{tables.table(*size_table(self.entries()))}\n{LEGEND}"


def size_table(entries: Sequence[Mapping[str, Any]]) -> tuple[list[str], list[list[Any]]]:
    """Return head and rows of a table of the chosen model and those of the last round."""
    sizes = [name for name in ("nx", "nz", "nw", "nn", "degree") if entries and name in entries[0]]
    numbers = ["iterations", "parameters", "parameters_net", "seconds"]
    numbers += ["error", "error_std", "ratio", "standard_errors_above"]
    last = max((e["rounds"] for e in entries), default=0)
    rows = []
    for e in sorted(entries, key=lambda e: e["parameters_net"]):
        if e["chosen"] or e["rounds"] == last:
            finite = e["error"] is not None and isfinite(e["error"])
            mark = "chosen" if e["chosen"] else "" if finite else "diverges"
            rows.append([*(e[name] for name in (*sizes, *numbers)), mark])
    head = ["iterations", "parameters", "net", "seconds", "validation", "±", "/ linear"]
    return [*sizes, *head, "above best", ""], rows


@typed()
@spread_by_hand()
def search_sizes(
    start: Callable[[Sizes, int], Model],
    train: Record | Sequence[Record],
    validation: Record | Sequence[Record],
    *,
    nx: int | Sequence[int] | None = None,
    nz: int | Sequence[int] = (1, 2, 3),
    nw: int | Sequence[int] = (1, 2, 3),
    nn: int | Sequence[int] = (5, 10, 15, 25),
    degree: int | Sequence[int] | None = None,
    linear: LinearModel | None = None,
    seeds: Sequence[int] = (0, 1000, 2000, 3000),
    finalists: int = 6,
    folds: int = 0,
    trainer: Trainer | None = None,
    ridge: Ridge = 0.0,
    noise: Noise = "output",
    horizon: int | None = None,
    monitor: Monitor | None = None,
    watch: Callable[[SizeRound], None] = lambda _: None,
    ranks: Ranks | None = None,
    stop: Stop | None = None,
) -> SizeSearch:
    """Models of several sizes, and the smallest that is good enough.

    Of all sizes and seeds, 8 times as many as there are finalists are drawn at random, every size
    once before one is drawn again. They are fitted for a sixth of the iterations. The better half
    goes on to a third, and the finalists to the end.

    Args:
        start: makes the model of given sizes to start from with a given seed, for example
            ``lambda sizes, seed: initialise(bla, train, **sizes, seed=seed)``.
        train: records that are fitted.
        validation: records that choose among iterates, starts and sizes.
        nx: states to try, if ``start`` takes them among the sizes.
        nz, nw, nn: sizes to try; one number is a size that is known.
        degree: of a polynomial, in the place of nn.
        linear: the model that errors are compared with.
        finalists: models that get all iterations.
        folds: if not 0, the finalists are fitted again, to all but one of so many stretches of the
            training and validation records in turn (:func:`lfrtorch.fitting.folds.folds`), and the
            errors in the stretches that were left out choose, those of finalists alone. These
            errors compare sizes and are too small to quote: each fit begins with the linear model
            and scales of all samples, and what was left out chooses its iterate.
        trainer: the search. Default: Levenberg-Marquardt with 75 iterations.
        ridge, noise, horizon, ranks, stop: see :func:`lfrtorch.fit`.
        monitor: called after every iteration of any model. Default: a line on a terminal or in a
            notebook, and nothing elsewhere.
        watch: called after each round.

    Raises:
        ValueError: nothing to try, no records for validation or too short ones, or no model that is
            stable on them.
        StoppedError: by Ctrl-C or ``stop``: there is no choice yet.
        ProcessLostError: likewise.

    Example:
        >>> def start(sizes, seed):
        ...     return lfrtorch.initialise(bla, record, **sizes, seed=seed)
        >>> short = lfrtorch.LevenbergMarquardt(max_iter=2)
        >>> search = lfrtorch.search_sizes(
        ...     start, record, record, nz=1, nw=1, nn=(2, 4), seeds=(0,), trainer=short
        ... )
        >>> search.chosen.sizes["nn"] in (2, 4)
        True
    """
    given = {} if nx is None else {"nx": nx}
    given |= {"nz": nz, "nw": nw} | ({"nn": nn} if degree is None else {"degree": degree})
    tried = {name: _sizes_to_try(name, values) for name, values in given.items()}
    integer("finalists", finalists, 1)
    integer("folds", folds, 0)
    if not len(seeds):
        raise InputError("seeds is empty; give one for each start, for example (0, 1000).")
    if not validation:
        raise InputError(
            "there are no validation records, on which sizes are chosen; give some, or set "
            f"{', '.join(tried)} to numbers."
        )
    if noise != "output":
        begin, linear = start, None if linear is None else linear.predictor()
        start = lambda sizes, seed: begin(sizes, seed).predictor()  # noqa: E731
        _, train, validation = predicting([], train, validation)
    given_records = all_records(as_records(train), as_records(validation)) if folds else []
    ranks = Ranks() if ranks is None else ranks
    trainer = LevenbergMarquardt(max_iter=75) if trainer is None else trainer
    refuse_together(noise=noise, horizon=horizon, guarantee=trainer.guarantee)
    validation = [*map(with_window, as_records(validation))]
    scale = Scaler.of(validation).y_scale
    judge, clock = _Judge(validation, linear, ranks, scale), time.perf_counter()
    drawn = _drawn(tried, seeds, _ROUNDS[0][0] * finalists)
    planned = race(len(drawn), finalists, trainer.limit)
    halt = Event()
    options: dict[str, Any] = {
        "trainer": trainer,
        "ridge": ridge,
        "ranks": ranks,
        "simulation": SIMULATION.get(noise, 0.0),
        "horizon": horizon,
        "stop": any_of(halt, stop) if ranks.world == 1 else stop,
    }
    field = [
        _Runner(sizes, seed, Fit(_begun(start, sizes, seed), train, validation, **options))
        for sizes, seed in drawn
    ]
    left: list[Candidate] = []
    with ExitStack() as ending:
        if monitor is None and ranks.rank == 0:
            unit, steps = field[0].fit.model.outputs[0].unit, iterations_of(planned)
            monitor = StartsLine(len(field), unit, iterations=steps)
            ending.callback(monitor.close)
        watching = [] if monitor is None else [monitor]
        together = Together([r.fit for r in field], [watching] * len(field), halt)
        for number, (count, until) in enumerate(planned, start=1):
            field = sorted(field, key=lambda runner: runner.fit.best)
            left = [judge.candidate(runner, number - 1) for runner in field[count:]] + left
            field = field[:count]
            together.advance([runner.fit for runner in field], until)
            _check_whole([runner.fit for runner in field])
            best = judge.candidate(min(field, key=lambda runner: runner.fit.best), number)
            seconds = time.perf_counter() - clock
            watch(SizeRound(number, len(planned), len(field), until, best, seconds))
        counts = judge.counts
        last = [judge.candidate(each, len(planned)) for each in field]
        if folds:
            parts = [
                part._replace(left_out=[*map(with_window, part.left_out)])
                for part in folds_of(given_records, folds)
            ]
            judges = [_Judge(part.left_out, linear, ranks, scale) for part in parts]
            fits = [
                [
                    Fit(_begun(start, r.sizes, r.seed), part.train, part.left_out, **options)
                    for part in parts
                ]
                for r in field
            ]
            each = [fit for own in fits for fit in own]
            Together(each, [watching] * len(each), halt).advance(each, trainer.limit)
            _check_whole(each)
            counts = np.concatenate([judge.counts for judge in judges])
            left = []
            last = [_crossed(c, own, judges) for c, own in zip(last, fits, strict=True)]
    search = SizeSearch((*sorted(last, key=lambda c: c.error), *left), counts)
    if not isfinite(search.chosen.error):
        raise InputError(
            "all models that were tried diverge on the validation records; give training data at "
            "amplitudes like theirs, or set the sizes."
        )
    return search


def _crossed(candidate: Candidate, fits: Sequence[Fit], judges: Sequence[_Judge]) -> Candidate:
    """A model of the last round with the errors of its fits in what was left out of each."""
    results = [fit.result() for fit in fits]
    pairs = zip(judges, results, strict=True)
    squares = np.concatenate([judge.squares(result.model) for judge, result in pairs])
    linear = np.concatenate([judge.linear for judge in judges])
    counts = np.concatenate([judge.counts for judge in judges])
    error, error_std = _relative(squares, counts)
    return replace(
        candidate,
        iterations=candidate.iterations + sum(result.iterations for result in results),
        seconds=candidate.seconds + sum(result.seconds for result in results),
        error=error, error_std=error_std, ratio=_ratio(error, linear, counts),
        squares=squares,
    )  # fmt: skip


def race(models: int, finalists: int, limit: int) -> list[tuple[int, int]]:
    """Plan how many models take part in each round, and the iteration at which it ends."""
    planned: list[tuple[int, int]] = []
    for part, to in _ROUNDS:
        count, until = min(models, part * finalists), ceil(to * limit)
        if planned and until == planned[-1][1]:
            continue
        if planned and count == planned[-1][0]:
            planned.pop()
        planned.append((count, until))
    return planned


def _drawn(
    tried: Mapping[str, Sequence[int]], seeds: Sequence[int], count: int
) -> list[tuple[Sizes, int]]:
    """Sizes and seeds in a random order: all sizes with the first seed, then with the second."""
    every = [dict(zip(tried, each, strict=True)) for each in product(*tried.values())]
    rng = np.random.default_rng(seeds[0])
    return [(every[i], seed) for seed in seeds for i in rng.permutation(len(every))][:count]


def _check_whole(fits: Sequence[Fit]) -> None:
    """Refuse to go on with fits that were interrupted, or lost a process."""
    for fit in fits:
        if fit.reason == Reason.INTERRUPTED:
            raise StoppedError("stopped while sizes were searched")
        if fit.reason == Reason.PROCESS_LOST:
            raise ProcessLostError(fit.detail)


class _Runner(NamedTuple):
    """A model that takes part in the race."""

    sizes: Sizes
    seed: int
    fit: Fit


class _Judge:
    """Scores models on records that are not fitted; the scores of the first process count."""

    def __init__(
        self, records: list[Record], linear: LinearModel | None, ranks: Ranks, scale: Array
    ) -> None:
        self._records, self._ranks, self._scale = records, ranks, scale
        blocks = in_blocks([record.y[record.skip :, 0] for record in records])
        self.counts = np.array([len(block) for block in blocks])
        self.linear = np.full(len(blocks), nan) if linear is None else self.squares(linear)

    def squares(self, model: Model | LinearModel) -> Array:
        """Sums of the squared relative errors over each block, (B,), the mean of the outputs."""
        with np.errstate(over="ignore", invalid="ignore"):
            errors = [r.errors(model.simulate(r)) / self._scale for r in self._records]
        return self._ranks.first(torch.from_numpy(squares_in_blocks(errors))).numpy()

    def candidate(self, runner: _Runner, rounds: int) -> Candidate:
        """What is known of a model that took part in some rounds."""
        found = runner.fit.result()
        squares = self.squares(found.model)
        error, error_std = _relative(squares, self.counts)
        ratio = _ratio(error, self.linear, self.counts)
        return Candidate(
            runner.sizes, runner.seed, rounds, found.iterations, found.model.parameter_count,
            found.model.net_parameter_count, found.seconds, error, error_std, ratio, squares,
        )  # fmt: skip


def _relative(squares: Array, counts: Integers) -> tuple[float, float]:
    """Return the root of the mean square and its standard error."""
    if not np.isfinite(squares).all():
        return inf, inf
    mean, error = blocked_mean(squares, counts)
    rms = sqrt(mean)
    return rms, float(error) / (2.0 * rms) if rms else 0.0


def _ratio(error: float, linear: Array, counts: Integers) -> float:
    """Return an error over the linear model's; NaN if there is none, or if it is 0."""
    least = 0.0 if np.isnan(linear).any() else _relative(linear, counts)[0]
    return error / least if least else nan


def _begun(start: Callable[[Sizes, int], Model], sizes: Sizes, seed: int) -> Model:
    """A model of some sizes to start from."""
    model = start(sizes, seed)
    if not isinstance(model, Model):
        raise InputError(f"start({sizes}, {seed}) returned {brief(repr(model))}; return a Model.")
    return model


def _sizes_to_try(name: str, given: int | Sequence[int]) -> list[int]:
    """Return the numbers of one size, rising."""
    values = [given] if isinstance(given, int | str) else sorted(set(given))
    if not values:
        raise InputError(f"{name} is empty; give the numbers to try, for example [1, 2].")
    for value in values:
        integer(name, value, 1)
    return values
