"""An update of a model with new data, in which a quadratic prior stands for its old data.

θ = argmin |r(θ)|² / σ² + ρ (θ - θ_0)ᵀ I (θ - θ_0) + μ |θ - θ_0|², with the errors r on the new
records and the information I = J_0ᵀJ_0 / σ² of the old records at the old parameters θ_0, which a
model keeps. If ρ = 1, an old sample counts as much as a new one. If the system has changed, old
samples count less. Cross-validation on the new records finds how much less: of the ρ that are as
good as the best, the largest is taken, so that new data must show that the model should move.

The last term is small beside the information of any data. It holds directions of θ that neither
data determine. Far from θ_0 some of these directions change the outputs, although J_0 is zero along
them. In ``benchmarks/update.py`` a motor gets another load. After an update with 5 % of the new
data the error is 1.01 times that of a fit to all of them, and 1.3 to 3.6 times without this term.
Gauge directions, along which J_0 is zero for any data, are held.

References:
    MacKay, "Bayesian interpolation", Neural Computation 4, 1992 (the posterior as the next prior).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import scipy
import torch
from jaxtyping import Float
from torch import Tensor

from lfrtorch._support.arguments import typed
from lfrtorch._support.checks import number
from lfrtorch._support.errors import InputError
from lfrtorch._support.tables import number as digits
from lfrtorch._support.tables import table
from lfrtorch._support.types import Array
from lfrtorch.data.delayed_records import delayed_records
from lfrtorch.data.paired_blocks import Judge
from lfrtorch.data.records import Record, as_records, with_past_outputs
from lfrtorch.engine.operating_point import double, equilibrium, linearised_at
from lfrtorch.fitting.folds import Fold, as_folded, folds
from lfrtorch.fitting.information import (
    LARGEST,
    as_fitted,
    free_entries,
    information_rows,
    informed,
)
from lfrtorch.fitting.trainer import Trainer
from lfrtorch.fitting.windows import windows
from lfrtorch.least_squares.gauge import reduction
from lfrtorch.least_squares.guarantee import guarantee_of
from lfrtorch.least_squares.levenberg_marquardt import LevenbergMarquardt
from lfrtorch.least_squares.problem import Problem
from lfrtorch.least_squares.search import Search
from lfrtorch.model.information import Information
from lfrtorch.model.model import Model

WEIGHTS = (1.0, 0.3, 0.1, 1e-2, 1e-3, 1e-4, 1e-6)
"""Values of ρ that cross-validation compares."""

HELD = 0.05
"""μ, in the mean information of one old sample on a parameter."""

FOLDS = 4
"""Number of stretches of the new records, each of which is left out in turn."""

SHORT = 10
"""Iterations for each ρ and fold; each search begins where that of the ρ before ended."""

_FIRMER = 100.0
"""Factor on the weight while the new model is unstable at rest."""

_FIRMEST = 1e4
"""Weight up to which it is raised."""

_SETTLED = 1e-3
"""A search for ρ ends if four iterations lower the cost by less than this fraction."""

_CIRCLE = 1e-6
"""Distance of a pole from the unit circle that is not called unstable: exact integrators."""

_TOLD = 1e-12
"""Smallest singular value of an information's root, relative to the largest, above rounding."""


@dataclass(frozen=True, eq=False)
class Update:
    """A model that new data have changed; ``print(update)`` shows how.

    Args:
        model: the new model, with the information of all data.
        weight: ρ, how much the old data counted.
        before, after: rms errors of the old and the new model on the new records, physical units.
        steps: rms step of each group of parameters, and of all, in standard errors of the old
            model, and in those of the group if all others were known.
        values: old and new value of each parameter of known equations.

    Shape:
        before, after: (ny,).

    Example:
        >>> model = lfrtorch.fit(model, record[:300]).model
        >>> update = lfrtorch.update(model, record[300:], prior=record[:300], weight=1.0)
        >>> print(update)
        The old data count 1 times as much as the new ones.
        ...
    """

    model: Model
    weight: float
    before: Float[Array, " ny"]
    after: Float[Array, " ny"]
    steps: dict[str, tuple[float, float]]
    values: dict[str, tuple[float, float]]

    def __str__(self) -> str:
        errors = [
            [channel.name, digits(old), digits(new), channel.unit]
            for channel, old, new in zip(self.model.outputs, self.before, self.after, strict=True)
        ]
        steps = [[name, *map(digits, own)] for name, own in self.steps.items()]
        parts = [
            f"The old data count {digits(self.weight, 1)} times as much as the new ones.",
            table(["rms error on the new records", "before", "after", "unit"], errors),
            table(["step in standard errors, rms", "each", "if others are known"], steps),
        ]
        if self.values:
            rows = [[name, *(digits(v, 4) for v in own)] for name, own in self.values.items()]
            parts.append(table(["parameter", "before", "after"], rows))
        return "\n\n".join(parts)


@typed()
def update(
    model: Model,
    records: Record | Sequence[Record],
    *,
    prior: Record | Sequence[Record] | None = None,
    weight: float | None = None,
    horizon: int | None = None,
    trainer: Trainer | None = None,
) -> Update:
    """Update a model with new data, without its old data.

    The new model fits the new records and stays close to the old model in all that they do not
    tell. Each model keeps what all its data so far tell, so updates may follow each other. For data
    that come piece by piece, one step of the search is an update: ``weight=1`` and
    ``LevenbergMarquardt(max_iter=1)``.

    Args:
        model: a model of ``lfrtorch.identify`` or of an update, which knows what its data told. It
            is not changed. If it has a gain K, predictions are fitted.
        records: new records of its channels and rate, of any length.
        prior: the old records, for a model that does not know what its data told.
        weight: ρ, how much the old data count beside the new ones. Default: cross-validation on the
            new records finds it; 1 if these are too short. It is raised if the new model would be
            unstable at rest and the old one is stable.
        horizon: as in the fit of the model, see ``lfrtorch.fit``.
        trainer: the search. Default: Levenberg-Marquardt with 50 iterations.

    Raises:
        ValueError: a model that does not know what its data told, and no ``prior``; records of
            another number of channels or rate; a weight that is not positive; a model that
            diverges on the new records.

    Example:
        >>> trainer = lfrtorch.LevenbergMarquardt(max_iter=20)
        >>> old, new = record[:300], record[300:]
        >>> result = lfrtorch.fit(model, old, trainer=trainer)
        >>> update = lfrtorch.update(result.model, new, prior=old)
        >>> bool(update.after <= update.before)
        True
    """
    if weight is not None:
        number("weight", weight, positive=True)
    given = as_records(records)
    for record in given:
        model.check(record)
    if any(delay := model.delay):
        acting = partial(delayed_records, delay=delay, level=model.scaler.u_offset)
        prior = None if prior is None else acting(as_records(prior))
        told = {"prior": prior, "weight": weight, "horizon": horizon, "trainer": trainer}
        found = update(model.delayed(0), acting(given), **told)
        return replace(found, model=found.model.delayed(delay))
    own = _Search(model if prior is None else informed(model, prior, horizon), horizon, trainer)
    data = given if model.K is None else [*map(with_past_outputs, given)]
    weight = own.chosen(data) if weight is None else weight
    found, theta = own.fitted(data, weight)
    while not _stable(found) and _stable(own.model) and weight < _FIRMEST:
        weight *= _FIRMER
        found, theta = own.fitted(data, weight)
    known = (one.lfr.cell.map.known for one in (own.model, found))
    old, new = ({} if one is None else one.physical for one in known)
    values = {name: (float(old[name]), float(new[name])) for name in old}
    R = math.sqrt(weight) * own.kept.R
    _, rows, _, size = information_rows(found, own.cut(data))
    R = torch.linalg.qr(torch.cat([R, rows / own.kept.rmse]), mode="r").R
    samples = weight * own.kept.samples + size
    information = replace(own.kept, theta=theta, R=R, samples=samples)
    before, after = (_errors(one, data) for one in (own.model, found))
    result = found if model.K is None else found.innovation_form()
    said = f"{model.fitted_to}, updated with {sum(r.samples for r in given)} samples".lstrip(", ")
    result = replace(result, information=information, fitted_to=said)
    return Update(result, weight, before, after, own.moved(theta), values)


class _Search:
    """Fits of a model to new records under its prior."""

    def __init__(self, model: Model, horizon: int | None, trainer: Trainer | None) -> None:
        self.model = model if model.K is None else model.predictor()
        self.horizon = horizon
        self.trainer = LevenbergMarquardt(max_iter=50) if trainer is None else trainer
        cell = self.model.lfr.cell
        free = [p.detach().double().flatten() for p in cell.parameters() if p.requires_grad]
        theta, self._free = torch.cat(free).cpu(), free_entries(self.model)
        if len(theta) > LARGEST:
            raise InputError(
                f"the model has {len(theta)} parameters, with those that are held; an update takes "
                f"{LARGEST} at most. Give a model that is no mean of many (average)."
            )
        if model.information is None or not torch.equal(model.information.theta, theta):
            raise InputError(
                "the model does not know what its data told about these parameters: give a model "
                "of lfrtorch.identify as it was saved, or prior=..., the records of its fit."
            )
        self.kept: Information = model.information

    @property
    def _wide(self) -> Float[Tensor, "K P"]:
        """R with columns of zeros for the held entries."""
        wide = self.kept.R.new_zeros(len(self.kept.R), len(self._free))
        wide[:, self._free] = self.kept.R
        return wide

    def cut(self, records: Sequence[Record]) -> Sequence[Record]:
        """Records as they are fitted."""
        return as_fitted(self.model, records, self.horizon)

    def fitted(
        self,
        records: Sequence[Record],
        weight: float,
        theta: Float[Tensor, " P"] | None = None,
        limit: int | None = None,
    ) -> tuple[Model, Float[Tensor, " P"]]:
        """The model fitted to records with the weight ρ of the prior, and θ."""
        model = deepcopy(replace(self.model, information=None))
        data = self.cut(records)
        longest = max(record.samples for record in records)
        guarantee = partial(guarantee_of, self.trainer.guarantee, longest)
        problem = Problem.of(model, data, guarantee=guarantee)
        R = self.kept.rmse * math.sqrt(weight) * self._wide.to(problem.theta)
        known, P = self.kept, R.shape[1]
        ridge = math.sqrt(HELD / (known.samples * P)) * known.rmse * known.R.norm()
        problem.weigh(torch.cat([R, ridge * torch.eye(P).to(R), self._gauge(R, data)]))
        begin = problem.theta
        if theta is not None:
            begin = torch.cat([theta.to(begin), begin[len(theta) :]])
        search = Search(problem, self.trainer)
        search.begin(begin)
        until = self.trainer.limit if limit is None else min(limit, self.trainer.limit)
        search.advance(until, settled=0.0 if limit is None else _SETTLED)
        problem.write(search.state.theta)
        return model, problem.errors.parameters.read(model.lfr.cell).cpu()

    def _gauge(self, R: Float[Tensor, "K P"], records: Sequence[Record]) -> Float[Tensor, "n P"]:
        """Rows that hold the gauge directions, as firmly as the data held what they told best."""
        cell = self.model.lfr.cell
        given = any(record.start == "given" for record in records)
        none, held = cell.A.new_zeros(0, cell.nx, dtype=torch.float64), ~self._free
        _, expand = reduction(cell, none, coordinates=not given, fixed=held)
        if expand is None:
            return R[:0]
        silent = scipy.linalg.null_space(expand[:, self._free].double().cpu().numpy())
        rows = R.new_zeros(silent.shape[1], R.shape[1])
        rows[:, self._free] = torch.as_tensor(silent.T).to(R)
        return torch.linalg.matrix_norm(R, 2) * rows

    def chosen(self, records: Sequence[Record]) -> float:
        """The largest ρ that is as good as the best on stretches of the records left out."""
        data = as_folded(records)
        try:
            parts = folds(data, FOLDS, self.horizon or 0)
        except InputError:  # too short
            return WEIGHTS[0]
        errors: list[list[Array]] = [[] for _ in WEIGHTS]
        for part in parts:
            theta = None
            for weight, own in zip(WEIGHTS, errors, strict=True):
                model, theta = self.fitted(part.train, weight, theta, SHORT)
                own.append(self._left_out(model, data, part))
        return WEIGHTS[Judge.of([[np.concatenate(own)] for own in errors]).first_good()]

    def _left_out(self, model: Model, records: Sequence[Record], part: Fold) -> Array:
        """Normalised errors on the samples that a fold leaves out."""
        if self.horizon is None:
            misses = [
                np.where(r.is_valid, r.y - model.simulate(r), 0.0) / model.scaler.y_scale
                for r in records
            ]
            return part.left_out(misses)
        begun = [record for record in part.begun if record is not None]
        judge = Problem.judge(model, windows(begun, self.horizon, model.lfr.cell.nx, fitted=False))
        return judge.evaluate(judge.theta).residual.cpu().numpy()[:, None]

    def moved(self, theta: Float[Tensor, " P"]) -> dict[str, tuple[float, float]]:
        """Rms steps in standard errors, of each group and of all, and if the others were known."""
        R, step = self._wide, theta - self.kept.theta
        _, s, Vh = torch.linalg.svd(R, full_matrices=False)
        W = (Vh.mT / s)[:, s > _TOLD * s[0]]  # W Wᵀ is the covariance of θ
        cell = self.model.lfr.cell
        free = {n: p.numel() for n, p in cell.named_parameters() if p.numel() and p.requires_grad}
        sizes, found = [*free.values()], {}
        parts = zip(free, W.split(sizes), R.split(sizes, dim=1), step.split(sizes), strict=True)
        for name, own, alone, moved in [*parts, ("all", W, R, step)]:
            axes, errors, _ = torch.linalg.svd(own, full_matrices=False)
            along = (axes.mT @ moved)[errors > _TOLD] / errors[errors > _TOLD]
            squares = along.square().mean(), (alone @ moved).square().sum() / len(along)
            found[name] = float(squares[0].sqrt()), float(squares[1].sqrt())
        return found


def _stable(model: Model) -> bool:
    """Tell if the model linearised at rest is stable; True if it has no rest."""
    cell = double(model.lfr.cell)
    u = cell.A.new_zeros(cell.nu)
    x = equilibrium(cell, u)
    if x is None or not cell.nx:
        return True
    return bool(np.abs(np.linalg.eigvals(linearised_at(cell, u, x).A)).max() <= 1.0 + _CIRCLE)


def _errors(model: Model, records: Sequence[Record]) -> Array:
    """The rms error of each output over records."""
    errors = np.concatenate([record.errors(model.simulate(record)) for record in records])
    counts = np.sum([record.scored.sum(axis=0) for record in records], axis=0)
    return np.sqrt((errors**2).sum(axis=0) / counts)
