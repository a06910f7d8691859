"""Runs side by side: a table, and a page with their errors against size, seed and time."""

from __future__ import annotations

import csv
import io
import json
import math
import os
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
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
from lfrtorch.reporting.several_models import COLOURS, short, side_by_side
from lfrtorch.score_window import with_window

SEEDS = ("seed", "data.seed")
"""Words that differ between repetitions of one setting."""

SHOWN = 20
"""Most runs that a terminal gets; the files have all."""

BOXES = 30
"""Most settings whose boxes are drawn, the best by their median."""

WIDE = 50
"""Ratio of the values of a word from which on their axis is logarithmic."""

CAPTIONS = {
    "parameters": "Validation error by parameters",
    "time": "Validation error by time",
    "seeds": "Validation error over seeds",
    "words": "Validation error by words",
    "simulations": "Best models on one record: about the largest error, and spectra of the errors",
}
"""Of the figures."""

LEGEND = "*: no run with as few parameters has a smaller validation error."


@dataclass(frozen=True, kw_only=True)
class Compared:
    """A run in numbers.

    Args:
        folder: of its files.
        dataset: name of what was identified.
        words: of its command line, by name.
        parameters: that the data can tell apart.
        error: RMSE on the validation records, nan if there are none.
        tests: RMSE of each test.
        linear, linear_nx: error there and order of the linear model, if that is known.
        unit: of the errors, empty if they have several.
        seconds: that the fit took.
        outcome: how it ended.
    """

    folder: Path
    dataset: str
    words: Mapping[str, str]
    parameters: int
    error: float
    tests: Mapping[str, float]
    linear: float
    linear_nx: int | None
    unit: str
    seconds: float
    outcome: str


@dataclass(frozen=True)
class Comparison:
    """Runs of the same data, the best on validation first.

    Args:
        name: of the data.
        runs: at least one.
    """

    name: str
    runs: Sequence[Compared]

    @cached_property
    def varied(self) -> list[str]:
        """Names of the words that are not the same in all runs, seeds last."""
        listed = [run.words for run in self.runs if run.words]  # none of Python's own runs
        names = dict.fromkeys(name for words in listed for name in words)
        found = [n for n in names if len({words.get(n) for words in listed}) > 1]
        return sorted(found, key=SEEDS.__contains__)

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
        """The runs that differ in seeds alone, by their other words, the best median first.

        Empty if no setting has several runs.
        """
        groups: dict[str, list[Compared]] = {}
        for run in self.runs:
            words = [f"{n}={run.words[n]}" for n in self.varied if n in run.words]
            label = " ".join(word for word in words if word.partition("=")[0] not in SEEDS)
            groups.setdefault(label or "all runs", []).append(run)
        if len(groups) == len(self.runs):
            return {}
        medians = {label: _quartiles(runs)[1] for label, runs in groups.items()}
        return {label: groups[label] for label in sorted(groups, key=medians.__getitem__)}

    def rows(self) -> tuple[list[str], list[list[Cell]]]:
        """Head and rows of the table of runs."""
        tests = list(dict.fromkeys(name for run in self.runs for name in run.tests))
        factor, unit = self._scale
        shown = f" ({unit})" if unit else ""
        head = ["run", "", "parameters", f"validation{shown}"]
        head += [f"{name}{shown}" for name in tests] + ["time (s)", "outcome"]
        rows: list[list[Cell]] = [
            [
                self._name(run),
                "*" if run in self.front else "",
                run.parameters,
                times(factor, run.error),
                *(times(factor, run.tests.get(name)) for name in tests),
                run.seconds,
                run.outcome,
            ]
            for run in self.runs
        ]
        return head, rows

    def summary(self) -> tuple[list[str], list[list[Cell]]]:
        """Head and rows of the table of settings: quartiles of their validation errors."""
        factor, unit = self._scale
        head = ["setting", "runs", "parameters", f"best{f' ({unit})' if unit else ''}"]
        head += ["lower quartile", "median", "upper quartile", "time (s)"]
        rows: list[list[Cell]] = [
            [
                label,
                len(runs),
                runs[0].parameters,
                times(factor, runs[0].error),
                *(times(factor, value) for value in _quartiles(runs)),
                float(np.median([run.seconds for run in runs])),
            ]
            for label, runs in self.settings.items()
        ]
        return head, rows

    def simulations(self, record: Record) -> Figure | None:
        """A record, simulated by the best runs, one of each setting; None if no model fits to it.

        Args:
            record: of the same channels as the models; others are left out.
        """
        record = with_window(record)
        best = {label: runs[0] for label, runs in self.settings.items()}
        best = best or {self._name(run): run for run in self.runs}
        found: dict[str, Array] = {}
        linear: dict[str, Array] = {}
        for label, run in sorted(best.items(), key=lambda one: _worst_last(one[1].error)):
            if len(found) == len(COLOURS):
                break
            try:
                model = load(run.folder)
                check_channels(model, record)
                found[label] = model.simulate(record)
                if not linear and (run.folder / "linear").is_dir():
                    bla = LinearModel.load(run.folder)
                    linear[f"linear (nx {bla.nx})"] = bla.simulate(record)
            except (InputError, OSError, IndexError):
                continue
        return side_by_side(record, found, linear) if found else None

    def figures(self, record: Record | None = None) -> dict[str, Figure]:
        """Errors against parameters and time, and boxes of each setting, by name.

        Args:
            record: that the best models simulate. Default: none.
        """
        drawn = {"parameters": self._against("parameters", "parameters", front=True)}
        drawn["time"] = self._against("seconds", "time of the fit (s)")
        if self.settings:
            drawn["seeds"] = self._boxes()
        numbers = {name: found for name in self.varied if (found := self._numbers(name))}
        if numbers:
            drawn["words"] = self._over(numbers)
        if record is not None and (figure := self.simulations(record)):
            drawn["simulations"] = figure
        return drawn

    def __str__(self) -> str:
        head, rows = self.rows()
        parts = [f"{self.name}: RMSE of {len(rows)} run{'s' * (len(rows) > 1)}"]
        if self.settings:
            parts.append(table(*self.summary()))
        parts.append(table(head, rows[:SHOWN]))
        more = len(rows) - SHOWN
        parts.append(LEGEND + f" {more} more runs are in the files." * (more > 0))
        return "\n\n".join(parts)

    @cached_property
    def _root(self) -> Path:
        return Path(os.path.commonpath([run.folder.parent for run in self.runs]))

    def _name(self, run: Compared) -> str:
        """The folder of a run below the one that all are in."""
        return str(run.folder.relative_to(self._root))

    @property
    def _scale(self) -> tuple[float, str]:
        units = {run.unit for run in self.runs}
        return engineering([run.error for run in self.runs], units.pop() if len(units) == 1 else "")

    def _against(self, field: str, label: str, *, front: bool = False) -> Figure:
        factor, unit = self._scale
        figure = Figure(figsize=(7, 4), layout="constrained")
        ax = figure.subplots()
        values = [getattr(run, field) for run in self.runs]
        ax.set(yscale="log", xscale="linear" if front else "log")
        ax.plot(values, [factor * run.error for run in self.runs], ".", color=NL_LFR, alpha=0.6)
        if front:
            at = [run.parameters for run in self.front], [factor * r.error for r in self.front]
            ax.step(*at, where="post", color=OUTPUT, lw=1, label="fewest parameters for the error")
            ax.legend()
        ax.set_xlabel(label)
        if not front:
            plain_ticks(ax.xaxis)
        _error_axis(ax.yaxis, unit)
        return figure

    def _boxes(self) -> Figure:
        factor, unit = self._scale
        labels = list(self.settings)[:BOXES]
        errors = [
            [factor * run.error for run in self.settings[label] if math.isfinite(run.error)]
            for label in labels
        ]
        figure = Figure(figsize=(7, 1 + 0.3 * len(labels)), layout="constrained")
        ax = figure.subplots()
        ax.boxplot(errors, tick_labels=[*map(short, labels)], orientation="horizontal", sym=".")
        ax.invert_yaxis()  # the best one above
        ax.set_xscale("log")
        _error_axis(ax.xaxis, unit)
        return figure

    def _numbers(self, name: str) -> list[float]:
        """The values of a word, none if they are not all numbers or are two alone."""
        try:
            found = [float(run.words.get(name, "")) for run in self.runs]
        except ValueError:
            return []
        return found if len(set(found)) > 2 else []

    def _over(self, numbers: Mapping[str, Sequence[float]]) -> Figure:
        """The errors against the value of each word."""
        factor, unit = self._scale
        figure = Figure(figsize=(7, 2.2 * -(-len(numbers) // 2)), layout="constrained")
        grid = figure.subplots(-(-len(numbers) // 2), 2, sharey=True, squeeze=False)
        for ax in grid.flat[len(numbers) :]:
            ax.remove()
        for ax, (name, values) in zip(grid.flat, numbers.items(), strict=False):
            wide = min(values) > 0 and max(values) > WIDE * min(values)
            ax.set(xlabel=name, xscale="log" if wide else "linear", yscale="log")
            ax.plot(values, [factor * run.error for run in self.runs], ".", color=NL_LFR, alpha=0.6)
            _error_axis(ax.yaxis, unit)
        return figure


def compare(folders: Sequence[str | Path]) -> list[Comparison]:
    """The whole runs in folders, and in all folders below them, by their data.

    Args:
        folders: of runs, or with runs in them.

    Raises:
        InputError: there is none.

    Example:
        >>> from lfrtorch.reporting.comparison import compare
        >>> dataset = lfrtorch.Dataset("mine", train=[record], validation=[], tests=[record[200:]])
        >>> trainer = lfrtorch.LevenbergMarquardt(max_iter=1)
        >>> run = lfrtorch.identify(dataset, lfrtorch.Settings(nx=1, nz=1, nn=4, trainer=trainer))
        >>> for seed in (0, 1):
        ...     words = f"lfrtorch fit nn=4 seed={seed}"
        ...     lfrtorch.reporting.write(run, f"seed {seed}", command=words, draw=False)
        >>> (found,) = compare(["seed 0", "seed 1"])
        >>> found.varied, len(found.runs), list(found.settings)
        (['seed'], 2, ['all runs'])
    """
    files = dict.fromkeys(
        path.resolve() for folder in folders for path in sorted(Path(folder).rglob("metrics.json"))
    )
    if not files:
        listed = ", ".join(f"'{folder}'" for folder in folders)
        raise InputError(f"no run came to its end in {listed}; give folders with metrics.json.")
    groups: dict[str, list[Compared]] = {}
    for path in files:
        run = _read(path)
        groups.setdefault(run.dataset, []).append(run)
    return [
        Comparison(name, sorted(runs, key=lambda run: _worst_last(run.error)))
        for name, runs in groups.items()
    ]


def write(
    comparisons: Sequence[Comparison],
    folder: str | Path,
    records: Mapping[str, Record | None] | None = None,
) -> None:
    """Write ``comparison.html``, ``comparison.md`` and ``comparison.csv`` with all runs.

    Args:
        comparisons: see :func:`compare`.
        folder: of the files; those of an earlier comparison are replaced.
        records: that the page shows, simulated by the best models, by the names of the data.
            Default: none.

    Example:
        >>> from lfrtorch.reporting import comparison
        >>> dataset = lfrtorch.Dataset("mine", train=[record], validation=[], tests=[record[200:]])
        >>> trainer = lfrtorch.LevenbergMarquardt(max_iter=1)
        >>> run = lfrtorch.identify(dataset, lfrtorch.Settings(nx=1, nz=1, nn=4, trainer=trainer))
        >>> lfrtorch.reporting.write(run, "study/one", draw=False)
        >>> comparison.write(comparison.compare(["study"]), "study", {"mine": record[200:]})
    """
    images, parts, records = {}, [], records or {}
    for number, one in enumerate(comparisons):
        figures = one.figures(records.get(one.name))
        drawn = {f"{number}_{name}": plots.png(figure) for name, figure in figures.items()}
        images |= drawn
        parts.append(
            {
                "name": one.name,
                "runs": one.rows(),
                "settings": one.summary() if one.settings else None,
                "figures": [(name, CAPTIONS[name.partition("_")[2]]) for name in drawn],
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
            parameters=found["parameters_net"],
            error=_float(judged["rmse"]),
            tests={name: _float(score["rmse"]) for name, score in found["scores"].items()},
            linear=_float(judged["lti_rmse"]),
            linear_nx=found.get("lti_nx"),
            unit=unit_of(found),
            seconds=_float(found["fit"]["seconds"]),
            outcome=found["fit"]["reason"],
        )
        numbers = (run.parameters, run.error, run.linear, run.seconds, *run.tests.values())
        numbers += (run.linear_nx or 0,)
        texts = (run.dataset, run.unit, run.outcome)
        if not all(isinstance(number, int | float) for number in numbers):
            raise TypeError("a number is none")
        if not all(isinstance(text, str) for text in texts):
            raise TypeError("a text is none")
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
    return math.nan if value is None else value


def _quartiles(runs: Sequence[Compared]) -> list[float]:
    """Of the validation errors; runs that diverged are the worst."""
    errors = sorted(run.error if math.isfinite(run.error) else math.inf for run in runs)
    return [float(np.quantile(errors, q, method="inverted_cdf")) for q in (0.25, 0.5, 0.75)]


def _error_axis(axis: Axis, unit: str) -> None:
    axis.set_label_text(f"validation RMSE{f' ({unit})' if unit else ''}")
    plain_ticks(axis)
    axis.grid(True, which="both", alpha=0.2)


def _markdown(head: Sequence[str], rows: Sequence[Sequence[Cell]]) -> str:
    lines = [head, ["---"] * len(head), *([cell(value) for value in row] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def _csv(comparisons: Sequence[Comparison]) -> str:
    """All runs with the words that differ, errors in the units of their records."""
    names = list(dict.fromkeys(name for one in comparisons for name in one.varied))
    tests = list(dict.fromkeys(n for one in comparisons for run in one.runs for n in run.tests))
    stream = io.StringIO()
    file = csv.writer(stream, lineterminator="\n")
    fields = ["parameters", "error", "linear", "linear_nx", "unit", "seconds", "outcome"]
    file.writerow(["folder", "dataset", *names, *fields, *(f"test {name}" for name in tests)])
    for one in comparisons:
        for run in one.runs:
            own: list[Any] = [run.words.get(name, "") for name in names]
            own += [getattr(run, field) for field in fields]
            file.writerow([run.folder, run.dataset, *own, *(run.tests.get(n, "") for n in tests)])
    return stream.getvalue()
