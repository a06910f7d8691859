"""The next experiment: an input that tells most about the parameters of a model, within limits.

The input is put together from stretches. A pool has multisines of random bands and staircases of
random levels, each scaled to the limits. The information J'J / σ² of each stretch is that of the
fitted model. Stretches are exchanged as long as log det of the information of all data, old and
new, grows (D-optimal). A second pool is drawn near the stretches that were chosen. One stretch is
chosen for the values of z that no record has visited yet, as no information tells how a static map
goes on there.

References:
    Fedorov, "Theory of Optimal Experiments", 1972 (the exchange).
    Pintelon and Schoukens, "System Identification: A Frequency Domain Approach", 2nd ed., 2012,
    chapter 5 (multisines).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from lfrtorch._support.arguments import typed
from lfrtorch._support.atomic import whole_file
from lfrtorch._support.checks import integer, reals
from lfrtorch._support.errors import InputError
from lfrtorch._support.tables import number, table
from lfrtorch._support.types import Array, Booleans
from lfrtorch.data.excitation import multisine
from lfrtorch.data.records import Record, as_records, with_past_outputs
from lfrtorch.fitting.information import LARGEST, free_entries, information_rows, informed
from lfrtorch.model.model import Model

STRETCHES = 8
"""Number of stretches of an experiment."""

POOL = 80
"""Number of stretches in each pool."""

DRAWS = 10
"""Number of random phases, of which a multisine takes those of the smallest crest factor."""

_TAIL = 4.0
"""Power of uniform levels for staircases that reach far and have a small rms."""

_BINS = 12
"""Number of intervals into which the range of each z is cut, to see which ones were visited."""

_TOLD = 1e-9
"""Smallest eigenvalue of the information that counts, relative to the largest."""

_HALVINGS = 60
"""Most reductions of an input by a fifth, to keep the limits of y."""

Limits = Mapping[str, Any]
"""Limits by name: u, du, y and rms."""


@dataclass(frozen=True, eq=False)
class Experiment:
    """An input for the next measurement; ``print(experiment)`` shows what it will tell.

    Args:
        record: the input, and the output that the model predicts for it.
        before, after: predicted standard errors of each group of parameters, rms, in normalised
            units, with the old data and with all.
        crest: crest factor of each input, its peak over its rms.
        visited: part of the range of the static map's inputs, as far as the limits allow, that data
            visit: the old data, and all.

    Example:
        >>> experiment = lfrtorch.next_experiment(model, record, samples=200)
        >>> experiment.record.samples
        200
    """

    record: Record
    before: dict[str, float]
    after: dict[str, float]
    crest: Float[Array, " nu"]
    visited: tuple[float, float]

    def __str__(self) -> str:
        rows = [[g, number(b), number(self.after[g])] for g, b in self.before.items()]
        ends = zip(self.record.inputs, self.record.u.min(0), self.record.u.max(0), self.crest)  # noqa: B905
        said = [
            f"{channel}: {number(low)} to {number(high)}, crest factor {number(crest, 2)}"
            for channel, low, high, crest in ends
        ]
        part = " to ".join(f"{100 * v:.0f} %" for v in self.visited)
        said.append(f"visited part of the range of z: {part}")
        head = ["predicted standard error, rms", "old data", "with the new ones"]
        return "\n".join([table(head, rows), "", *said])

    def save(self, path: str | Path) -> Path:
        """Write time and inputs as a CSV for a signal generator; return its path."""
        record = self.record
        names = ",".join(["t [s]", *map(str, record.inputs)])
        time = np.arange(record.samples) / record.fs
        with whole_file(path := Path(path)) as fresh:
            np.savetxt(
                fresh, np.c_[time, record.u], fmt="%.10g", delimiter=",", header=names, comments=""
            )
        return path


@typed("limits")
def next_experiment(
    model: Model,
    records: Record | Sequence[Record],
    *,
    limits: Limits | None = None,
    samples: int | None = None,
    seed: int = 0,
) -> Experiment:
    """The input that tells most about a model's parameters, within limits.

    Args:
        model: the model fitted so far.
        records: the records it was fitted to.
        limits: bounds by name. ``u`` and ``y``: (least, largest) of the inputs and of the predicted
            outputs; ``du``: largest change of an input from sample to sample; ``rms``: largest rms
            of an input about the middle of its range. A number or pair for all channels, or a list
            with one for each. Default: ``u`` as in the records.
        samples: length of the experiment. Default: that of the longest record.
        seed: seed of the random stretches.

    Raises:
        ValueError: limits of other names or shapes, too few samples, or records of other channels
            or rate.

    Example:
        >>> experiment = lfrtorch.next_experiment(model, record, limits={"u": (-2, 2)}, samples=400)
        >>> bool(np.abs(experiment.record.u).max() <= 2)
        True
        >>> experiment.after["A"] < experiment.before["A"]
        True
        >>> experiment.save("next.csv").name
        'next.csv'
    """
    data = as_records(records)
    count = max(r.samples for r in data) if samples is None else samples
    integer("samples", count, 4 * STRETCHES)
    bounds = _Bounds(model, data, limits or {})
    told = informed(model, data).information
    if told is None:
        raise InputError(
            "the records tell nothing about the model: it diverges on them, fits them exactly, or "
            f"is a mean of more than {LARGEST} parameters. Give the records of its fit."
        )
    old = (told.R.mT @ told.R).numpy()
    seen = np.concatenate([_z(model, r.u) for r in data])
    rng, length = np.random.default_rng(seed), -(-count // STRETCHES)
    kinds = [_Kind.drawn(rng, length) for _ in range(POOL)]
    pool: list[Array] = []
    of_pool: list[Array] = []
    of_z: list[Array] = []
    for last in (False, True):
        added = [bounds.kept(kind.input(rng, length, bounds)) for kind in kinds[len(pool) :]]
        pool += added
        of_pool += [_information(model, data[0], u) / told.rmse**2 for u in added]
        of_z += [_z(model, u) for u in added]
        first = _widest(seen, of_z)
        chosen = _exchanged(old, of_pool, first)
        if not last:
            kinds += [kinds[i].near(rng, length) for i in chosen for _ in range(POOL // STRETCHES)]
    u = bounds.kept(np.concatenate([pool[i] for i in chosen])[:count])
    new = old + _information(model, data[0], u) / told.rmse**2
    before, after = _errors(model, old, new)
    middle = u - bounds.middle
    record = _record(model, data[0], u)
    reached = np.concatenate([seen, *of_z])
    visited = _visited(seen, reached), _visited(np.concatenate([seen, _z(model, u)]), reached)
    crest = np.abs(middle).max(0) / np.maximum(np.sqrt((middle**2).mean(0)), 1e-300)
    return Experiment(record, before, after, crest, visited)


class _Bounds:
    """The limits of an experiment."""

    def __init__(self, model: Model, records: Sequence[Record], limits: Limits) -> None:
        self._model, nu, ny = model, len(model.inputs), len(model.outputs)
        unknown = set(limits) - {"u", "du", "y", "rms"}
        if unknown:
            raise InputError(f"limits have {sorted(unknown)}; give u, du, y or rms.")
        every = np.concatenate([r.u for r in records])
        usual = np.stack([every.min(0), every.max(0)], axis=1)
        self.low, self.high = _pairs("u", limits.get("u", usual), nu).T
        self.middle = (self.low + self.high) / 2
        self._y = _pairs("y", limits["y"], ny) if "y" in limits else None
        self._du, self._rms = (
            np.broadcast_to(reals(name, limits.get(name, np.inf)), nu) for name in ("du", "rms")
        )
        if not ((self._du > 0).all() and (self._rms > 0).all()):
            raise InputError("du and rms are limits of the inputs: give positive numbers.")

    def kept(self, u: Float[Array, "T nu"]) -> Float[Array, "T nu"]:
        """The input about the middle, scaled down until it keeps all limits."""
        v = u - self.middle
        before = np.zeros_like(self.middle)  # the experiment begins at rest in the middle
        for k in range(len(v)):
            before = v[k] = np.clip(v[k], before - self._du, before + self._du)
        half = (self.high - self.low) / 2
        with np.errstate(divide="ignore"):
            room = half / np.abs(v).max(0), self._rms / np.sqrt((v**2).mean(0))
        v = v * np.minimum(1.0, np.minimum(*room))
        for _ in range(_HALVINGS):
            if self._y is None:
                break
            y = self._model.simulate(self.middle + v)
            if ((y >= self._y[:, 0]) & (y <= self._y[:, 1])).all():
                break
            v = 0.8 * v
        else:
            raise InputError(
                "even small inputs about the middle of their range lead to outputs beyond the "
                "limits of y; give wider limits of y, or others of u."
            )
        return self.middle + v


@dataclass(frozen=True)
class _Kind:
    """A kind of stretch: a multisine of a band in cycles per sample, or a staircase.

    The levels of a staircase are uniform to the power ``tail``.
    """

    low: float
    high: float
    steps: bool
    tail: float

    @classmethod
    def drawn(cls, rng: np.random.Generator, length: int) -> _Kind:
        """A random kind."""
        low, high = np.sort(np.exp(rng.uniform(np.log(1.0 / length), np.log(0.5), 2)))
        return cls(low, high, bool(rng.random() < 0.4), float(rng.choice([1.0, _TAIL])))

    def near(self, rng: np.random.Generator, length: int) -> _Kind:
        """A kind with a similar band."""
        ends = np.exp(np.log([self.low, self.high]) + 0.3 * rng.standard_normal(2))
        low, high = np.clip(np.sort(ends), 1.0 / length, 0.5)
        return replace(self, low=low, high=high)

    def input(self, rng: np.random.Generator, T: int, bounds: _Bounds) -> Float[Array, "T nu"]:
        """An input that reaches the limits of u."""
        columns = []
        for _ in bounds.middle:
            if self.steps:
                hold = max(1, round(0.5 / self.high))
                levels = rng.uniform(-1.0, 1.0, -(-T // hold))
                levels = np.sign(levels) * np.abs(levels) ** self.tail
                columns.append(np.repeat(levels / np.abs(levels).max(), hold)[:T])
                continue
            first, last = np.clip([round(self.low * T), round(self.high * T)], 1, (T - 1) // 2)
            lines = np.arange(first, last + 1)
            drawn = multisine(T, lines=lines, realisations=DRAWS, seed=rng).u[:, :, 0]
            best = drawn[np.argmin(np.abs(drawn).max(1))]
            columns.append(best / np.abs(best).max())
        half = (bounds.high - bounds.low) / 2
        return bounds.middle + half * np.stack(columns, axis=1)


def _pairs(name: str, given: Any, count: int) -> Float[Array, "n 2"]:
    """(least, largest) of each channel."""
    found = reals(f"limits of {name}", given)
    ordered = found.shape in ((2,), (count, 2)) and (found[..., 0] < found[..., 1]).all()
    if not (ordered and np.isfinite(found).all()):
        raise InputError(
            f"limits of {name} are {given}; give finite (least, largest), least below largest, or "
            f"a list with such a pair for each of the {count} channel(s)."
        )
    return np.broadcast_to(found, (count, 2))


def _record(model: Model, like: Record, u: Float[Array, "T nu"]) -> Record:
    """The input with the model's output, from rest."""
    y = model.simulate(u)
    return Record(
        u, y, fs=like.fs, name="next experiment", inputs=model.inputs, outputs=model.outputs
    )


def _information(model: Model, like: Record, u: Float[Array, "T nu"]) -> Float[Array, "P P"]:
    """J'J of an input from rest."""
    record = _record(model, like, u)
    own = model if model.K is None else model.predictor()
    _, R, *_ = information_rows(own, [record if model.K is None else with_past_outputs(record)])
    return (R.mT @ R).numpy()


def _z(model: Model, u: Float[Array, "T nu"]) -> Float[Array, "T nz"]:
    return model.signals(u).z[0].double().numpy()


def _visited(z: Float[Array, "T nz"], whole: Float[Array, "m nz"]) -> float:
    """Part of the intervals of each z, within its range over ``whole``, that signals visit."""
    return float(np.mean(_cells(z, whole))) if z.shape[1] else 1.0


def _widest(seen: Float[Array, "T nz"], of_pool: Sequence[Float[Array, "m nz"]]) -> int | None:
    """The stretch that visits most intervals of z that are new; None if none does."""
    whole = np.concatenate([seen, *of_pool])
    old = _cells(seen, whole)
    new = [int((_cells(z, whole) & ~old).sum()) for z in of_pool]
    return int(np.argmax(new)) if max(new) > 0 else None


def _cells(z: Float[Array, "T nz"], whole: Float[Array, "m nz"]) -> Booleans:
    """Intervals of each z, (nz, bins), that are visited."""
    ends = zip(z.T, whole.T, strict=True)
    return np.array([np.histogram(a, _BINS, (b.min(), b.max()))[0] > 0 for a, b in ends], bool)


def _exchanged(
    old: Float[Array, "P P"], of_pool: Sequence[Float[Array, "P P"]], first: int | None
) -> list[int]:
    """Stretches whose information, with the old one, has the largest determinant."""
    values, V = np.linalg.eigh(old + np.sum(of_pool, axis=0))
    V = V[:, values > _TOLD * values[-1]]
    base = V.T @ old @ V + _TOLD * values[-1] * np.eye(V.shape[1])
    each = [V.T @ G @ V for G in of_pool]

    def best(total: Array, taken: Sequence[int]) -> int:
        free = [i for i in range(len(each)) if i not in taken]
        return max(free, key=lambda i: np.linalg.slogdet(total + each[i])[1])

    chosen = [] if first is None else [first]
    total = base + sum((each[i] for i in chosen), np.zeros_like(base))
    while len(chosen) < STRETCHES:
        chosen.append(best(total, chosen))
        total = total + each[chosen[-1]]
    for place in range(0 if first is None else 1, STRETCHES):
        others = total - each[chosen[place]]
        chosen[place] = best(others, [i for k, i in enumerate(chosen) if k != place])
        total = others + each[chosen[place]]
    return chosen


def _errors(
    model: Model, old: Float[Array, "P P"], new: Float[Array, "P P"]
) -> tuple[dict[str, float], dict[str, float]]:
    """Standard errors of each group of parameters, rms, with the old information and the new."""
    values, V = np.linalg.eigh(new)
    V = V[:, values > _TOLD * values[-1]]
    own = model if model.K is None else model.predictor()
    whole = {n: p.numel() for n, p in own.lfr.cell.named_parameters() if p.requires_grad}
    parts = zip(whole, free_entries(own).split([*whole.values()]), strict=True)
    sizes = {name: count for name, mask in parts if (count := int(mask.sum()))}
    found: list[dict[str, float]] = []
    for G in (old, new):
        inverse = np.linalg.pinv(V.T @ G @ V, rcond=1e-13, hermitian=True)
        variance = np.einsum("ik,kl,il->i", V, inverse, V)
        each = np.split(variance, np.cumsum([*sizes.values()])[:-1])
        found.append({n: float(np.sqrt(v.mean())) for n, v in zip(sizes, each, strict=True)})
    return found[0], found[1]
