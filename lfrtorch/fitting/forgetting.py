"""Memory of the start: whether outputs of a model from several start states converge or not.

A model may have rest states, or motions, that no data have shown. From the fitted start state it
then follows the data, also in stretches without measurements; from another start state it stays
elsewhere for ever. So the training inputs are simulated from the record's own start, from rest, and
from random states with the second moment of the record's states. The measure is the largest rms
distance of the outputs from those of the own start, in the last third of a record, over the
outputs' standard deviation.

A lightly damped system forgets slowly, and a system that integrates never forgets. So a model may
forget as slowly as the linear model of the same data. A system may have several rest states, such
as a toggle, or a pendulum that swings over. If trajectories that stay apart end among states that
the records have visited, the model is right to remember.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy
import torch
from torch import Tensor

from lfrtorch._support.arguments import typed
from lfrtorch._support.checks import integer
from lfrtorch._support.tables import percent
from lfrtorch.data.records import Record, as_records
from lfrtorch.engine.simulation import simulate
from lfrtorch.linear.model import LinearModel
from lfrtorch.model.model import Model

LIMIT = 0.02
"""Distance, over the outputs' standard deviation, up to which outputs count as converged."""

_SINGULAR = 1e-9  # added to the correlations of the states, which may be exactly dependent

_LONGEST = 10_000  # largest number of samples of a record that are simulated

_SAMPLES = 60_000  # largest number of samples of all records together, the longest records first

_SLOWER = 3.0
"""Largest distance over the linear model's that counts as forgetting. Right models of lightly
damped systems have up to 2.5, wrong ones 12 and more."""

_NEAR = 2.0  # median distance to visited states, over that between parts of the visited states
_PARTS = 8  # of the records' states in time
_LOOKED_AT = 200  # states at the end of a trajectory that is apart


class Memory(NamedTuple):
    """Distance of outputs from several start states in the last third of the training records.

    Args:
        apart: largest rms distance of outputs from several starts, over the outputs' standard
            deviation; infinite if the model diverges from a start.
        linear: the same distance for the linear model; 0 if there is none.
        visited: True if trajectories that stay apart end at states that the records have visited:
            the system then has several rest states.

    Example:
        >>> print(lfrtorch.Memory(apart=0.001))
        The model forgets where it began.
        >>> lfrtorch.Memory(apart=0.5, linear=0.4).fades  # lightly damped: the linear model is slow
        True
    """

    apart: float
    linear: float = 0.0
    visited: bool = False

    @property
    def fades(self) -> bool:
        """Tell whether the outputs converge, or do so about as slowly as the linear model's."""
        return self.apart <= max(LIMIT, _SLOWER * self.linear)

    @property
    def right(self) -> bool:
        """Tell whether the model forgets its start, or only remembers rests that records visit."""
        return self.fades or self.visited

    def __str__(self) -> str:
        """A sentence."""
        if self.fades:
            slow = ", as slowly as the linear model" if self.apart > LIMIT else ""
            return f"The model forgets where it began{slow}."
        if not np.isfinite(self.apart):
            return "The model runs away from some start states among those of its data."
        far = f"{percent(self.apart)} of its standard deviation"
        text = f"from other start states the output stays {far} apart"
        if self.visited:
            return f"The model has several rests, all of which the records visit: {text}."
        return f"The model does not forget where it began: {text}, where the records never were."


@typed("records")
def forgets(
    model: Model,
    records: Record | Sequence[Record],
    linear: LinearModel | Model | None = None,
    *,
    draws: int = 48,
) -> Memory:
    """Measure how far a model forgets where it began, on the inputs of its training records.

    Args:
        model: model to simulate.
        records: records that the model was fitted to.
        linear: the linear model of the same records, or the start of the fit: the model may forget
            as slowly. Default: none.
        draws: number of random start states, beside the record's own and rest.

    Raises:
        ValueError: no draws.

    Example:
        >>> memory = lfrtorch.forgets(model, record, bla)
        >>> memory.right, memory.apart < 1e-3
        (True, True)
    """
    integer("draws", draws, 1)
    given = sorted(as_records(records), key=lambda record: -record.samples)
    seen, samples = list[Record](), 0
    for record in given:
        if not seen or samples + min(record.samples, _LONGEST) <= _SAMPLES:
            seen.append(record)
            samples += min(record.samples, _LONGEST)
    scale = np.concatenate([record.y for record in given]).std(axis=0)
    scale = np.where(scale > 0.0, scale, 1.0)
    apart, ends, paths = _apart(model, seen, scale, draws)
    slow = 0.0
    if linear is not None and not apart <= LIMIT:
        slow, *_ = _apart(linear.to_model(), seen, scale, draws)
    found = Memory(apart, slow)
    if found.fades or not np.isfinite(apart):
        return found
    return found._replace(visited=_visited(ends, paths))


def _apart(
    model: Model, records: Sequence[Record], scale: np.ndarray, count: int
) -> tuple[float, list[Tensor], list[Tensor]]:
    """Return the largest distance, the ends of trajectories that stay apart, and the own paths."""
    most, ends, paths = 0.0, list[Tensor](), list[Tensor]()
    generator = torch.Generator().manual_seed(0)
    cell = model.lfr.cell
    for record in records:
        own = model.signals(record).x[0]
        T = min(record.samples, _LONGEST)
        own = own[: T + 1]
        u = torch.as_tensor(model.scaler.normalise_u(record.u[:T])).to(cell.A)
        if not torch.isfinite(own).all():
            return np.inf, [], []
        moment = (own.mT @ own / len(own)).double()
        rms = moment.diagonal().sqrt()
        unit = torch.where(rms > 0.0, rms, 1.0)
        alike = moment / torch.outer(unit, unit) + _SINGULAR * torch.eye(cell.nx)
        root = torch.linalg.cholesky(alike)
        # Every second state is drawn with the states' correlations, the others without them. Draws
        # do not depend on the scale of the states.
        draws = torch.randn(count, cell.nx, generator=generator, dtype=torch.float64)
        draws[::2] = draws[::2] @ root.mT
        draws = draws * rms
        starts = torch.cat([own[:1], torch.zeros_like(own[:1]), draws.to(own)]).to(cell.A)
        paths.append(own.double())
        for v in (u, u.flip(0)):
            found = simulate(cell, v.expand(len(starts), -1, -1), starts)
            y = (found.y[:, 2 * T // 3 :].double().cpu().numpy()) * model.scaler.y_scale / scale
            with np.errstate(over="ignore", invalid="ignore"):
                distance = np.sqrt(np.mean((y - y[0]) ** 2, axis=(1, 2)))
            distance = np.where(np.isfinite(distance), distance, np.inf)
            most = max(most, float(distance.max()))
            late = found.x[:, 2 * T // 3 :].double().cpu()
            ends += [late[i][-_LOOKED_AT:] for i in np.flatnonzero(distance > LIMIT)]
    return most, ends, paths


def _visited(ends: Sequence[Tensor], paths: Sequence[Tensor]) -> bool:
    """Tell whether trajectories end as near the records' states as these are to each other."""
    states = np.concatenate([path.numpy() for path in paths])
    deviation = states.std(axis=0)
    deviation = np.where(deviation > 0.0, deviation, 1.0)
    parts = np.array_split(states / deviation, _PARTS)
    trees = [scipy.spatial.KDTree(part) for part in parts]
    usual = np.concatenate(
        [
            np.min([tree.query(part)[0] for tree in trees if tree is not own], axis=0)
            for part, own in zip(parts, trees, strict=True)
        ]
    )
    points = np.concatenate([end.numpy() for end in ends]) / deviation
    near = np.min([tree.query(points)[0] for tree in trees], axis=0)
    each = np.split(near, np.cumsum([len(end) for end in ends])[:-1])
    return all(np.median(own) <= _NEAR * np.median(usual) for own in each)
