"""How often it helps to follow the advice of a run, over many data sets.

    python benchmarks/advice.py [CASE ...] [--out FILE.jsonl]

Each case is a measured or simulated record of some 1000 samples, cut into training, validation and
a rest that no fit and no advice sees. Fits of several sizes are advised; each item that can be
followed is followed alone, and the error on the rest is compared with that before. Of measured
benchmarks the estimation data alone are read. Every fit is one line of the file; those that are
there are not repeated.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from measurements import cart, ced, emps, linear, silverbox, tanks, wiener_hammerstein
from scipy.signal import lfilter

import lfrtorch
from lfrtorch._support import tables
from lfrtorch._support.types import Array
from lfrtorch.reporting.advice import Advice

PARTS = {"train": 0.5, "validation": 0.2}
"""Of the record, one after the other."""

OTHERS = {"validation": 0.2, "train": 0.5}
"""The same samples in other parts."""

TESTED = {"train": 0.4, "validation": 0.15, "test": 0.15}
"""With a test."""

SKIP, NX_MAX = 40, 4
"""Samples that a start state is estimated from and no score has, and the highest order tried."""

SAME = 0.05
"""Change of the error that is none."""

BASES: dict[str, dict[str, Any]] = {
    "small": {"nx": 2, "nz": 1, "nw": 1, "nn": 3, "max_iter": 12},
    "large": {"nx": 3, "nz": 2, "nw": 2, "nn": 16, "max_iter": 25},
    "unvalidated": {"nx": 2, "nz": 1, "nw": 1, "nn": 8, "max_iter": 15},
    "largest": {"nx": 3, "nz": 2, "nw": 2, "nn": 30, "max_iter": 40},
    "tested": {"nx": 3, "nz": 2, "nw": 2, "nn": 16, "max_iter": 25},
}
"""Settings of the fits that are advised; the third has no validation part, the last a test."""

ONLY = {"largest": "Overfit", "tested": "The gain on"}
"""What is followed after these fits, which are there for that: how this advice begins."""

Signals = tuple[Array, Array, int]
"""Input, output, and the period or 0."""


def measured(
    load: Callable[[Path], tuple[Array, Array]], first: int, step: int, samples: int, root: Path
) -> Signals:
    """Every ``step``-th sample of a part of a measurement."""
    u, y = load(root)
    part = slice(first, first + step * samples, step)
    return u[part], y[part], 0


def lowpass(x: Array, pole: float = 0.8) -> Array:
    """A first-order system with a delay of one sample and unit gain."""
    return np.asarray(lfilter([0.0, 1.0 - pole], [1.0, -pole], x, axis=0))


def resonance(x: Array) -> Array:
    """A resonance."""
    return np.asarray(lfilter([0.0, 0.3, 0.1], [1.0, -1.3, 0.7], x, axis=0))


def simulated(system: Callable[[Array], Array], noise: float, periods: int = 1) -> Signals:
    """Normal noise, filtered a little, through a system; periods in steady state."""
    rng = np.random.default_rng(3)
    N = 1000 // periods
    u = lowpass(2.0 * rng.standard_normal((N, 1)), 0.5)
    y = system(np.tile(u, (periods + 1, 1)))[N:]
    u = np.tile(u, (periods, 1))
    return u, y + noise * y.std() * rng.standard_normal(y.shape), N if periods > 1 else 0


def saturating(u: Array) -> Array:
    """A first-order system whose state saturates what drives it."""
    y = np.zeros_like(u)
    for k in range(len(u) - 1):
        y[k + 1] = 0.85 * y[k] + 0.4 * np.tanh(u[k] - 0.5 * y[k] ** 3)
    return y


def another_input(u: Array) -> Array:
    """The same, driven by a signal that is not recorded."""
    return saturating(lowpass(2.0 * np.random.default_rng(4).standard_normal(u.shape), 0.5))


def boucwen(root: Path) -> Signals:
    """Hysteresis, in steady state; noise of 2 %."""
    del root
    force = lfrtorch.datasets.boucwen.multisine(samples=1000, seed=3)
    y = lfrtorch.datasets.boucwen.simulate(np.tile(force, 2))[1000:, None]
    noise = np.random.default_rng(3).standard_normal(y.shape)
    return force[::20, None], y + 0.02 * y.std() * noise, 0


def parwh(root: Path) -> Signals:
    """Two saturating branches between filters, a part of a period; noise of 1 %."""
    del root
    u = lfrtorch.datasets.parwh.multisine(rms=1.0, seed=3)
    y = lfrtorch.datasets.parwh.simulate(u)[:, None]
    noise = np.random.default_rng(3).standard_normal(y.shape)
    part = slice(4000, 5000)
    return u[part, None], (y + 0.01 * y.std() * noise)[part], 0


CASES: dict[str, Callable[[Path], Signals]] = {
    "saturating, periodic": lambda _: simulated(saturating, 0.05, 5),
    "linear": lambda root: measured(linear, 0, 1, 1000, root),
    "wiener": lambda _: simulated(lambda u: np.tanh(resonance(u)), 0.01),
    "silverbox": lambda root: measured(silverbox, 0, 1, 1000, root),
    "ced": lambda root: measured(ced, 0, 1, 500, root),
    "boucwen": boucwen,
    "tanks": lambda root: measured(tanks, 0, 1, 1024, root),
    "hammerstein": lambda _: simulated(lambda u: resonance(u + 0.5 * u**2), 0.01),
    "wiener_hammerstein": lambda root: measured(wiener_hammerstein, 0, 2, 1000, root),
    "emps": lambda root: measured(emps, 0, 6, 1000, root),
    "parwh": parwh,
    "linear, periodic": lambda _: simulated(resonance, 0.05, 5),
    "saturating": lambda _: simulated(saturating, 0.02),
    "cart": lambda root: measured(cart, 0, 4, 1000, root),
    "another input": lambda _: simulated(another_input, 0.02),
}

HELD_OUT = "Overfitting would not show"
OTHER_PARTS = "The validation part is unlike", "The models are good in training only", "The gain on"
NO_MORE = (
    "Noise-limited",
    "The system is linear at this level",
    "The inputs explain little of the outputs",
)
"""Advice that says not to go on."""


def parts(
    case: str, root: Path, cuts: dict[str, float]
) -> tuple[lfrtorch.Dataset, lfrtorch.Record]:
    """The data that a user has, in these parts of the record, and the rest."""
    u, y, period = CASES[case](root)

    def record(name: str, begin: float, end: float = 1.0) -> lfrtorch.Record:
        samples = slice(round(begin * len(u)), round(end * len(u)))
        if period and name == "train" and "validation" in cuts and not begin:
            whole = slice(samples.stop // period * period)
            return lfrtorch.Record(u[whole], y[whole], name=name, start="periodic", period=period)
        return lfrtorch.Record(u[samples], y[samples], name=name, start="estimated", skip=SKIP)

    ends = np.cumsum([*cuts.values()])
    found = {
        name: [record(name, end - part, end)]
        for (name, part), end in zip(cuts.items(), ends, strict=True)
    }
    validation, tests = found.get("validation", []), found.get("test", [])
    return lfrtorch.Dataset(case, found["train"], validation, tests), record(
        "rest", sum(PARTS.values())
    )


def settings(base: str) -> lfrtorch.Settings:
    """Those of a fit that is advised."""
    given = dict(BASES[base])
    trainer = lfrtorch.LevenbergMarquardt(max_iter=given.pop("max_iter"))
    return lfrtorch.Settings(**given, trainer=trainer, nx_max=NX_MAX)


def attempts(case: str, base: str, root: Path) -> list[dict[str, Any]]:
    """A fit, and one for each item of its advice."""
    cuts = {"unvalidated": {"train": sum(PARTS.values())}, "tested": TESTED}.get(base, PARTS)
    data, rest = parts(case, root, cuts)
    asked, clock = settings(base), time.perf_counter()
    run = lfrtorch.identify(data, asked)
    before = lfrtorch.rmse(rest, run.model.simulate(rest))
    about = {"case": case, "base": base}
    found: list[dict[str, Any]] = [
        {
            **about,
            "advice": "",
            "before": before,
            "after": before,
            "linear": lfrtorch.rmse(rest, run.linear.simulate(rest)),
            "verdict": run.verdict.kind,
            "seconds": time.perf_counter() - clock,
        }
    ]
    for item in run.advice:
        clock = time.perf_counter()
        changed = None
        if item.text.startswith(ONLY.get(base, "")) and (base == "small" or not searches(item)):
            changed = followed(item, case, asked, data, root)
        after = None
        if changed is not None:
            again = lfrtorch.identify(*changed)
            after = lfrtorch.rmse(rest, again.model.simulate(rest))
        entry = {**about, "advice": item.text.split(":")[0].rstrip("."), "text": str(item)}
        entry |= {"before": before, "after": after, "seconds": time.perf_counter() - clock}
        found.append(entry)
    return found


def searches(item: Advice) -> bool:
    """Whether to follow it takes a search for sizes."""
    return item.change is not None and "auto" in item.change.values()


def followed(
    item: Advice, case: str, asked: lfrtorch.Settings, data: lfrtorch.Dataset, root: Path
) -> tuple[lfrtorch.Dataset, lfrtorch.Settings] | None:
    """What is made of an item of advice; None if nothing can be."""
    if item.text.startswith(HELD_OUT):
        return parts(case, root, PARTS)[0], asked
    if item.text.startswith(OTHER_PARTS):
        return parts(case, root, OTHERS)[0], asked
    return None if item.change is None else (data, replace(asked, **item.change))


def table(entries: list[dict[str, Any]]) -> str:
    """The table of how often it helped."""
    fits = [e for e in entries if not e["advice"]]
    rows = []
    for name in dict.fromkeys(e["advice"] for e in entries if e["advice"]):
        ratios = [e["after"] / e["before"] for e in entries if e["advice"] == name and e["after"]]
        if ratios:
            helped, harmed = sum(r < 1 - SAME for r in ratios), sum(r > 1 + SAME for r in ratios)
            middle = float(np.median(ratios))
            same = len(ratios) - helped - harmed
            rows.append([name, len(ratios), helped, same, harmed, middle])
    rows.sort(key=lambda row: row[-1])
    head = ["advice", "followed", "helped", "no difference", "harmed", "error after / before"]
    lines = [_markdown(head, rows), ""]
    rows = []
    for name in NO_MORE:
        said = [e for e in entries if e["advice"] == name]
        right = 0
        for e in said:
            own = [f for f in fits if f["case"] == e["case"]]
            limit = e["before"] if name == NO_MORE[0] else min(f["linear"] for f in own)
            others = [f["after"] for f in entries if f["case"] == e["case"] and f["after"]]
            right += min(others) > (1 - SAME) * limit
        rows.append([name, len(said), right])
    lines.append(_markdown(["advice not to go on", "said", "right"], rows))
    return "\n".join(lines)


def _markdown(head: list[str], rows: list[list[Any]]) -> str:
    cells = [[tables.cell(value) for value in row] for row in rows]
    lines = [head, ["---"] * len(head), *cells]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def main() -> None:
    """Fit, follow, and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("cases", nargs="*", metavar="CASE", help=", ".join(CASES))
    parser.add_argument("--root", type=Path, help="folder of the benchmarks' files")
    parser.add_argument("--out", type=Path, default=Path("advice.jsonl"), help="every fit, a line")
    options = parser.parse_args()
    if unknown := set(options.cases) - set(CASES):
        parser.error(f"no case {', '.join(sorted(unknown))}; there are {', '.join(CASES)}")
    shared = Path(__file__).resolve().parents[2] / "shared" / "data" / "nonlinear_benchmarks"
    root = options.root or Path(os.environ.get("LFRTORCH_DATA", shared))
    torch.set_num_threads(1)
    lines = options.out.read_text().splitlines() if options.out.exists() else []
    entries = [json.loads(line) for line in lines]
    for case in options.cases or CASES:
        for base in BASES:
            if any((e["case"], e["base"]) == (case, base) for e in entries):
                continue
            try:
                found = attempts(case, base, root)
            except FileNotFoundError as missing:
                print(f"{case} is left out: {missing}", file=sys.stderr)
                break
            with options.out.open("a") as file:
                file.writelines(f"{json.dumps(entry)}\n" for entry in found)
            entries += found
            for e in found:
                print(*(e.get(key) for key in ("case", "base", "before", "after", "text")))
    print(table(entries))


if __name__ == "__main__":
    main()
