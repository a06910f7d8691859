"""Scores of a run: one entry a test record, as a table for people and as JSON for programs."""

from __future__ import annotations

import math
import platform
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from typing import Any

from lfrtorch.datasets import Dataset, Published
from lfrtorch.linear_model import LinearModel
from lfrtorch.metrics import nrmse, rmse
from lfrtorch.model import Model
from lfrtorch.records import Record
from lfrtorch.trainer import FitResult


@dataclass(frozen=True)
class Score:
    """Simulation errors on one record, after its skip window.

    Args:
        rmse, lti_rmse: of the model and of the linear model, in ``unit``.
        nrmse: rmse over the standard deviation of the measured output.
        unit: of the outputs.
        source: ``"official"``, ``"simulated"``, ``"stand-in"`` or ``"file"``.
        samples, skip: length of the record, and how many at its beginning do not count.
    """

    rmse: float
    lti_rmse: float
    nrmse: float
    unit: str
    source: str
    samples: int
    skip: int


def score(model: Model, bla: LinearModel, record: Record) -> Score:
    """Scores of the model and of the linear model on one record."""
    y_hat = model.simulate(record)
    return Score(
        rmse=rmse(record, y_hat),
        lti_rmse=rmse(record, bla.simulate(record)),
        nrmse=nrmse(record, y_hat),
        unit=", ".join(dict.fromkeys(c.unit for c in record.outputs)),
        source=record.source,
        samples=record.samples,
        skip=record.skip,
    )


def metrics(
    result: FitResult, bla: LinearModel, dataset: Dataset, *, seed: int | None, command: str
) -> dict:
    """What ``metrics.json`` holds, scores by test record; None where a number is not finite."""
    model = result.model
    validation = [score(model, bla, record) for record in dataset.validation]
    entries = {
        "bench": dataset.name,
        "sizes": model.sizes,
        "parameters": model.parameters,
        "parameters_net": model.parameters_net,
        "data": {
            "samples": sum(record.samples for record in dataset.train),
            "noise_rms": dataset.noise_rms,
            "seed": seed,
            "notes": list(dataset.notes),
        },
        "fit": {
            "iterations": result.iterations,
            "seconds": result.seconds,
            "seconds_per_iteration": result.seconds_per_iteration,
            "reason": result.reason,
        },
        "validation": {
            "rmse": _pooled([s.rmse for s in validation], validation),
            "lti_rmse": _pooled([s.lti_rmse for s in validation], validation),
        },
        "chosen_iteration": result.chosen_iteration,
        "starts": 1,
        "command": command,
        "scores": {record.name: asdict(score(model, bla, record)) for record in dataset.tests},
        "versions": {
            "python": platform.python_version(),
            **{name: version(name) for name in ("lfrtorch", "torch", "numpy", "scipy", "numba")},
        },
    }
    return _finite(entries)


def table(result: dict, published: Sequence[Published]) -> str:
    """The benchmark's table: our linear model and NL-LFR beside the published ones, in one unit."""
    sizes = result["sizes"]
    mine = (sizes["nz"], sizes["nw"])
    others = [p for p in published if p.sizes in (None, mine)]
    head = ["record", "source", "samples", "skip", "LTI", "NL-LFR", *(p.label for p in others)]
    rows = [
        [name, s["source"], str(s["samples"]), str(s["skip"])]
        + [_number(s["lti_rmse"]), _number(s["rmse"])]
        + [_number(p.scores.get(name)) for p in others]
        for name, s in result["scores"].items()
    ]
    v = result["validation"]
    if v["rmse"] is not None or v["lti_rmse"] is not None:
        chosen = ["validation", "not fitted", "", "", _number(v["lti_rmse"]), _number(v["rmse"])]
        rows.append(chosen + [_number(None)] * len(others))
    widths = [max(len(row[i]) for row in [head, *rows]) for i in range(len(head))]

    def line(row: list[str]) -> str:
        cells = [
            cell.ljust(w) if i < 2 else cell.rjust(w)
            for i, (cell, w) in enumerate(zip(row, widths, strict=True))
        ]
        return "  ".join(cells)

    units = {s["unit"] for s in result["scores"].values()} - {""}
    title = f"Simulation RMSE{f' ({next(iter(units))})' if len(units) == 1 else ''}"
    static = f"degree {sizes['degree']}" if "degree" in sizes else f"{sizes['nn']} neurons"
    title += f", nx {sizes['nx']}, nz {sizes['nz']}, nw {sizes['nw']}, {static}"
    references = [f"{p.label}: {p.reference}" for p in others]
    rule = "-" * (sum(widths) + 2 * (len(widths) - 1))
    return "\n".join([title, rule, line(head), rule, *map(line, rows), rule, *references])


def _pooled(values: list[float], scores: list[Score]) -> float | None:
    """RMSE over several records, each with the weight of its scored samples."""
    if not scores:
        return None
    counts = [s.samples - s.skip for s in scores]
    squares = sum(n * v**2 for n, v in zip(counts, values, strict=True))
    return (squares / sum(counts)) ** 0.5


def _finite(entry: Any) -> Any:
    """The same nested entries with None for every number that JSON cannot hold."""
    if isinstance(entry, dict):
        return {key: _finite(value) for key, value in entry.items()}
    return None if isinstance(entry, float) and not math.isfinite(entry) else entry


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}" if 1e-3 <= abs(value) < 1e4 else f"{value:.2e}"
