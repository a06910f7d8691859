"""What the plain command is worth: are its verdict and its recommended model right on new data?

    python benchmarks/first_try.py --label NAME [--cases planted:0-39 ...] [--root DIR] [--jobs 2]
    python benchmarks/first_try.py --report                # the tables of first_try.md

Each case is a CSV file and the command ``lfrtorch fit x.csv test=0 nx=auto nz=auto nw=auto
nn=auto``, on one thread; new data judge the linear model, the NL-LFR, and which of the two the run
recommends. Cases are ``planted`` systems (see ``planted.py``), ``louder`` ones, whose new data have
three amplitudes, and ``measured`` records: folders of CSV files below DIR, each with three splits.
Those that a label has are not repeated.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from itertools import pairwise
from pathlib import Path
from statistics import median
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import torch
from planted import AMPLITUDES, COUNT, louder, planted

import lfrtorch
from lfrtorch._support import tables
from lfrtorch._support.atomic import whole_file
from lfrtorch._support.types import Array
from lfrtorch.data.records import Start

RESULTS = Path(__file__).with_name("first_try.json")

WORDS = "test=0", "nx=auto", "nz=auto", "nw=auto", "nn=auto"
"""Of the command, beside those of the data."""

MEASURED = {
    "mr_damper": (1, 200.0),
    "two_tanks": (1, 5.0),
    "robot_arm_10": (1, 200.0),
    "dc_motor": (1, 1.0),
    "exchanger": (1, 1.0),
    "winding": (5, 10.0),
    "disc": (1, 40.0),
    "soft_robot": (3, 1 / 0.083),
}
"""Folders of measured records: how many of the first columns are inputs, and Hz."""

SPLITS, FITTED, LONGEST, SKIP = 3, 0.6, 5000, 50
"""Of a measured record: how many, the part for estimation, samples of both parts, and those of
the new part from which its start is estimated."""

SYSTEMS = {"planted": COUNT, "louder": 16}
"""How many there are, by name."""

PARTS = (0, 40, 200, COUNT)
"""Planted systems that choices are made on; those that one limit was set by at last; the others are
for the last word."""

WORTH, NEAR, DIVERGED = 0.8, 1.05, 1e3
"""A nonlinear model is worth it up to this error over the linear one's; a recommended model is
near the better one up to this; no error counts as more."""

Entries = dict[str, dict[str, Any]]
"""What is known of each case, by its name."""


class Case(NamedTuple):
    """Data for estimation and new data, after whose first ``skip`` samples models are scored."""

    u: Array
    y: Array
    new: lfrtorch.Record
    about: dict[str, Any]
    louder: Mapping[float, lfrtorch.Record] = MappingProxyType(
        {}
    )  # new data by amplitude over that of u


def case(name: str, root: Path) -> Case:
    """The case of a name such as "planted 007" or "disc 2"."""
    kind, _, number = name.rpartition(" ")
    if kind == "planted":
        s = planted(int(number))
        about = {"kind": s.kind, "linear": s.linear, "snr": round(s.snr, 1)}
        return Case(s.u, s.y, _new(s.new_u, s.new_y, s.fs, s.skip), about)
    if kind == "louder":
        s = louder(int(number))
        news = {a: _new(u, y, 1.0, s.skip, "zero") for a, (u, y) in s.at.items()}
        about = {"kind": s.kind, "linear": False}
        return Case(s.u, s.y, news[AMPLITUDES[0]], about, news)
    files, split = sorted((root / kind).glob("*.csv")), int(number)
    if not files:
        raise FileNotFoundError(f"'{root / kind}' has no CSV file")
    nu, fs = MEASURED[kind]
    record = np.loadtxt(files[split % len(files)], delimiter=",", skiprows=1)
    first = (len(record) - LONGEST) * split // (SPLITS - 1)  # windows of a long one
    record = record[max(first, 0) :][:LONGEST]
    begin = round(len(record) * (1 - FITTED) * split / (SPLITS - 1))
    end = begin + round(len(record) * FITTED)
    rest = max(record[:begin], record[end:], key=len)
    u, y = record[begin:end, :nu], record[begin:end, nu:]
    used = np.ptp(u, axis=0) > 0  # a trial of the robot leaves one of its inputs alone
    new = _new(rest[:, :nu][:, used], rest[:, nu:], fs, SKIP)
    return Case(u[:, used], y, new, {"kind": kind, "linear": None})


def _new(u: Array, y: Array, fs: float, skip: int, start: Start = "estimated") -> lfrtorch.Record:
    return lfrtorch.Record(u, y, fs=fs, start=start, skip=skip, name="new")


def attempt(name: str, root: Path) -> dict[str, Any]:
    """One command, its seconds on the processor, and its errors."""
    torch.set_num_threads(1)
    u, y, new, about, loud = case(name, root)
    inputs, outputs = (
        ",".join(f"{letter}{i}" for i in range(signal.shape[1]))
        for letter, signal in (("u", u), ("y", y))
    )
    with tempfile.TemporaryDirectory() as temporary:
        folder, file = Path(temporary) / "run", Path(temporary) / "x.csv"
        table, head = np.hstack([u, y]), f"{inputs},{outputs}"
        np.savetxt(file, table, "%.9g", ",", header=head, comments="")
        command = [sys.executable, "-m", "lfrtorch.cli", "fit", str(file), f"fs={new.fs:.9g}"]
        command += [f"inputs=[{inputs}]", f"outputs=[{outputs}]", "figures=false", "threads=1"]
        before = _seconds()
        done = subprocess.run(
            [*command, *WORDS, f"hydra.run.dir={folder}"],
            env={**os.environ, "OMP_NUM_THREADS": "1"},
            capture_output=True,
            text=True,
            check=False,
        )
        about |= {"samples": len(u), "seconds": round(_seconds() - before, 1)}
        if done.returncode:
            return about | {"failed": (done.stderr or done.stdout).strip()[-500:]}
        metrics = json.loads((folder / "metrics.json").read_text())
        verdict, model = metrics["verdict"], lfrtorch.load(folder / "model")
        linear = lfrtorch.LinearModel.load(folder / "linear")
    errors = {"nonlinear": _error(new, model.simulate), "lti": _error(new, linear.simulate)}
    if loud:
        about["at"] = {
            f"{a:g}": float(f"{_error(r, model.simulate) / _error(r, linear.simulate):.4g}")
            for a, r in loud.items()
        }
    use = "nonlinear" if verdict["use"] == "NL-LFR" else "lti"
    about |= {"verdict": verdict["kind"], "use": use, "text": verdict["text"]}
    about["sizes"] = model.sizes | {"linear nx": linear.nx}
    return about | {"errors": errors, "recommended": errors[use]}


def _error(record: lfrtorch.Record, simulate: Callable[[lfrtorch.Record], Array]) -> float:
    """Root mean square error over the output's deviation."""
    found = lfrtorch.nrmse(record, simulate(record))
    return float(f"{min(found, DIVERGED):.6g}") if np.isfinite(found) else DIVERGED


def _seconds() -> float:
    """Of the processor, in all commands that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def known(results: Path) -> dict[str, Entries]:
    """All that is kept, by label."""
    return json.loads(results.read_text()) if results.exists() else {}


def keep(results: Path, label: str, name: str, entry: dict[str, Any]) -> None:
    """Add an entry to the file, which has a line for each."""
    with whole_file(results) as path:
        every = known(results)
        every.setdefault(label, {})[name] = entry
        parts = [
            f"{json.dumps(label)}: {{\n"
            + ",\n".join(f"{json.dumps(n)}: {json.dumps(e)}" for n, e in sorted(entries.items()))
            + "\n}"
            for label, entries in every.items()
        ]
        path.write_text("{\n" + ",\n".join(parts) + "\n}\n")


def report(every: dict[str, Entries]) -> str:
    """Tables in Markdown, a column for each label."""
    best: dict[str, float] = {}  # of all labels' nonlinear models
    for name, entry in (item for entries in every.values() for item in entries.items()):
        if "failed" not in entry:
            best[name] = min(entry["errors"]["nonlinear"], best.get(name, np.inf))
    lines: list[str] = []
    for part in sorted({_part(name) for entries in every.values() for name in entries}):
        columns = [
            measures({name: entry for name, entry in entries.items() if _part(name) == part}, best)
            for entries in every.values()
        ]
        lines += [f"| {part} | {' | '.join(every)} |", "|---|" + "---|" * len(every)]
        names = max(columns, key=len)
        lines += [
            f"| {' | '.join([n, *(c.get(n, tables.UNKNOWN) for c in columns)])} |" for n in names
        ]
        lines.append("")
    return "\n".join(lines)


def measures(entries: Entries, best: dict[str, float]) -> dict[str, str]:
    """What is reported of the cases of a label, beside the least errors known."""
    ended = {name: entry for name, entry in entries.items() if "failed" not in entry}
    better = [e for e in ended.values() if _better(e)]
    worth = [
        e for n, e in ended.items() if not e["linear"] and best[n] <= WORTH * e["errors"]["lti"]
    ]
    regrets = [e["recommended"] / min(e["errors"].values()) for e in ended.values()]
    behind = [e["recommended"] / min(best[n], e["errors"]["lti"]) for n, e in ended.items()]
    found = {
        "cases, of these failed": f"{len(entries)}, {len(entries) - len(ended)}",
        "“better” agrees with new data": _share(
            e["errors"]["nonlinear"] < e["errors"]["lti"] for e in better
        ),
        "truth linear: “better”": _share(_better(e) for e in ended.values() if e["linear"]),
        f"best model at most {WORTH:g} of the linear error: “better”": _share(map(_better, worth)),
        f"recommended within {NEAR:g} of the better of the two": _share(r <= NEAR for r in regrets),
        "recommended over the better of the two": _spread(regrets),
        "recommended over the best of all columns": _spread(behind),
    }
    for a in AMPLITUDES if any("at" in e for e in ended.values()) else ():
        of_linear = [e["at"][f"{a:g}"] for e in ended.values()]
        found[f"error over the linear model's at {a:g} times the amplitude"] = _spread(of_linear)
    for low, high in pairwise((0, 300, 1000, 2500, LONGEST + 1)):
        seconds = [e["seconds"] for e in entries.values() if low <= e["samples"] < high]
        found[f"seconds, {low} to {high - 1} samples"] = _spread(seconds)
    return found


def _better(entry: dict[str, Any]) -> bool:
    return entry["verdict"] == "better"


def _part(name: str) -> str:
    """The table that a case is in."""
    if not name.startswith("planted"):
        return "louder systems" if name.startswith("louder") else "measured records"
    number = int(name.split()[1])
    first, after = next(pair for pair in pairwise(PARTS) if pair[0] <= number < pair[1])
    return f"planted {first} to {after - 1}"


def _share(true: Iterable[bool]) -> str:
    every = [*true]
    return f"{sum(every)} of {len(every)}" if every else tables.UNKNOWN


def _spread(values: Sequence[float]) -> str:
    """The median and the largest."""
    if not values:
        return tables.UNKNOWN
    return f"{tables.number(median(values))}, worst {tables.number(max(values))}"


def chosen(words: Sequence[str]) -> list[str]:
    """Names of cases, from ``planted``, ``planted:0-39``, ``measured``, ``measured:disc``."""
    names: list[str] = []
    for word in words:
        kind, _, which = word.partition(":")
        if kind in SYSTEMS:
            first, _, last = (which or f"0-{SYSTEMS[kind] - 1}").partition("-")
            names += [f"{kind} {n:03d}" for n in range(int(first), int(last or first) + 1)]
        elif kind == "measured" and which in ("", *MEASURED):
            names += [f"{n} {k}" for n in ([which] if which else MEASURED) for k in range(SPLITS)]
        else:
            raise ValueError(f"no cases '{word}'; give planted:0-39, measured:disc or the like.")
    return names


def main() -> None:
    """Run the cases that are missing, or report."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--label", help="names the state of the code")
    parser.add_argument("--cases", nargs="+", default=[f"planted:0-{PARTS[1] - 1}"])
    parser.add_argument("--root", type=Path, default=Path(), help="folder of measured records")
    parser.add_argument("--jobs", type=int, default=1, help="commands at a time")
    parser.add_argument("--results", type=Path, default=RESULTS, help="where they are kept")
    parser.add_argument("--report", action="store_true", help="print the tables of all labels")
    options = parser.parse_args()
    if options.report:
        print(report(known(options.results)))
        return
    if not options.label:
        parser.error("--label is needed: it names the state of the code")
    kept = known(options.results).get(options.label, {})
    names = [name for name in chosen(options.cases) if name not in kept]
    with ProcessPoolExecutor(options.jobs) as pool:
        under_way = {pool.submit(attempt, name, options.root): name for name in names}
        for done in as_completed(under_way):
            name, entry = under_way[done], done.result()
            keep(options.results, options.label, name, entry)
            print(name, json.dumps(entry), flush=True)


if __name__ == "__main__":
    main()
