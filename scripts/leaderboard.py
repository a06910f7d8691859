"""What nonlinearbenchmark.org asks for: the RMSE of a model as the benchmarks' package has it.

The site's templates score ``y[n:]`` of test records cut by the package nonlinear_benchmarks, with a
model that sees the inputs and ``y[:n]`` of those records alone. So the records of
``Dataset.leaderboard`` have an estimated start and ``skip`` n, and nothing before them is used.
Starts at rest and periodic ones, of records that begin so, use no output at all. Cut and window may
differ from those of the usual tables (see the datasets).
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, fields

import numpy as np

from lfrtorch.data.metrics import rmse_by_output
from lfrtorch.data.records import Record
from lfrtorch.model.model import Model

UNITS = {"V": ("mV", 1e3), "m": ("mm", 1e3)}
"""Units of the site by those of the records, if they differ."""

OWN_UNITS = {"cascaded_tanks": ("V", 1.0), "fine_steering_mirror": ("µm", 1e6)}
"""Units of the site of single benchmarks."""


@dataclass(frozen=True)
class Entry:
    """A line of the file; ``rmse_to_submit`` is written as the site's templates print it."""

    benchmark: str
    rmse_to_submit: str
    unit: str
    records: str
    samples_for_the_start: str
    model_class: str
    parameters: int
    seconds: str
    command: str


def entry(
    benchmark: str,
    model: Model,
    records: Sequence[Record],
    *,
    groups: Mapping[str, Sequence[str]] | None = None,
    seconds: float,
    command: str,
) -> Entry:
    """The line of a model.

    Args:
        benchmark: its name.
        model: what is submitted.
        records: as the package cuts them, ``skip`` the samples that the start may be fitted to.
        groups: names of the records that make one number together, the mean of their errors.
        seconds: of all the training.
        command: that made the model.
    """
    unit = records[0].outputs[0].unit
    shown, scale = OWN_UNITS.get(benchmark, UNITS.get(unit, (unit, 1.0)))
    of = {name: [r for r in records if r.name in names] for name, names in (groups or {}).items()}
    grouped = {name: found for name, found in of.items() if found}
    scored = grouped or {record.name: [record] for record in records}
    found = {name: [errors_of(model, r) for r in group] for name, group in scored.items()}
    errors = [e for each in found.values() for e in ([np.mean(each)] if grouped else each[0])]
    listed = "; ".join(f"{scale * error:.3g}" for error in errors)
    sizes = ", ".join(f"{name} {size}" for name, size in model.sizes.items() if size)
    return Entry(
        benchmark,
        f"[{listed}]" if len(errors) > 1 else listed,
        shown,
        "; ".join(scored),
        "; ".join(str(group[0].skip) for group in scored.values()),
        f"NL-LFR state space ({sizes}), from the best linear approximation",
        model.parameter_count,
        f"{seconds:.0f}",
        command,
    )


def errors_of(model: Model, record: Record) -> list[float]:
    """RMSE of each output after the samples that are skipped; those of weight 0 are left out."""
    counts = np.broadcast_to(np.asarray(record.weight) > 0, len(record.outputs))
    return rmse_by_output(record, model.simulate(record))[counts].tolist()


def table(entries: Sequence[Entry]) -> str:
    """The lines as CSV with a header."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(field.name for field in fields(Entry))
    writer.writerows(astuple(line) for line in entries)
    return text.getvalue()
