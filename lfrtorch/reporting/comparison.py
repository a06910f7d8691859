"""Runs side by side: a table, and a page with their errors against size and over seeds."""

from __future__ import annotations

import json
import math
import os
import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import pandas as pd
from matplotlib.axis import Axis
from matplotlib.figure import Figure

from lfrtorch._support.atomic import whole_file
from lfrtorch._support.drawing import NL_LFR, OUTPUT, plain_ticks
from lfrtorch._support.errors import InputError, brief
from lfrtorch._support.tables import Cell, engineering, table, times
from lfrtorch._support.types import Array
from lfrtorch.linear.model import LinearModel
from lfrtorch.model import check_channels, load
from lfrtorch.records import Record
from lfrtorch.reporting import html, plots
from lfrtorch.reporting.scores import unit_of
from lfrtorch.score_window import with_window

_SEEDS = ("seed", "data.seed")  # words that differ between repetitions of one setting

_CAPTIONS = {
    "parameters": "Validation error by parameters",
    "seeds": "Validation error over seeds",
    "close_up": "Best models on one record, about the largest error of the best one",
    "density": "Spectra of their errors",
}

_LEGEND = (
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
    linear_tests: Mapping[str, float]  # RMSE of the linear model on each test
    unit: str  # of the errors, empty if they have several
    seconds: float  # that the fit took
    outcome: str

    @property
    def badness(self) -> float:
        """What runs are sorted by: the error, infinite of those that diverged."""
        return self.error if math.isfinite(self.error) else math.inf


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

    def rows(self, *, whole: bool = False) -> tuple[list[str], list[list[Cell]]]:
        """Head and rows of the table; the whole one has words too, and no prefixes of units."""
        tests = dict.fromkeys(name for run in self.runs for name in run.tests)
        medians = {run.folder: _median(runs) for runs in self.settings.values() for run in runs}
        factor, unit = (1.0, "") if whole else self._scale
        columns: dict[str, Callable[[Compared], Cell]] = {"run": self._name}
        if whole:
            columns |= {"dataset": lambda _: self.name, "unit": lambda run: run.unit}
            columns |= {n: lambda run, n=n: run.words.get(n, "") for n in self.varied}
        columns["front" if whole else ""] = lambda run: "*" if run in self.front else ""
        columns["parameters"] = lambda run: run.parameters
        columns[f"validation{unit}"] = lambda run: factor * run.error
        if medians:
            columns["median"] = lambda run: times(factor, medians.get(run.folder))
        for name in tests:
            columns[f"{name}{unit}"] = lambda run, name=name: times(factor, run.tests.get(name))
        if whole:
            columns |= {"linear": lambda run: run.linear, "linear nx": lambda run: run.linear_nx}
        columns |= {"time (s)": lambda run: run.seconds, "outcome": lambda run: run.outcome}
        rows = [[cell(run) for cell in columns.values()] for run in self.runs]
        return list(columns), rows if whole else [*rows, *self._linear_row(list(columns), tests)]

    def _linear_row(self, head: Sequence[str], tests: Iterable[str]) -> list[list[Cell]]:
        """The errors of the best linear model among the runs, if there is one."""
        linear = [run for run in self.runs if math.isfinite(run.linear)]
        if not linear:
            return []
        best = min(linear, key=lambda run: run.linear)
        factor, unit = self._scale
        named = "" if best.linear_nx is None else f" (nx {best.linear_nx})"
        known: dict[str, Cell] = {
            "run": f"linear{named}",
            f"validation{unit}": factor * best.linear,
        }
        known |= {f"{name}{unit}": times(factor, best.linear_tests.get(name)) for name in tests}
        return [[known.get(column) for column in head]]

    def simulations(self, record: Record) -> dict[str, Array]:
        """Simulations of a record by the best runs, one of each setting, and by a linear model."""
        best = {label: runs[0] for label, runs in self.settings.items()}
        best = best or {self._name(run): run for run in self.runs}
        found: dict[str, Array] = {}
        linear: dict[str, Array] = {}
        for label, run in sorted(best.items(), key=lambda one: one[1].badness):
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
        drawn = {"parameters": self._by_parameters()} if len(self.runs) > 1 else {}
        if self.settings and self.front:  # boxes need finite errors
            drawn["seeds"] = self._boxes()
        simulated = {} if record is None else self.simulations(record := with_window(record))
        if record is not None and simulated:
            for view in (plots.close_up, plots.density):
                drawn[view.__name__] = view(record, simulated)
        return drawn

    def __str__(self) -> str:
        head, rows = self.rows()
        count = len(self.runs)
        parts = [f"{self.name}: RMSE of {count} run{'s' * (count > 1)}"]
        parts.append(table(head, [*rows[: min(20, count)], *rows[count:]]))
        more = count - 20
        parts.append(_LEGEND + f" {more} more runs are in the files." * (more > 0))
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
        ax.plot(*points, ".", color=NL_LFR, alpha=0.6, label="runs")
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
    for run in sorted(map(_read, files), key=lambda run: run.badness):
        groups.setdefault(run.dataset, []).append(run)
    return [Comparison(name, runs) for name, runs in groups.items()]


def write(
    comparisons: Sequence[Comparison],
    folder: str | Path,
    records: Mapping[str, Record | None] | None = None,
) -> None:
    """Write ``comparison.html``, ``.md`` and ``.csv``; records are named as the data."""
    images, parts, markdown, frames = {}, [], [], []
    for number, one in enumerate(comparisons):
        figures = one.figures((records or {}).get(one.name))
        images |= {f"{number}_{name}": plots.png(figure) for name, figure in figures.items()}
        captions = [(f"{number}_{name}", _CAPTIONS[name]) for name in figures]
        parts.append({"name": one.name, "runs": one.rows(), "figures": captions})
        markdown.append(f"## {one.name}\n\n{table(*one.rows(), layout='github')}\n")
        head, rows = one.rows(whole=True)
        frames.append(pd.DataFrame(rows, columns=pd.Index(head)))
    texts = {
        "html": html.page("comparison.html", images, parts=parts, legend=_LEGEND),
        "md": "\n\n".join(markdown),
        "csv": pd.concat(frames).to_csv(index=False, lineterminator="\n"),
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
            linear_tests={n: _float(score.get("lti_rmse")) for n, score in found["scores"].items()},
            unit=unit_of(found),
            seconds=_float(found["fit"]["seconds"]),
            outcome="kept the start: " * (found.get("chosen_iteration") == 0)
            + found["fit"]["reason"],
        )
        "".join([run.dataset, run.unit, run.outcome])  # a TypeError if one is no text
    except (OSError, LookupError, AttributeError, TypeError, ValueError, RecursionError) as error:
        raise InputError(
            f"'{path}' is not of a run ({type(error).__name__}: {brief(error)}); leave its folder "
            "out, or move it away."
        ) from None
    return run


def _float(value: float | None) -> float:
    return math.nan if value is None else 1.0 * value


def _median(runs: Sequence[Compared]) -> float:
    """Of the validation errors; runs that diverged are the worst."""
    errors = sorted(run.badness for run in runs)
    return errors[(len(errors) - 1) // 2]


def _short(label: str) -> str:
    """Beginning and end of a setting, for a figure."""
    return label if len(label) <= 40 else f"{label[:20]}…{label[-20:]}"
