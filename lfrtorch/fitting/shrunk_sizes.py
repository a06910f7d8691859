"""Sizes of a model by group lasso: from the largest down, instead of a race of many.

The largest model is fitted from several starts. A penalty on the norms of whole groups of weights
(``lfrtorch.least_squares.group_lasso``) then lets states, z, w and neurons fade that the data have
little use for; what has faded is cut out, and the rest is fitted again without the penalty. This is
repeated from there with a larger penalty, until the error on validation has grown. Of all these
models the fewest parameters are taken that do as well as the best.

Before each penalty z, w and x are turned to where their groups say the most: z to the singular
vectors of Wz [Cz Dzu], w to those of [Bw; Dyw] [Ww bw], and x to balanced coordinates. The output
does not change by that.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import replace
from math import ceil, isfinite
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lfrtorch._support.arguments import typed
from lfrtorch._support.checks import number
from lfrtorch._support.errors import InputError
from lfrtorch._support.threads import spread_by_hand
from lfrtorch._support.types import Array
from lfrtorch.distributed import Ranks
from lfrtorch.engine.cell import LFRCell
from lfrtorch.engine.lfr import LFR
from lfrtorch.engine.linearised import spectral_radius
from lfrtorch.engine.nonlinearity import Network, is_network
from lfrtorch.fitting.multistart import fit
from lfrtorch.fitting.size_search import (
    ITERATIONS,
    NN,
    NW,
    NZ,
    SEEDS,
    Candidate,
    Judge,
    Sizes,
    SizeSearch,
    begun,
    check_whole,
    sizes_to_try,
)
from lfrtorch.fitting.trainer import Fit, FitResult, Monitor, Stop, Trainer
from lfrtorch.least_squares.exact_integrators import integrating_states
from lfrtorch.least_squares.group_lasso import ENTRIES, GroupLassoProblem
from lfrtorch.least_squares.levenberg_marquardt import LevenbergMarquardt
from lfrtorch.least_squares.simulation_problem import Ridge, SimulationProblem
from lfrtorch.linear.model import LinearModel, balancing
from lfrtorch.model import Model
from lfrtorch.records import Record, Scaler, as_records
from lfrtorch.score_window import with_window

WEIGHTS = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0)
"""What a group of norm 1 costs, over the squared error that the largest model leaves."""

LEAST_ERROR = 1e-5
"""RMS error over that of the output below which there is no noise to compare a group with."""

SHRINKING, REFITTING = 0.4, 0.4
"""Parts of the iterations of the first fit, for each penalty, and without it."""

FADED = 0.03
"""A group is cut out if its norm is below this part of the largest of its kind."""

CONDITION = 1e6
"""Of the change of coordinates of x, beyond which it is left out: a state is all but unused."""

WORSE = 1.5
"""Ratio of errors on validation at which larger penalties are not tried."""


@typed()
@spread_by_hand()
def shrink_sizes(
    start: Callable[[Sizes, int], Model],
    train: Record | Sequence[Record],
    validation: Record | Sequence[Record],
    *,
    nx: int | Sequence[int] | None = None,
    nz: int | Sequence[int] = NZ,
    nw: int | Sequence[int] = NW,
    nn: int | Sequence[int] = NN,
    linear: LinearModel | None = None,
    seeds: Sequence[int] = SEEDS,
    weights: Sequence[float] = WEIGHTS,
    trainer: Trainer | None = None,
    ridge: Ridge = 0.0,
    monitor: Monitor | None = None,
    watch: Callable[[str], None] = lambda _: None,
    stop: Stop | None = None,
) -> SizeSearch:
    """Sizes by group lasso: the largest model shrinks, and the smallest that is good enough stays.

    Args:
        start: makes the model of given sizes to start from with a given seed, see
            :func:`lfrtorch.search_sizes`; its static map is a network.
        train: records that are fitted.
        validation: records that choose among iterates, starts and sizes.
        nx, nz, nw, nn: sizes; of several numbers the largest is where it begins, and one number is
            a size that is known.
        linear: the model that errors are compared with.
        seeds: of the starts of the largest model.
        weights: of the penalties, rising: what a group of norm 1 costs, over the squared error that
            the largest model leaves in training.
        trainer: the search. Default: Levenberg-Marquardt with 75 iterations. Each penalty and each
            fit without it take two fifths of them.
        ridge, stop: see :func:`lfrtorch.fit`.
        monitor: called after every iteration of any model. Default: none.
        watch: called with a line on each model.

    Returns:
        The models, each with its ``model``, the largest first.

    Raises:
        ValueError: nothing to try, no records for validation, or another static map than a network.
        StoppedError: by Ctrl-C or ``stop``.

    Example:
        >>> def start(sizes, seed):
        ...     return lfrtorch.initialise(bla, record, **sizes, seed=seed)
        >>> short = lfrtorch.LevenbergMarquardt(max_iter=5)
        >>> search = lfrtorch.shrink_sizes(
        ...     start, record, record, nz=(1, 2), nw=1, nn=4, seeds=(0,), trainer=short
        ... )
        >>> search.chosen.sizes["nz"] in (1, 2), search.chosen.model.sizes["nn"]
        (True, 4)
    """
    given = ({} if nx is None else {"nx": nx}) | {"nz": nz, "nw": nw, "nn": nn}
    tried = {name: sizes_to_try(name, values) for name, values in given.items()}
    searched = [name for name, values in tried.items() if len(values) > 1]
    for name, several in (("seeds", seeds), ("weights", weights)):
        if not len(several):
            raise InputError(f"{name} is empty; give one at least.")
    for weight in weights:
        number("each of the weights", weight)
    if not validation:
        raise InputError(
            "there are no validation records, on which sizes are chosen; give some, or set "
            f"{', '.join(tried)} to numbers."
        )
    largest = {name: values[-1] for name, values in tried.items()}
    models = [replace(begun(start, largest, seed), K=None) for seed in seeds]
    _check_cell(models[0].lfr.cell, searched)
    validation = [*map(with_window, as_records(validation))]
    scale = Scaler.of(validation).y_scale
    judge = Judge(validation, linear, Ranks(), scale)
    trainer = LevenbergMarquardt(max_iter=ITERATIONS) if trainer is None else trainer
    options: dict[str, Any] = {"ridge": ridge, "stop": stop}
    watching = [monitor or (lambda model, progress: None)]
    clock = time.perf_counter()
    first = fit(
        models, train, validation, trainer=trainer, monitors=[watching] * len(models), **options
    )
    seed = seeds[first.starts[0].number] if first.starts else seeds[0]
    data = SimulationProblem.of(first.model, train)
    left = max(data.cost(data.residual(data.theta)), LEAST_ERROR**2 * data.size)

    found: list[Candidate] = []

    def judged(result: FitResult, iterations: int) -> Candidate:
        sizes = {name: result.model.sizes[name] for name in tried}
        candidate = replace(
            judge.scored(sizes, seed, 1, result),
            iterations=iterations,
            seconds=time.perf_counter() - clock - sum(each.seconds for each in found),
            model=deepcopy(result.model),
        )
        found.append(candidate)
        watch(f"sizes: {candidate}")
        return candidate

    def some(part: float) -> Any:
        each: Any = trainer
        return replace(each, max_iter=ceil(part * trainer.limit))

    judged(first, sum(each.iterations for each in first.starts) or first.iterations)
    given_states = any(record.start == "given" for record in as_records(train))
    model = first.model
    for weight in weights:
        model = turned(model, states=not given_states)
        lasso = (searched, weight * left)
        shrinking = Fit(model, train, trainer=some(SHRINKING), group_lasso=lasso, **options)
        shrinking.advance(monitors=watching)
        assert isinstance(shrinking.problem, GroupLassoProblem)
        norms = shrinking.problem.norms()
        kept = {name: each >= FADED * each.max() for name, each in norms.items()}
        if not all(bool(each.all()) for each in kept.values()):
            model = without(model, kept)
            again = Fit(model, train, validation, trainer=some(REFITTING), **options)
            again.advance(monitors=watching)
            check_whole([shrinking, again])
            error = judged(again.result(), shrinking.state.iteration + again.state.iteration).error
            if not error <= WORSE * min(each.error for each in found):
                break
        check_whole([shrinking])
    search = SizeSearch(tuple(found), judge.counts)
    if not isfinite(search.chosen.error):
        raise InputError("all models that were tried diverge on validation; set the sizes.")
    return search


@torch.no_grad()
def turned(model: Model, *, states: bool = True) -> Model:
    """The same model with z and w, and x, in the coordinates of the singular vectors.

    Args:
        model: its static map is a network.
        states: whether x is turned, too: not if start states are given in its coordinates. It never
            is if A is not stable, or has exact integrators.
    """
    model = deepcopy(model)
    cell = model.lfr.cell
    assert isinstance(cell.static, Network)
    Cz, Dzu, Wz = cell.Cz, cell.Dzu, cell.static.Wz
    none = (torch.cat([Cz, Dzu], dim=1) == 0).all(dim=0)
    left, right = _factors(Wz, torch.cat([Cz, Dzu], dim=1))
    right[:, none] = 0.0  # columns of integrators, and of inputs that z does not see
    Wz.copy_(left)
    Cz.copy_(right[:, : cell.nx])
    Dzu.copy_(right[:, cell.nx :])
    left, right = _factors(
        torch.cat([cell.Bw, cell.Dyw]),
        torch.cat([cell.static.Ww, cell.static.bw.unsqueeze(1)], dim=1),
    )
    cell.Bw.copy_(left[: cell.nx])
    cell.Dyw.copy_(left[cell.nx :])
    cell.static.Ww.copy_(right[:, :-1])
    cell.static.bw.copy_(right[:, -1])
    A = cell.A.detach()
    if not states or integrating_states(cell).any() or not spectral_radius(A) < 1.0:
        return model
    B, C = torch.cat([cell.Bu, cell.Bw], dim=1), torch.cat([cell.Cy, Cz])
    T, inverse = (torch.as_tensor(each).to(A) for each in balancing(*map(_array, (A, B, C))))
    if torch.linalg.cond(T) < CONDITION:
        cell.A.copy_(T @ A @ inverse)
        for name in ("Bu", "Bw"):
            cell.get_parameter(name).copy_(T @ cell.get_parameter(name))
        for name in ("Cy", "Cz"):
            cell.get_parameter(name).copy_(cell.get_parameter(name) @ inverse)
    return model


@torch.no_grad()
def without(model: Model, kept: Mapping[str, Bool[Tensor, " n"]]) -> Model:
    """The model with some of its states, z, w and neurons alone.

    Args:
        model: its static map is a network.
        kept: which, by the name of the size.
    """
    before = model.lfr.cell
    assert isinstance(before.static, Network)
    old = {"nx": before.nx, "nz": before.nz, "nw": before.nw, "nn": len(before.static.bz)}
    nx, nz, nw, nn = (int(kept[n].sum()) if n in kept else size for n, size in old.items())
    activation, layers = before.static.activation, before.static.layers
    like: Any = {"device": before.A.device, "dtype": before.A.dtype}
    static = Network(nz, nw, nn, activation, layers=layers, **like)
    cell = LFRCell(before.nu, before.ny, nx, nz, nw, static, **like)
    for name, target in cell.named_parameters():
        source = before.get_parameter(name)
        for size, places in kept.items():
            for axis in ENTRIES[size].get(name, ()):
                source = source.index_select(axis, places.nonzero().flatten())
        target.copy_(source)
        target.requires_grad_(before.get_parameter(name).requires_grad)
    return replace(model, lfr=LFR(cell))


def _factors(
    left: Float[Tensor, "m n"], right: Float[Tensor, "n k"]
) -> tuple[Float[Tensor, "m n"], Float[Tensor, "n k"]]:
    """Two matrices of the same product, U √S and √S Vᵀ of its singular value decomposition."""
    n = left.shape[1]
    U, s, Vh = torch.linalg.svd(left @ right, full_matrices=False)
    some, root = min(n, len(s)), s[:n].sqrt()
    new_left, new_right = torch.zeros_like(left), torch.zeros_like(right)
    new_left[:, :some], new_right[:some] = U[:, :some] * root, root.unsqueeze(1) * Vh[:some]
    return new_left, new_right


def _array(matrix: Tensor) -> Array:
    return matrix.detach().double().cpu().numpy()


def _check_cell(cell: LFRCell, searched: Sequence[str]) -> None:
    """Refuse models whose groups of weights are others with a ValueError."""
    if not searched:
        raise InputError("all sizes are given; give several numbers of one of them.")
    if not is_network(cell.static) or ("nn" in searched and cell.static.layers > 1):
        raise InputError(
            f"group lasso is for a network, with nn of one layer, not {cell.static}; give such a "
            "map, or sizes by a race: search_sizes."
        )
    if cell.structure != "free":
        raise InputError(
            f"structure is {cell.structure!r}, and group lasso is for 'free' ones; give sizes."
        )
