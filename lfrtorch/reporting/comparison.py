"""Runs side by side: a table, and a page with their errors against size and over seeds."""

from __future__ import annotations

import json
import math
import os
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import pandas as pd
from matplotlib.axis import Axis
from matplotlib.figure import Figure

from lfrtorch._support.atomic import whole_file
from lfrtorch._support.drawing import NL_LFR, OUTPUT, plain_ticks
from lfrtorch._support.errors import InputError, brief
from lfrtorch._support.tables import Cell, cell, engineering, table, times
from lfrtorch._support.types import Array
from lfrtorch.linear.model import LinearModel
from lfrtorch.model import check_channels, load
from lfrtorch.records import Record
from lfrtorch.reporting import html, plots
from lfrtorch.reporting.scores import unit_of
from lfrtorch.score_window import with_window

_SEEDS = ("seed", "data.seed")  # words that differ between repetitions of one setting
_SHOWN = 20  # most runs that a terminal gets; the files have all
_LONGEST = 40  # characters of a setting in a figure

CAPTIONS = {
    "parameters": "Validation error by parameters",
    "seeds": "Validation error over seeds",
    "close_up": "Best models on one record, about the largest error of the best one",
    "density": "Spectra of their errors",
}
"""Of the figures."""

LEGEND = (
    "*: no run with as few parameters has a smaller validation error. Median: over the seeds of a "
    "setting; runs that diverge are the worst."
)


@dataclass(frozen=True, kw_only=True)
class Compared:
    """A run in numbers."""

    folder: Path
    dataset: str
    words: Mapping[str, str]  # of its command line, by name
    parameters: int  # that the data can tell apart
    error: float  # RMSE on the validation records, nan if there are none
    tests: Mapping[str, float]  # RMSE of each test
    linear: float  # error there of the linear model
    linear_nx: int | None
    unit: str  # of the errors, empty if they have several
    seconds: float  # that the fit took
    outcome: str


@dataclass(frozen=True)
class Comparison:
    """Runs of the same data, one at least, the best on validation first."""

    name: str
    runs: Sequence[Compared]

    @cached_property
    def varied(self) -> list[str]:
        """Names of the words that are not the same in all runs, seeds last."""
        listed = [run.words for run in self.runs if run.words]  # none of Python's own runs
        names = dict.fromkeys(name for words in listed for name in words)
        found = [n for n in names if len({words.get(n) for words in listed}) > 1]
        return sorted(found, key=_SEEDS.__contains__)

    @cached_property
    def front(self) -> list[Compared]:
        """The runs with the least error of all with as few parameters, by their parameters."""
        found: list[Compared] = []
        for run in sorted(self.runs, key=lambda run: (run.parameters, run.error)):
            if math.isfinite(run.error) and (not found or run.error < found[-1].error):
                found.append(run)
        return found

    @cached_property
    def settings(self) -> dict[str, list[Compared]]:
        """The runs that differ in seeds alone, by their other words; empty if none has several."""
        groups: dict[str, list[Compared]] = {}
        for run in self.runs:
            words = [f"{n}={run.words[n]}" for n in self.varied if n in run.words]
            label = " ".join(word for word in words if word.partition("=")[0] not in _SEEDS)
            groups.setdefault(label or "all runs", []).append(run)
        if len(groups) == len(self.runs):
            return {}
        return dict(sorted(groups.items(), key=lambda one: _median(one[1])))

    def rows(self) -> tuple[list[str], list[list[Cell]]]:
        """Head and rows of the table; the median is that of a setting over its seeds."""
        tests = list(dict.fromkeys(name for run in self.runs for name in run.tests))
        medians = {run.folder: _median(runs) for runs in self.settings.values() for run in runs}
        factor, unit = self._scale
        head = ["run", "", "parameters", f"validation{unit}", *["median"] * bool(medians)]
        rows: list[list[Cell]] = []
        for run in self.runs:
            errors = [run.error, *[medians.get(run.folder)] * bool(medians)]
            errors += [run.tests.get(name) for name in tests]
            front = "*" if run in self.front else ""
            shown = (times(factor, error) for error in errors)
            rows.append([self._name(run), front, run.parameters, *shown, run.seconds, run.outcome])
        return [*head, *(f"{name}{unit}" for name in tests), "time (s)", "outcome"], rows

    def simulations(self, record: Record) -> dict[str, Array]:
        """Simulations of a record by the best runs, one of each setting, and by a linear model."""
        best = {label: runs[0] for label, runs in self.settings.items()}
        best = best or {self._name(run): run for run in self.runs}
        found: dict[str, Array] = {}
        linear: dict[str, Array] = {}
        for label, run in sorted(best.items(), key=lambda one: _worst_last(one[1].error)):
            if len(found) == len(plots.COLOURS):
                break
            shown = _short(label)
            shown += f" ({len(found) + 1})" * (shown in found)
            try:
                model = load(run.folder)
                check_channels(model, record)
                found[shown] = model.simulate(record)
                if not linear and (run.folder / "linear").is_dir():
                    bla = LinearModel.load(run.folder)
                    linear[f"linear (nx {bla.nx})"] = bla.simulate(record)
            except (InputError, OSError, IndexError):
                continue
        return linear | found if found else {}

    def figures(self, record: Record | None = None) -> dict[str, Figure]:
        """Errors against parameters, boxes of each setting, simulations of a record, by name."""
        drawn = {"parameters": self._by_parameters()}
        if self.settings and self.front:  # boxes need finite errors
            drawn["seeds"] = self._boxes()
        simulated = {} if record is None else self.simulations(record := with_window(record))
        if record is not None and simulated:
            for view in (plots.close_up, plots.density):
                drawn[view.__name__] = view(record, simulated)
        return drawn

    def __str__(self) -> str:
        head, rows = self.rows()
        parts = [f"{self.name}: RMSE of {len(rows)} run{'s' * (len(rows) > 1)}"]
        parts.append(table(head, rows[:_SHOWN]))
        more = len(rows) - _SHOWN
        parts.append(LEGEND + f" {more} more runs are in the files." * (more > 0))
        return "\n\n".join(parts)

    def _name(self, run: Compared) -> str:
        """The folder of a run below the one that all are in."""
        root = os.path.commonpath([run.folder.parent for run in self.runs])
        return str(run.folder.relative_to(root))

    @property
    def _scale(self) -> tuple[float, str]:
        """Factor of the errors, and their unit in brackets."""
        units = {run.unit for run in self.runs}
        unit = units.pop() if len(units) == 1 else ""
        factor, unit = engineering([run.error for run in self.runs], unit)
        return factor, f" ({unit})" if unit else ""

    def _by_parameters(self) -> Figure:
        factor, _ = self._scale
        figure = Figure(figsize=(7, 4), layout="constrained")
        ax = figure.subplots()
        ax.set(yscale="log", xlabel="parameters")
        points, front = (
            ([run.parameters for run in runs], [factor * run.error for run in runs])
            for runs in (self.runs, self.front)
        )
        ax.plot(*points, ".", color=NL_LFR, alpha=0.6)
        ax.step(*front, where="post", color=OUTPUT, lw=1, label="fewest parameters for the error")
        ax.legend()
        self._label(ax.yaxis)
        return figure

    def _boxes(self) -> Figure:
        factor, _ = self._scale
        # The best by their median.
        labels = list(self.settings)[:30]
        errors = [
            [factor * run.error for run in self.settings[label] if math.isfinite(run.error)]
            for label in labels
        ]
        figure = Figure(figsize=(7, 1 + 0.3 * len(labels)), layout="constrained")
        ax = figure.subplots()
        ax.boxplot(errors, tick_labels=[*map(_short, labels)], orientation="horizontal", sym=".")
        ax.invert_yaxis()  # the best one above
        ax.set_xscale("log")
        self._label(ax.xaxis)
        return figure

    def _label(self, axis: Axis) -> None:
        axis.set_label_text(f"validation RMSE{self._scale[1]}")
        plain_ticks(axis)
        axis.grid(True, which="both", alpha=0.2)


def compare(folders: Sequence[str | Path]) -> list[Comparison]:
    """Read the whole runs in folders, and in all folders below them, by their data."""
    files = dict.fromkeys(
        path.resolve() for folder in folders for path in sorted(Path(folder).rglob("metrics.json"))
    )
    if not files:
        listed = ", ".join(f"'{folder}'" for folder in folders)
        raise InputError(f"no run came to its end in {listed}; give folders with metrics.json.")
    groups: dict[str, list[Compared]] = {}
    for run in sorted(map(_read, files), key=lambda run: _worst_last(run.error)):
        groups.setdefault(run.dataset, []).append(run)
    return [Comparison(name, runs) for name, runs in groups.items()]


def write(
    comparisons: Sequence[Comparison],
    folder: str | Path,
    records: Mapping[str, Record | None] | None = None,
) -> None:
    """Write ``comparison.html``, ``comparison.md`` and ``comparison.csv`` with all runs.

    The page shows simulations of ``records``, which are named as the data.

    Example:
        >>> from lfrtorch.reporting import comparison
        >>> dataset = lfrtorch.Dataset("mine", train=[record], validation=[], tests=[record[200:]])
        >>> trainer = lfrtorch.LevenbergMarquardt(max_iter=1)
        >>> run = lfrtorch.identify(dataset, lfrtorch.Settings(nx=1, nz=1, nn=4, trainer=trainer))
        >>> for seed in (0, 1):
        ...     words = f"lfrtorch fit nn=4 seed={seed}"
        ...     lfrtorch.reporting.write(run, f"study/seed {seed}", command=words, draw=False)
        >>> (found,) = comparison.compare(["study"])
        >>> found.varied, len(found.runs), list(found.settings)
        (['seed'], 2, ['all runs'])
        >>> comparison.write([found], "study", {"mine": record[200:]})
    """
    images, parts, records = {}, [], records or {}
    for number, one in enumerate(comparisons):
        figures = one.figures(records.get(one.name))
        images |= {f"{number}_{name}": plots.png(figure) for name, figure in figures.items()}
        parts.append(
            {
                "name": one.name,
                "runs": one.rows(),
                "figures": [(f"{number}_{name}", CAPTIONS[name]) for name in figures],
            }
        )
    texts = {
        "html": html.page("comparison.html", images, parts=parts, legend=LEGEND),
        "md": "\n\n".join(f"## {one.name}\n\n{_markdown(*one.rows())}" for one in comparisons),
        "csv": _csv(comparisons),
    }
    for ending, text in texts.items():
        with whole_file(Path(folder) / f"comparison.{ending}") as fresh:
            fresh.write_text(text, encoding="utf-8", newline="")


def _read(path: Path) -> Compared:
    """The run with this ``metrics.json``."""
    try:
        if not path.is_file():  # a pipe would be waited for
            raise OSError("no file")
        found = json.loads(path.read_text(encoding="utf-8"))
        words = (word.partition("=") for word in shlex.split(found["command"]) if "=" in word)
        judged = found["validation"]
        run = Compared(
            folder=path.parent,
            dataset=found["bench"],
            words={name.lstrip("+"): value for name, _, value in words},
            parameters=found["parameters_net"] + 0,
            error=_float(judged["rmse"]),
            tests={name: _float(score["rmse"]) for name, score in found["scores"].items()},
            linear=_float(judged["lti_rmse"]),
            linear_nx=found.get("lti_nx"),
            unit=unit_of(found),
            seconds=_float(found["fit"]["seconds"]),
            outcome=found["fit"]["reason"],
        )
        "".join([run.dataset, run.unit, run.outcome])  # a TypeError if one is no text
    except (OSError, LookupError, AttributeError, TypeError, ValueError, RecursionError) as error:
        raise InputError(
            f"'{path}' is not of a run ({type(error).__name__}: {brief(error)}); leave its folder "
            "out, or move it away."
        ) from None
    return run


def _worst_last(error: float) -> tuple[bool, float]:
    """By which runs are sorted; those that diverged are the worst."""
    return math.isnan(error), error


def _float(value: float | None) -> float:
    return math.nan if value is None else 1.0 * value


def _median(runs: Sequence[Compared]) -> float:
    """Of the validation errors; runs that diverged are the worst."""
    errors = sorted(run.error if math.isfinite(run.error) else math.inf for run in runs)
    return errors[(len(errors) - 1) // 2]


def _short(label: str) -> str:
    """Beginning and end of a setting, for a figure."""
    half = _LONGEST // 2
    return label if len(label) <= _LONGEST else f"{label[:half]}…{label[-half:]}"


def _markdown(head: Sequence[str], rows: Sequence[Sequence[Cell]]) -> str:
    lines = [head, ["---"] * len(head), *([cell(value) for value in row] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def _csv(comparisons: Sequence[Comparison]) -> str:
    """All runs with the words that differ, errors in the units of their records."""
    names = list(dict.fromkeys(name for one in comparisons for name in one.varied))
    fields = ["parameters", "error", "linear", "linear_nx", "unit", "seconds", "outcome"]
    rows = [
        {"folder": run.folder, "dataset": run.dataset}
        | {name: run.words.get(name, "") for name in names}
        | {field: getattr(run, field) for field in fields}
        | {f"test {name}": error for name, error in run.tests.items()}
        for one in comparisons
        for run in one.runs
    ]
    return pd.DataFrame(rows).to_csv(index=False, lineterminator="\n")
