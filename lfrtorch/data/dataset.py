"""Dataset: records by use, and published results for comparison."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array
from lfrtorch.data.records import Record, signals
from lfrtorch.data.score_window import with_window

LISTED = 3
"""Largest number of records of a use that a printed dataset lists."""


@dataclass(frozen=True)
class Published:
    """Simulation RMSE of a published model on the test records, for comparison.

    Args:
        label: column head, for example ``"NL-LFR (paper)"``.
        scores: RMSE in the output's unit, by the name of the test record; for several outputs, by
            the names of record and output, as ``"multisine acc1"``.
        reference: source of the numbers.
        sizes: (nz, nw) if the number belongs to one model size only.
        unit: unit of the output with the prefix for tables, ``"µm"`` for example. Default:
            tables choose one.

    Example:
        >>> paper = lfrtorch.Published("NL-LFR (paper)", {"multisine": 1.9e-5}, "a paper")
        >>> paper.scores["multisine"]
        1.9e-05
    """

    label: str
    scores: dict[str, float]
    reference: str
    sizes: tuple[int, int] | None = None
    unit: str = ""


class Undecided(NamedTuple):
    """A training record with an estimated start that may begin at rest.

    Args:
        record: the whole record.
        seen: number of its samples before its test part, on which the start may be decided.
        skip: samples of the training part that are skipped if it begins at rest.
        places: numbers of its parts among the records of each use, by ``"train"``,
            ``"validation"`` and ``"test"``.
    """

    record: Record
    seen: int
    skip: int
    places: Mapping[str, int]


@dataclass(frozen=True)
class Dataset:
    """Records by use: training, validation, selection and tests.

    Args:
        name: the benchmark's name, or the file's stem.
        train: records that are fitted; here and below a single record needs no list.
        validation: records that choose among iterates and starts; never fitted.
        selection: further records that choose among starts, but not among the iterates of a start:
            at other amplitudes, for example.
        tests: records that only an evaluation uses.
        noise_rms: rms of the measurement noise added to simulated estimation data, output unit;
            ``None`` for measured data.
        published: results of others on the same tests.
        linear: names of the training records from which the linear model of a test is estimated, by
            the name of the test or group. Other tests have the linear model of all records.
        notes: remarks on the data for readers of the scores, a sentence each.
        seed: seed of simulated data.
        groups: names of test or validation records that form one score, by the name of the score:
            the mean of the RMSE over the outputs and records.
        ahead: scores of predictions from measured starts, by name: functions of predicted and
            measured outputs, (n, horizon, ny) each, that return errors (n, horizon). A score is
            the sum over the horizon of their means.
        leaderboard: test records as nonlinearbenchmark.org scores them: cut by the package
            nonlinear_benchmarks, with the start state fitted to the samples left unscored.
        undecided: training records whose start an identification decides.

    Raises:
        ValueError: anything but records.

    Example:
        >>> data = lfrtorch.Dataset("mine", train=[record], validation=[], tests=[record[200:]])
        >>> [test.samples for test in data.tests]
        [200]
        >>> print(data)
        Dataset 'mine': u -> y at 100 Hz
          train       400 samples: record (400, periodic)
          tests       200 samples: record (200, zero)
    """

    name: str
    train: list[Record]
    validation: list[Record] = field(default_factory=list)
    tests: list[Record] = field(default_factory=list)
    noise_rms: float | None = None
    published: tuple[Published, ...] = field(default_factory=tuple)
    selection: list[Record] = field(default_factory=list)
    notes: tuple[str, ...] = ()
    linear: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    leaderboard: list[Record] = field(default_factory=list)
    seed: int | None = None
    groups: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    ahead: Mapping[str, Callable[[Array, Array], Array]] = field(default_factory=dict)
    undecided: tuple[Undecided, ...] = ()

    def __post_init__(self) -> None:
        for use in ("train", "validation", "tests", "selection", "leaderboard"):
            given = getattr(self, use)
            records = [given] if isinstance(given, Record) else given
            if not isinstance(records, Sequence) or not all(
                isinstance(record, Record) for record in records
            ):
                raise InputError(
                    f"{use} has something else than records; give a list of them, or [] for none."
                )
            object.__setattr__(self, use, records)

    def with_windows(self, delay: Sequence[int] = ()) -> Dataset:
        """Set the scored samples of estimated starts that do not give them, after a delay of u."""
        later = max(delay, default=0)
        held_out = ("validation", "selection", "tests")
        windows = {use: [with_window(r, later) for r in getattr(self, use)] for use in held_out}
        return replace(self, **windows)

    def score_of(self, record: Record) -> str:
        """Name of the score to which a record belongs: its group's, or its own."""
        for name, records in self.groups.items():
            if record.name in records:
                return name
        return record.name

    def __repr__(self) -> str:
        uses = ("train", "validation", "selection", "tests", "leaderboard")
        given = {use: records for use in uses if (records := getattr(self, use))}
        lines = [f"Dataset {self.name!r}"]
        if given:
            first = next(iter(given.values()))[0]
            lines[0] += f": {signals(first)} at {first.fs:g} Hz"
        for use, records in given.items():
            listed = [
                f"{r.name} ({r.samples}, {r.start}{f', skip {r.skip}' if r.skip else ''})"
                for r in records[:LISTED]
            ]
            more = [f"{len(records) - LISTED} more"] if len(records) > LISTED else []
            total = sum(record.samples for record in records)
            lines.append(f"  {use:11} {total} samples: {', '.join([*listed, *more])}")
        return "\n".join(lines)
