"""Sizes of the static nonlinearity: a small search, scored on records that are not fitted.

If nx is searched, too, it is first: from the linear model's order up, at the most inputs and the
fewest outputs of the static map and the middle number of neurons, until two orders in a row bring
less than 1 %. Then nz and nw are crossed at the middle number of neurons; then all numbers of
neurons are tried at the nz and nw chosen. Every model is fitted from several starts for a part of
the usual iterations.

The fewest parameters that do as well as the best are chosen: ``lfrtorch.paired_blocks`` says what
that is. What chance does to starts, and what more iterations would do, is not in it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from math import inf, isfinite, nan, sqrt
from typing import Any

import numpy as np
import torch

from lfrtorch._support import tables
from lfrtorch._support.checks import integer, renamed
from lfrtorch._support.errors import InputError
from lfrtorch._support.reasons import Reason
from lfrtorch._support.tables import number
from lfrtorch._support.types import Array, Integers
from lfrtorch.distributed import ProcessLostError, Ranks
from lfrtorch.fitting.multistart import fit
from lfrtorch.fitting.trainer import StartDivergesError, Stop, StoppedError, Trainer
from lfrtorch.least_squares.levenberg_marquardt import LevenbergMarquardt
from lfrtorch.least_squares.simulation_problem import Ridge
from lfrtorch.linear.model import LinearModel
from lfrtorch.linear.score_window import is_open, settled
from lfrtorch.model import Model
from lfrtorch.paired_blocks import (
    as_good,
    blocked_mean,
    in_blocks,
    no_progress,
    squares_in_blocks,
    standard_errors_above,
)
from lfrtorch.records import Record, Scaler, as_records

Sizes = dict[str, Any]

NZ, NW, NN = (1, 2), (1, 2), (5, 10, 15, 25)
"""What is tried."""

SEEDS = (0, 1000, 2000, 3000)
"""Seeds of the starts of each model."""

PATIENCE = 2
"""Orders in a row that bring less than 1 % end the search for nx."""

ITERATIONS = 50
"""Iterations of each start: a quarter of those of a fit."""

LEGEND = """\
validation: rms error over that of the output. above best: in standard errors of the difference.
chosen: the fewest net parameters with 1 at most, or an error up to 1 % above the best."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """A model that was tried: what it costs and what it buys.

    Args:
        sizes: nz, nw, and nn or degree; nx if it was searched, too.
        parameters, parameters_net: all, and without the gauge directions.
        seconds: the search took for it.
        error, error_std: rms of the simulation error over the validation records, each output
            relative to its rms, and its standard error; infinite if the model diverges.
        ratio: of this error to the linear model's; NaN if there is none to compare with.
        squares: the sum of the squared errors in each block of time, (B,).
    """

    sizes: Sizes
    parameters: int
    parameters_net: int
    seconds: float
    error: float
    error_std: float
    ratio: float
    squares: Array = field(repr=False)

    def __str__(self) -> str:
        sizes = ", ".join(f"{name} {size}" for name, size in self.sizes.items())
        text = f"{sizes}: {self.parameters} parameters ({self.parameters_net} net), "
        if not isfinite(self.error):
            return text + f"diverges, {number(self.seconds)} s"
        text += f"validation {number(self.error)} ± {number(self.error_std)}"
        text += "" if np.isnan(self.ratio) else f", {number(self.ratio)} of the linear model's"
        return f"{text}, {number(self.seconds)} s"


@dataclass(frozen=True, eq=False)
class SizeSearch:
    """Models of several sizes, in the order they were tried.

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
    def above(self) -> Array:
        """How far each is above the best, in standard errors of the difference, (candidates,)."""
        return standard_errors_above([c.squares for c in self.candidates], self.counts)

    @property
    def chosen(self) -> Candidate:
        """The one with the fewest net parameters within one standard error, or 1 %, of the best."""
        good = as_good([c.squares for c in self.candidates], self.counts)
        near = [c for c, enough in zip(self.candidates, good, strict=True) if enough]
        return min(near, key=lambda c: (c.parameters_net, c.error))

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
        return [
            {
                **c.sizes,
                "parameters": c.parameters,
                "parameters_net": c.parameters_net,
                "seconds": c.seconds,
                "error": c.error,
                "error_std": c.error_std,
                "ratio": c.ratio,
                "standard_errors_above": float(above),
                "chosen": c is self.chosen,
            }
            for c, above in zip(self.candidates, self.above, strict=True)
        ]

    def table(self) -> str:
        """One line a model, by rising net parameters."""
        return f"{tables.table(*size_table(self.entries()))}\n{LEGEND}"


def size_table(entries: Sequence[Mapping[str, Any]]) -> tuple[list[str], list[list[Any]]]:
    """Head and rows of a table of the models tried, by rising number of net parameters."""
    sizes = [name for name in ("nx", "nz", "nw", "nn", "degree") if entries and name in entries[0]]
    numbers = ["parameters", "parameters_net", "seconds", "error", "error_std", "ratio"]
    numbers.append("standard_errors_above")
    rows = [
        [e[name] for name in (*sizes, *numbers)]
        + ["chosen" if e["chosen"] else "" if _known(e["error"]) else "diverges"]
        for e in sorted(entries, key=lambda e: e["parameters_net"])
    ]
    head = ["parameters", "net", "seconds", "validation", "±", "/ linear", "above best", ""]
    return [*sizes, *head], rows


def _known(error: float | None) -> bool:
    return error is not None and isfinite(error)


@renamed(optimiser="trainer")
def search_sizes(
    start: Callable[[Sizes, int], Model],
    train: Record | Sequence[Record],
    validation: Record | Sequence[Record],
    *,
    nx: int | Sequence[int] | None = None,
    nz: int | Sequence[int] = NZ,
    nw: int | Sequence[int] = NW,
    nn: int | Sequence[int] = NN,
    degree: int | Sequence[int] | None = None,
    linear: LinearModel | None = None,
    seeds: Sequence[int] = SEEDS,
    trainer: Trainer | None = None,
    ridge: Ridge = 0.0,
    watch: Callable[[Candidate], None] = lambda _: None,
    ranks: Ranks | None = None,
    stop: Stop | None = None,
) -> SizeSearch:
    """Models of several sizes, and the smallest that is good enough.

    Args:
        start: makes the model of given sizes to start from with a given seed, for example
            ``lambda sizes, seed: initialise(bla, train, **sizes, seed=seed)``.
        train: records that are fitted.
        validation: records that choose among iterates, starts and sizes.
        nx: states to try, if ``start`` takes them among the sizes.
        nz, nw, nn: sizes to try; one number is a size that is known.
        degree: of a polynomial, in the place of nn.
        linear: the model that errors are compared with.
        seeds: of the starts.
        trainer: the search. Default: Levenberg-Marquardt with 50 iterations.
        ridge, ranks, stop: see :func:`lfrtorch.fit`.
        watch: called after each model.

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
    tried = {name: _sizes(name, values) for name, values in given.items()}
    if not seeds:
        raise InputError("seeds is empty; give one for each start, for example (0, 1000).")
    if not validation:
        raise InputError(
            "there are no validation records, on which sizes are chosen; give some, or set "
            f"{', '.join(tried)} to numbers."
        )
    ranks = Ranks() if ranks is None else ranks
    if any(map(is_open, as_records(validation))):  # the same samples for all sizes
        first = {name: values[0] for name, values in tried.items()}
        model = start(first, seeds[0]) if linear is None else linear.to_model()
        validation, _ = settled(model, as_records(validation), as_records(train))
    judge = _Judge(as_records(validation), linear, ranks)
    trainer = LevenbergMarquardt(max_iter=ITERATIONS) if trainer is None else trainer
    found: list[Candidate] = []

    def searched(*values: Sequence[int]) -> SizeSearch:
        for each in product(*values):
            sizes = dict(zip(tried, each, strict=True))
            if any(candidate.sizes == sizes for candidate in found):
                continue
            clock = time.perf_counter()
            models = [start(sizes, seed) for seed in seeds]
            try:
                result = fit(
                    models,
                    train,
                    validation,
                    trainer=trainer,
                    ridge=ridge,
                    monitors=(),
                    ranks=ranks,
                    stop=stop,
                )
            except StartDivergesError:
                squares = np.full(len(judge.counts), inf)
            else:
                if result.reason == Reason.INTERRUPTED:
                    raise StoppedError("stopped while sizes were searched")
                if result.reason == Reason.PROCESS_LOST:
                    raise ProcessLostError(result.detail)
                squares = judge.squares(result.model)
            seconds = time.perf_counter() - clock
            found.append(judge.candidate(sizes, models[0], seconds, squares))
            watch(found[-1])
        return SizeSearch(tuple(found), judge.counts)

    *outer, last = tried.values()
    middle = [last[len(last) // 2]]
    if nx is not None:
        ladder, nzs, nws = outer
        for order in ladder:
            searched([order], nzs[-1:], nws[:1], middle)
            if no_progress([c.error for c in found], PATIENCE):
                break
        best = SizeSearch(tuple(found), judge.counts).chosen
        outer = [[best.sizes["nx"]], nzs, nws]
    chosen = searched(*outer, middle).chosen.sizes
    search = searched(*([chosen[name]] for name in [*tried][:-1]), last)
    if not isfinite(search.chosen.error):
        raise InputError(
            "all models that were tried diverge on the validation records; give training data at "
            "amplitudes like theirs, or set the sizes."
        )
    return search


class _Judge:
    """Scores models on the validation records; those of the first process count."""

    def __init__(self, records: list[Record], linear: LinearModel | None, ranks: Ranks) -> None:
        self._records, self._ranks = records, ranks
        self._scale = Scaler.of(records).y_scale
        blocks = in_blocks([record.y[record.skip :, 0] for record in records])
        self.counts = np.array([len(block) for block in blocks])
        self._linear = nan if linear is None else self._error(self.squares(linear))[0]

    def squares(self, model: Model | LinearModel) -> Array:
        """Sums of the squared relative errors over each block, (B,), the mean of the outputs."""
        with np.errstate(over="ignore", invalid="ignore"):
            errors = [(r.y - model.simulate(r))[r.skip :] / self._scale for r in self._records]
        return self._ranks.first(torch.from_numpy(squares_in_blocks(errors))).numpy()

    def candidate(self, sizes: Sizes, model: Model, seconds: float, squares: Array) -> Candidate:
        """What is known of a model with these errors."""
        error, error_std = self._error(squares)
        return Candidate(
            sizes, model.parameter_count, model.net_parameter_count, seconds, error, error_std,
            error / self._linear if self._linear else nan, squares,
        )  # fmt: skip

    def _error(self, squares: Array) -> tuple[float, float]:
        """Root of the mean square and its standard error."""
        if not np.isfinite(squares).all():
            return inf, inf
        mean, error = blocked_mean(squares, self.counts)
        rms = sqrt(mean)
        return rms, float(error) / (2.0 * rms) if rms else 0.0


def _sizes(name: str, given: int | Sequence[int]) -> list[int]:
    values = [given] if isinstance(given, int | str) else sorted(set(given))
    if not values:
        raise InputError(f"{name} is empty; give the numbers to try, for example [1, 2].")
    for value in values:
        integer(name, value, 1)
    return values
