"""The choice of sizes and ridge by cross-validation, and its error on data that it has not seen.

Four stretches of the estimation records are left out in turn (``lfrtorch.fitting.folds``). Linear
and nonlinear models are fitted to the rest, simulated through what was left out, and begun in it
from an estimated state, as on new data. Both errors count alike:

1. The best linear approximations of several orders, each refined without the stretch. A pole slower
   than the longest record counts against an order.
2. Nonlinear models from small to large: the first few sizes always, and larger ones as long as one
   of them lowers the error. Each is fitted from eight starts along falling ridges, each ridge from
   where the last one ended, all towards the same start. Four of them begin at the linear model and
   four at random states (``lfrtorch.fitting.random_states``). After each of the first two ridges
   the better half goes on. The mean of the starts simulates what was left out. A start that does
   not forget where it began (``lfrtorch.fitting.forgetting``) takes no part.
3. A size takes the largest ridge that does as well as its best one, and the choice takes the
   fewest parameters that do about as well as the best (``lfrtorch.data.paired_blocks``).

The error of a choice is the least of many, and so too small to judge it by. So the choice is made
again from blocks of the stretches that are drawn with replacement, and judged on the blocks that
were not drawn (bootstrap of cross-validation). ``Choice.left_out`` has, in each block, the outputs
of a choice whose error there is nearest to the root mean square of all choices without the block.

References:
    Stone, "Cross-validatory choice and assessment of statistical predictions", Journal of the Royal
    Statistical Society B 36(2), 1974.
    Tsamardinos, Greasidou and Borboudakis, "Bootstrapping the out-of-sample predictions for
    efficient and accurate cross-validation", Machine Learning 107, 2018.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product
from math import isfinite, nan, sqrt
from operator import mul
from threading import Event
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch

from lfrtorch._support import tables
from lfrtorch._support.arguments import typed
from lfrtorch._support.checks import integer
from lfrtorch._support.errors import InputError, LfrtorchError, brief
from lfrtorch._support.tables import percent, quantity, radius
from lfrtorch._support.threads import each_alone, worth_threads
from lfrtorch._support.types import Array, Integers
from lfrtorch.analysis.amplitude_margin import LOUDER, largest_stable_amplitude
from lfrtorch.data.paired_blocks import Judge
from lfrtorch.data.records import Record, Scaler, as_records
from lfrtorch.distributed import agreed
from lfrtorch.fitting.folds import Fold, as_folded, folds
from lfrtorch.fitting.forgetting import forgets
from lfrtorch.fitting.side_by_side import any_of
from lfrtorch.fitting.trainer import Stop, StoppedError
from lfrtorch.fitting.windows import begins_at_outputs, in_windows, windows
from lfrtorch.least_squares.guarantee import Name, guarantee_of
from lfrtorch.least_squares.levenberg_marquardt import LevenbergMarquardt
from lfrtorch.least_squares.problem import Problem
from lfrtorch.least_squares.ridge import Ridge
from lfrtorch.least_squares.search import Search
from lfrtorch.least_squares.simulation_errors import SimulationErrors
from lfrtorch.least_squares.term import Seen
from lfrtorch.linear.bla import refined_near
from lfrtorch.linear.measured_states import measured_states_model
from lfrtorch.linear.model import LinearModel
from lfrtorch.model.model import Model

Sizes = dict[str, int]

FOLDS = 4
"""Number of stretches that are left out in turn: each fit has three quarters of the data."""

_DRAWS = 12  # random start states that a candidate must forget

_CHOICES = 30  # choices without a block, at least

_BLOCKS = 4  # blocks of each stretch: two models are compared by 16 differences of squared errors

_RIDGES = ((10.0, 12), (1.0, 12), (0.1, 10), (1e-2, 10), (1e-3, 10), (1e-4, 10), (1e-6, 10))
"""Ridges and the iterations of each."""

_STARTS = 8  # four of the linear model's states, and four of random ones

_HALVED = 2
"""Number of ridges after each of which the starts of a stretch that fit worse are dropped: half of
each kind, and half of the others."""

_NEAR = 1.2
"""Largest ratio of a start's rms training error to the least one, for starts in a mean."""

_SMALL = ({"nz": 1, "nw": 1, "nn": 4, "degree": 3}, {"nz": 2, "nw": 2, "nn": 8, "degree": 3})
"""Sizes that are always tried."""

_FLOOR = 1e-6  # error, over the outputs' standard deviation, below which models count as equal

_DENSEST = 0.5  # largest number of net parameters for each scored output

_WORSE = 1.3  # error over the best so far; two worse ridges in a row end the search

_SLOW = 1.2
"""Ratio of rms errors by which a linear model has to be better if one of its poles, also without a
stretch, is slower than the longest record. Such a pole follows what passes in this record. In a
longer one it drifts."""

_REST = 0.05  # part of the budget with which no size is begun: its work is far more

_GAIN = 0.98  # larger sizes are tried as long as the least error falls by more than to this part


@dataclass(frozen=True, eq=False)
class Candidate:
    """Sizes and a ridge that were tried.

    Args:
        sizes: nx, nz, nw, and nn or degree.
        ridge: weight of the squared distance to the start, or weights by group.
        parameters_net: number of parameters, without the gauge directions.
        ratio: rms error in what was left out over that of the linear model.
        squares: sums of the squared relative errors in the blocks of each stretch, (folds, B).
        outputs: simulations of each stretch (samples, ny), physical units.
        remembers: True if the fits without some stretch do not forget their start state; the
            candidate is then refused.
    """

    sizes: Sizes
    ridge: Ridge
    parameters_net: int
    ratio: float
    squares: Array = field(repr=False)
    outputs: Sequence[Array] = field(repr=False)
    remembers: bool = False


@dataclass(frozen=True, eq=False)
class Choice:
    """Sizes and ridges by cross-validation.

    Args:
        candidates: all candidates that were tried.
        chosen: the candidate with the fewest net parameters among those as good as the best.
        nx: the best order of a linear model.
        counts: samples of each block, (folds, B).
        left_out: each record, with its outputs where they were left out, of the linear model and
            of the NL-LFR that was chosen without them, (T, ny), physical units.
        seconds: duration of the choice.

    Example:
        >>> def start(bla, train, sizes, seed):
        ...     return lfrtorch.initialise(bla, train, seed=seed, **sizes)
        >>> given = {"nx": 1, "nz": 1, "nw": 1, "nn": 2}
        >>> choice = lfrtorch.choose_sizes(record, [1], lambda nx: bla, start, given=given)
        >>> choice.chosen in choice.candidates
        True
    """

    candidates: tuple[Candidate, ...]
    chosen: Candidate
    nx: int
    counts: Integers = field(repr=False)
    left_out: Sequence[tuple[Record, Array, Array]] = field(repr=False)
    seconds: float

    def entries(self) -> list[dict[str, Any]]:
        """Numbers of each candidate, by name."""
        squares = np.array([c.squares.ravel() for c in self.candidates])
        above = Judge(squares, self.counts.ravel()).above()
        return [
            {
                **c.sizes,
                "ridge": c.ridge,
                "parameters_net": c.parameters_net,
                "ratio": c.ratio,
                "standard_errors_above": float(far),
                "chosen": c is self.chosen,
            }
            for c, far in zip(self.candidates, above, strict=True)
        ]

    def table(self) -> str:
        """One line for each size, with the best of its ridges."""
        return f"{tables.table(*choice_table(self.entries()))}\n{LEGEND}"


LEGEND = """\
/ linear: rms error where it was left out over the linear model's. It compares sizes: the least of
many is smaller than on new data.
above best: in standard errors of the difference.
chosen: the fewest net parameters with 1 at most and an error up to 5 % above the best."""


def choice_table(entries: Sequence[Mapping[str, Any]]) -> tuple[list[str], list[list[Any]]]:
    """Return head and rows of a table of all sizes, each with its best ridge, and the chosen."""
    names = [name for name in ("nx", "nz", "nw", "nn", "degree") if entries and name in entries[0]]

    def rank(entry: Mapping[str, Any]) -> tuple[bool, float]:
        return not entry["chosen"], np.inf if entry["ratio"] is None else entry["ratio"]

    best: dict[tuple[int, ...], Mapping[str, Any]] = {}
    for entry in sorted(entries, key=rank):
        best.setdefault(tuple(entry[name] for name in names), entry)
    columns = (*names, "ridge", "parameters_net", "ratio", "standard_errors_above")
    rows = [
        [*(_cell(entry[name]) for name in columns), "chosen" if entry["chosen"] else ""]
        for entry in sorted(best.values(), key=lambda entry: entry["parameters_net"])
    ]
    return [*names, "ridge", "net", "/ linear", "above best", ""], rows


def _cell(value: Any) -> Any:
    return str(value) if isinstance(value, Mapping) else value  # ridges by group


Made = TypeVar("Made", LinearModel, Model)

Start = Callable[[LinearModel, Sequence[Record], Sizes, int], Model]
"""Makes the model of given sizes that a fit to records starts from, with a seed."""


@typed()
def choose_sizes(
    records: Record | Sequence[Record],
    orders: Sequence[int],
    linear: Callable[[int], LinearModel],
    start: Start,
    *,
    given: Mapping[str, int] | None = None,
    ridge: Ridge = 0.0,
    last: str = "nn",
    seed: int = 0,
    guarantee: Name | None = None,
    horizon: int | None = None,
    watch: Callable[[str], None] = lambda _: None,
    stop: Stop | None = None,
) -> Choice:
    """Choose sizes and ridge of an NL-LFR by cross-validation.

    Args:
        records: all that a model may be estimated from.
        orders: orders of the linear models, 1, 2, ...; the NL-LFR may have more, unless ``given``
            has nx.
        linear: the best linear approximation of an order, which is refined without each stretch.
        start: makes a model, for example ``lambda bla, train, sizes, seed: initialise(bla, train,
            seed=seed, **sizes)``, with sizes nz, nw and ``last``.
        given: sizes that are known.
        ridge: ridge of all fits. Default: it is chosen, too.
        last: name of the last size, nn or degree; nw if the map has no other.
        seed: seed of the first start; the others have seed + 1000, ...
        guarantee: guarantee of the trainer.
        horizon: samples ahead that records with a measured start are fitted and judged by. Default:
            they are simulated from the first output on.
        watch: called with a line after each size.
        stop: asked before each iteration.

    Raises:
        ValueError: records too short to be cut, or no model that is stable on them.
        LfrtorchError: ``linear`` or ``start`` returned no model.
        StoppedError: by Ctrl-C or ``stop`` before the first sizes were tried; later the best of
            those that were tried are chosen.

    Example:
        >>> def start(bla, train, sizes, seed):
        ...     return lfrtorch.initialise(bla, train, seed=seed, **sizes)
        >>> given = {"nx": 1, "nz": 1, "nw": 1, "nn": 2}
        >>> choice = lfrtorch.choose_sizes(record, [1], lambda nx: bla, start, given=given)
        >>> choice.chosen.sizes
        {'nx': 1, 'nz': 1, 'nw': 1, 'nn': 2}
    """
    clock = time.perf_counter()
    integer("seed", seed, 0)
    if last not in _SMALL[0]:
        raise InputError(f"last is '{last}'; give one of {', '.join(_SMALL[0])}.")
    halt = Event()
    path = [(ridge, sum(count for _, count in _RIDGES))] if ridge != 0.0 else _RIDGES
    folded = as_folded(as_records(records))
    study = _Study(folded, linear, path, guarantee, horizon, any_of(halt, stop), halt.set)
    given = {} if given is None else dict(given)
    base, tried = study.best_linear(orders), list[Candidate]()
    begun = set[tuple[int, ...]]()
    budget = left = _budget(study.rows)

    def attempt(sizes: Sizes) -> None:
        nonlocal left
        key = tuple(sizes.values())
        spent = len(begun) >= len(_SMALL) and left <= _REST * budget
        if key in begun or spent or not study.has_order(sizes["nx"]):
            return
        begun.add(key)
        since = time.perf_counter()
        found = study.candidates(sizes, start, seed, base.total)
        left -= study.work(found[0].parameters_net if found else 0) * len(found) / len(path)
        tried.extend(found)
        text = ", ".join(f"{name} {size}" for name, size in sizes.items())
        text += f": {_error_of(found)}, {quantity(time.perf_counter() - since, 's')}"
        watch(f"sizes: {text}, {percent(min(1.0, 1.0 - left / budget))} of the search's work")

    def leader() -> Candidate | None:
        finite = [c for c in tried if isfinite(c.ratio)]
        ratios = agreed(torch.tensor([c.ratio for c in finite], dtype=torch.float64))
        return finite[int(ratios.argmin())] if finite else None

    names = ("nz", "nw", last)
    try:
        for nx, small in product([given["nx"]] if "nx" in given else _first(base.nx), _SMALL):
            attempt({"nx": nx, **{name: given.get(name, small[name]) for name in names}})
        before = 1.0
        while (best := leader()) and best.ratio < _GAIN * before and left > 0.0:
            before = best.ratio
            for change in _larger(best.sizes, given, last):
                attempt(change)
    except StoppedError:
        if not tried:
            raise
        watch("note: stopped while sizes were chosen: the best so far go on")
    if not tried:
        raise InputError(
            "no NL-LFR of the sizes that were tried can be begun on these records; give longer "
            "records, or set the sizes."
        )
    if leader() is None:
        watch(
            "note: all sizes run away where they are left out, and the smallest is fitted. A "
            f"linear model's slowest pole has radius {radius(study.slowest)}:\na system that "
            "integrates, or is unstable in a loop, does so (integrators=1, or noise=innovation), "
            "or one that is louder there"
        )
    if refused := sum(c.remembers for c in tried):
        watch(
            f"note: {refused} of {len(tried)} candidates are left out: what they simulate depends "
            "for ever on where it began, and the records show no such thing"
        )
    counts, base = study.counts, study.best_linear()
    tried = [replace(c, ratio=sqrt(c.squares.sum() / base.total)) for c in tried]
    squares = agreed(torch.tensor(np.array([c.squares.ravel() for c in tried]))).numpy()
    chosen = _chosen(tried, squares, counts.ravel())
    both = [base.outputs, _unseen(tried, squares, counts.ravel())]
    seconds = time.perf_counter() - clock
    left_out = study.whole(both)
    return Choice(tuple(tried), chosen, base.nx, counts, left_out, seconds)


def _error_of(found: Sequence[Candidate]) -> str:
    """Say the least error of sizes where they are left out, or why they have none."""
    if isfinite(best := min((c.ratio for c in found), default=nan)):
        return f"{percent(best)} of the linear model's error"
    if not found:
        return "too many parameters for these records"
    return "does not forget where it began" if any(c.remembers for c in found) else "diverges"


def _budget(rows: int) -> float:
    """Return seconds of one core that a search may take, about; a rule, no measured time."""
    return min(180.0, 20.0 * (max(rows, 500) / 500) ** 0.75)


def _first(order: int) -> list[int]:
    """Return the orders tried first: the linear model's, one more, and much lower ones."""
    # A linear model takes more states than the system has where the system is nonlinear.
    return [order, order + 1, *(low for low in (2, 4) if order > low + 1)]


def _larger(sizes: Sizes, given: Mapping[str, int], last: str) -> Iterator[Sizes]:
    """Yield the next larger sizes: one more state, a wider map, more neurons."""
    factor, most = (2, 60) if last == "nn" else (1, 5)
    more = min(most, factor * sizes[last] + (factor == 1))
    wide = {"nz": min(4, sizes["nz"] + 1), "nw": min(4, sizes["nw"] + 1), last: more}
    for change in ({"nx": sizes["nx"] + 1}, wide, {last: more}):
        yield {**sizes, **{name: size for name, size in change.items() if name not in given}}


def _chosen(tried: Sequence[Candidate], squares: Array, counts: Integers) -> Candidate:
    """Return the fewest parameters that do as well as the best in some blocks, (C, blocks)."""
    sizes: dict[tuple[int, ...], list[int]] = {}
    for i, candidate in enumerate(tried):
        sizes.setdefault(tuple(candidate.sizes.values()), []).append(i)
    # Of a size the largest ridge was tried first. Where all diverge, all are as good.
    best = [own[Judge(squares[own], counts).first_good()] for own in sizes.values()]
    good = Judge(squares[best], counts).as_good()
    near = [tried[i] for i, enough in zip(best, good, strict=True) if enough]
    return min(near, key=lambda c: c.parameters_net)


def _unseen(tried: Sequence[Candidate], squares: Array, counts: Integers) -> list[Array]:
    """Return outputs of each stretch, in each block those of a typical choice without the block."""
    without = [list[Candidate]() for _ in counts]
    generator = np.random.default_rng(0)
    while any(len(found) < _CHOICES for found in without):
        drawn = generator.integers(len(counts), size=len(counts))
        choice = _chosen(tried, squares[:, drawn], counts[drawn])
        for block in {*range(len(counts))} - {*drawn.tolist()}:
            without[block].append(choice)
    outputs = []
    for block, found in enumerate(without):
        errors = np.sqrt([c.squares.flat[block] for c in found])
        with np.errstate(invalid="ignore"):  # where all run away
            far = np.abs(errors - np.sqrt(np.mean(errors**2)))
        typical = found[int(np.argmin(far))]
        fold, part = divmod(block, _BLOCKS)
        outputs.append(np.array_split(typical.outputs[fold], _BLOCKS)[part])
    return [np.concatenate(outputs[k * _BLOCKS : (k + 1) * _BLOCKS]) for k in range(FOLDS)]


class _Linear(NamedTuple):
    """Linear models of an order, one without each stretch, and what they make of it."""

    nx: int
    models: list[LinearModel]
    outputs: list[Array]
    squares: Array
    slow: bool  # a pole is slower than the longest record

    @property
    def total(self) -> float:
        """Sum of the squares; the floor of each keeps it above 0."""
        return float(self.squares.sum())


class _Step(NamedTuple):
    """A fit without a stretch at one ridge."""

    cost: float  # in training; infinite if the model is refused
    through: Array  # the output where it was left out, simulated through
    fresh: Array  # and begun there
    remembers: bool  # True if the model is refused as it does not forget where it began


class _Study:
    """Fits without a stretch each, and errors there."""

    def __init__(
        self,
        records: list[Record],
        linear: Callable[[int], LinearModel],
        path: Sequence[tuple[Ridge, int]],
        guarantee: Name | None,
        horizon: int | None,
        stop: Stop | None,
        halt: Callable[[], None],
    ) -> None:
        self._records, self._whole, self._ridges = records, linear, path
        self._guarantee: Name | None = guarantee
        self._stop, self._halt = stop, halt
        self._at_outputs = begins_at_outputs(records)
        self._horizon = horizon if self._at_outputs else None
        self._folds = folds(records, FOLDS, self._horizon or 0)
        self._scale = Scaler.of(records).y_scale
        self.rows = sum(record.y.size for record in records)
        self.counts = np.array(
            [[len(b) for b in np.array_split(y, _BLOCKS)] for y in self._left_out("y")]
        )
        self._linear: dict[int, _Linear | None] = {}

    def has_order(self, nx: int) -> bool:
        """Refine the linear model of an order without each stretch; False if there is none."""
        if nx not in self._linear:
            self._linear[nx] = None
            try:
                model = _made("linear", self._whole(nx), LinearModel)
                models = self._alone(partial(_refined, model), self._folds)
            except ValueError:
                return False
            both = self._alone(self._simulated, list(zip(models, self._folds, strict=True)))
            outputs, fresh = ([each[i] for each in both] for i in range(2))
            squares = self._squares(outputs, fresh)
            if np.isfinite(squares).all():
                longest = max(record.samples for record in self._records)
                slowest = max(np.abs(each.poles).max(initial=0.0) for each in (model, *models))
                slow = bool(slowest > np.exp(-1.0 / longest))
                self._linear[nx] = _Linear(nx, models, outputs, squares, slow)
        return self._linear[nx] is not None

    def best_linear(self, orders: Sequence[int] = ()) -> _Linear:
        """Return the lowest order that does as well as the best of these and all before."""
        for nx in orders:
            self.has_order(nx)
        found = [each for _, each in sorted(self._linear.items()) if each is not None]
        if not found:
            raise InputError(
                "no linear model of these records is stable without a quarter of them; give longer "
                "records, or set the sizes."
            )
        best = self._first_good(found)
        if best.slow and (faster := [each for each in found if not each.slow]):
            other = self._first_good(faster)
            best = other if other.total <= _SLOW**2 * best.total else best
        return best

    def _first_good(self, found: Sequence[_Linear]) -> _Linear:
        squares = np.array([each.squares.ravel() for each in found])
        return found[Judge(squares, self.counts.ravel()).first_good()]

    @property
    def slowest(self) -> float:
        """Largest radius of a pole of the linear models without a stretch."""
        models = [model for each in self._linear.values() if each for model in each.models]
        return max(float(np.abs(model.poles).max()) for model in models)

    def candidates(self, sizes: Sizes, start: Start, seed: int, base: float) -> list[Candidate]:
        """Return a candidate for each ridge, as long as they get better; none if no fit begins."""
        static = {name: size for name, size in sizes.items() if name != "nx"}
        linear = self._linear[sizes["nx"]]
        assert linear is not None
        paths, parameters = [list[Iterator[_Step]]() for _ in range(FOLDS)], 0
        for k, own in product(range(FOLDS), (seed + 1000 * i for i in range(_STARTS))):
            try:
                train = in_windows(self._folds[k].train, self._horizon)
                model = _made("start", start(linear.models[k], train, static, own), Model)
            except InputError:
                return []
            parameters = model.net_parameter_count
            if parameters > _DENSEST * self.rows:
                return []
            paths[k].append(self._path(model, linear, k))
        found, worse, steps = list[Candidate](), 0, list[list[_Step]]()
        for number, (ridge, _) in enumerate(self._ridges):
            if 0 < number <= _HALVED:
                kinds = 2 if number == 1 else 1
                paths = [_better(*both, kinds) for both in zip(paths, steps, strict=True)]
            every = self._alone(next, [path for own in paths for path in own])
            steps = [every[k * len(own) : (k + 1) * len(own)] for k, own in enumerate(paths)]
            outputs, fresh = zip(*map(_mean, steps), strict=True)
            squares = self._squares(outputs, fresh)
            remember = any(all(step.remembers for step in own) for own in steps)
            ratio = sqrt(squares.sum() / base)
            best = min((c.ratio for c in found), default=np.inf)
            found.append(Candidate(sizes, ridge, parameters, ratio, squares, outputs, remember))
            worse = worse + 1 if ratio > _WORSE * best else 0
            if worse == 2:
                break
        return found

    def work(self, parameters: int) -> float:
        """Return the seconds that all ridges of a size take one core, about."""
        each = [count for _, count in self._ridges]
        starts = [_STARTS >> min(number, _HALVED) for number in range(len(each))]
        iterations = FOLDS * sum(map(mul, each, starts))
        return iterations * (3e-3 + 20e-9 * self.rows * parameters * (1.0 + parameters / 100))

    def whole(self, outputs: Sequence[Sequence[Array]]) -> list[tuple[Record, Array, Array]]:
        """Put what was left out of each fold together again: record, linear and NL-LFR output."""
        found = []
        for i, record in enumerate(self._records):
            signals = []
            for own in outputs:
                y = np.array(record.y)
                for fold, part in zip(self._folds, own, strict=True):
                    first, last = fold.windows[i]
                    at = sum(b - a for a, b in fold.windows[:i])
                    y[first:last] = part[at : at + last - first]
                signals.append(y)
            found.append((record, *signals))
        return found

    def _path(self, model: Model, linear: _Linear, k: int) -> Iterator[_Step]:
        """Yield the cost in training and the outputs left out at each ridge."""
        # Nothing here looks at what is measured where it is left out.
        fold, train = self._folds[k], self._folds[k].train
        if self._horizon is not None:
            train = windows(train, self._horizon, model.lfr.cell.nx, y_scale=model.scaler.y_scale)
        longest = max(record.samples for record in fold.train)
        guarantee = partial(guarantee_of, self._guarantee, longest)
        try:
            problem = Problem.of(model, train, guarantee=guarantee)
        except InputError:  # it diverges on what it is fitted to
            lost = np.full_like(linear.outputs[k], np.inf)
            yield from [_Step(np.inf, lost, lost, False)] * len(self._ridges)
            return
        theta = problem.theta
        # Start states at one ridge are near those at the next.
        judges = dict[int, tuple[SimulationErrors, Seen | None]]()

        def simulated(record: Record) -> Array:
            if id(record) not in judges:
                own = [model.scaler.normalise(record)]
                cell = model.lfr.cell
                judge = SimulationErrors(cell, own, solve_initial_states=True)
                judges[id(record)] = judge, None
            judge, near = judges[id(record)]
            _, seen = judge.evaluate(theta[: judge.parameters.own], near)
            judges[id(record)] = judge, seen
            y = seen[0].y[0]
            return record.shown(model.scaler.restore_y(y.double().numpy()))

        for ridge, iterations in self._ridges:
            problem.weigh(ridge)
            optimiser = LevenbergMarquardt(max_iter=iterations, tolerance=1e-3, patience=2)
            search = Search(problem, optimiser)
            search.begin(theta)
            state = search.advance(iterations, check=self._check).state
            theta = state.theta
            problem.write(theta)
            if self._at_outputs:  # each prediction is short, and of unstable systems too
                stable, remembers = True, False
                both = self._ahead(model, fold)
            else:
                stable = largest_stable_amplitude(model, train) >= max(LOUDER)
                remembers = (
                    stable and not forgets(model, train, linear.models[k], draws=_DRAWS).right
                )
                through = [simulated(record) for record in self._records]
                both = fold.left_out(through), fold.begun_again(through, simulated)
            cost = state.cost if stable and not remembers else np.inf
            yield _Step(cost, *both, remembers)

    def _check(self) -> None:
        """End if that is asked for."""
        if self._stop is not None and self._stop():
            raise StoppedError("stopped while sizes were chosen")

    def _simulated(self, job: tuple[LinearModel, Fold]) -> tuple[Array, Array]:
        """Return the output where it was left out: simulated through, and begun there."""
        model, fold = job
        if self._at_outputs:
            return self._ahead(model.to_model(), fold)
        with np.errstate(over="ignore", invalid="ignore"):
            through = [model.simulate(record) for record in self._records]
            return fold.left_out(through), fold.begun_again(through, model.simulate)

    def _ahead(self, model: Model, fold: Fold) -> tuple[Array, Array]:
        """Return the output where it was left out, predicted from measured outputs, twice."""
        ahead = model.simulate
        if self._horizon is not None:
            ahead = partial(model.predict, horizon=self._horizon)
        found = fold.begun_again([record.y for record in self._records], ahead)
        return found, found

    def _left_out(self, name: str) -> list[Array]:
        signals = [getattr(record, name) for record in self._records]
        return [fold.left_out(signals) for fold in self._folds]

    def _squares(self, *outputs: Sequence[Array]) -> Array:
        """Return sums of the squared relative errors in blocks of each stretch, (folds, B)."""
        signals = zip(self._left_out("y"), self._left_out("scored"), *outputs, strict=True)
        with np.errstate(over="ignore", invalid="ignore"):
            errors = [
                np.mean(
                    np.where(there, (np.array(y_hats) - y) / self._scale, 0.0) ** 2, axis=(0, 2)
                )
                for y, there, *y_hats in signals
            ]
        found = np.array(
            [[b.sum() + _FLOOR**2 * len(b) for b in np.array_split(e, _BLOCKS)] for e in errors]
        )
        return found if np.isfinite(found).all() else np.full(found.shape, np.inf)

    def _alone(self, work: Callable[[Any], Any], items: Sequence[Any]) -> list[Any]:
        """Do the work of each item on a thread; Ctrl-C ends all."""
        try:
            return each_alone(work, items, self._halt, threads=worth_threads(self.rows))
        except KeyboardInterrupt:
            raise StoppedError("stopped while sizes were chosen") from None


def _made(name: str, made: Any, kind: type[Made]) -> Made:
    if not isinstance(made, kind):
        said = f"{name} returned {brief(repr(made))}; it is to return a {kind.__name__}."
        raise LfrtorchError(said)
    return made


def _refined(model: LinearModel, fold: Fold) -> LinearModel:
    if begins_at_outputs(fold.train):
        return measured_states_model(fold.train)
    return refined_near(model, fold.train)


def _better(paths: list[Iterator[_Step]], steps: list[_Step], kinds: int) -> list[Iterator[_Step]]:
    """Keep the half of each kind with the smaller costs, in their order; kinds take turns."""
    kept = list[int]()
    for kind in range(kinds):
        own = sorted(range(kind, len(paths), kinds), key=lambda i: steps[i].cost)
        kept += own[: max(1, len(own) // 2)]
    return [paths[i] for i in sorted(kept)]


def _mean(steps: Sequence[_Step]) -> tuple[Array, Array]:
    """Return the mean outputs of the starts whose cost, infinite if unstable, is near the least."""
    least = min(step.cost for step in steps)
    near = [(step.through, step.fresh) for step in steps if step.cost <= _NEAR**2 * least < np.inf]
    lost = np.full_like(steps[0].through, np.inf)
    outputs, fresh = (np.mean(each, axis=0) for each in zip(*(near or [(lost, lost)]), strict=True))
    return outputs, fresh
