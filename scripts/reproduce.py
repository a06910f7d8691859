"""All benchmarks whose data are at hand: runs of train.py -> RESULTS.md, figures, leaderboard.

python scripts/reproduce.py [NAME ...] [data.root=DIR]
python scripts/reproduce.py silverbox --seeds 2 --out runs/try --results runs/try/RESULTS.md
python scripts/reproduce.py --quick data.root=DIR

Each run is ``python train.py +bench=NAME seed=S`` (and data.seed=S if data are simulated), S = 0
.. SEEDS - 1, in a folder of its own below --out, and is not repeated if one of the same command
came to its end there (remove the folder after a change of the package). Words with an equals sign
are settings passed on to train.py. RESULTS.md has all that is in --out.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import leaderboard
import numpy as np

import lfrtorch
from lfrtorch._support.atomic import whole_file
from lfrtorch._support.tables import number
from lfrtorch.cli.composition import composed
from lfrtorch.cli.hydra_versions import instantiate
from lfrtorch.data.dataset import Dataset, Published
from lfrtorch.datasets.official import LEGACY
from lfrtorch.reporting.scores import ERRORS

ROOT = Path(__file__).resolve().parents[1]

STAND_IN = "stand-in"
"""Source of simulated records in the place of official ones: their scores do not compare."""

CASES = {
    "boucwen": ["+bench=boucwen"],
    "boucwen_nz1": ["+bench=boucwen", "nz=1", "nn=15", "refit=false"],
    "boucwen_record": ["+bench=boucwen_record"],
    "parwh": ["+bench=parwh"],
    "parwh_stand_in": ["+bench=parwh", f"data.source={STAND_IN}"],
    "wiener_hammerstein": ["+bench=wiener_hammerstein"],
    "wiener_hammerstein_site": ["+bench=wiener_hammerstein", "data.split=site"],
    "silverbox": ["+bench=silverbox"],
    "cascaded_tanks": ["+bench=cascaded_tanks"],
    "ced": ["+bench=ced"],
    "emps": ["+bench=emps"],
    "f16": ["+bench=f16"],
    "fine_steering_mirror": ["+bench=fine_steering_mirror"],
    "wh_process_noise": ["+bench=wh_process_noise"],
}
"""Settings of train.py by name."""

QUICK = ["starts=1", "trainer.max_iter=10"]
LONG = 5000
"""Samples from which on errors in time are a band of colour."""

RUN = "run.json"
"""File in the folder of a run: the time that the command took."""


@dataclass(frozen=True)
class Case:
    """A benchmark and its runs; ``missing`` says why there are none."""

    name: str
    dataset: Dataset | None
    runs: Sequence[dict[str, Any]] = ()
    folders: Sequence[Path] = ()
    missing: str = ""

    @property
    def chosen(self) -> int:
        """Number of the run that is best on validation, or else on training."""
        judged = [run["validation"]["rmse"] for run in self.runs]
        if any(error is None for error in judged):
            judged = [run["ranking"][0]["train"] if run["ranking"] else 0.0 for run in self.runs]
        return int(np.argmin(judged))


def main() -> int:
    """Run what is missing, then write the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "words", nargs="*", metavar="NAME | SETTING", help=f"of {', '.join(CASES)}; all by default"
    )
    parser.add_argument("--seeds", type=int, default=5, help="runs of each (5)")
    parser.add_argument(
        "--quick", action="store_true", help="one run of one start and few iterations: a try"
    )
    parser.add_argument("--out", type=Path, help="of the runs (runs/reproduce, runs/quick)")
    parser.add_argument("--results", type=Path, help="the file (RESULTS.md, or in --out if quick)")
    options = parser.parse_intermixed_args()
    settings = [word for word in options.words if "=" in word]
    names = [word for word in options.words if "=" not in word] or list(CASES)
    if unknown := [name for name in names if name not in CASES]:
        parser.error(f"no benchmark {', '.join(unknown)}; there are {', '.join(CASES)}")
    if options.seeds < 1:
        parser.error(f"--seeds is {options.seeds}; at least one run is needed")
    seeds = 1 if options.quick else options.seeds
    out = (options.out or ROOT / "runs" / ("quick" if options.quick else "reproduce")).resolve()
    results = options.results or (out if options.quick else ROOT) / "RESULTS.md"

    cases = []
    for name, own in CASES.items():
        words = [*own, *(QUICK if options.quick else []), *settings]
        cases.append(case(name, words, out, seeds, start=name in names))
    page = results.resolve()
    made = gallery(cases, page.parent / "results", page.parent)
    board = leaderboard.table(entries(cases))
    with whole_file(page) as file:
        file.write_text(written(cases, made, quick=options.quick), encoding="utf-8")
    with whole_file(page.parent / "results" / "leaderboard.csv") as file:
        file.write_text(board, encoding="utf-8")
    print(f"\nTables in {page}")
    return 0


def case(name: str, words: list[str], out: Path, seeds: int, *, start: bool) -> Case:
    """The runs of a benchmark; those that are not there yet are started, if ``start``."""
    cfg = composed("config", words)
    try:
        dataset: Dataset = instantiate(cfg.data)
    except FileNotFoundError as error:
        print(f"{name}: no data. {error}", flush=True)
        return Case(name, None, missing="no data at hand")
    if not dataset.tests:
        return Case(name, None, missing="no test records at hand")
    stand_in = any(record.source == STAND_IN for record in dataset.tests)
    if stand_in and f"data.source={STAND_IN}" not in words:
        return Case(name, None, missing="no data at hand")
    runs, folders = [], []
    for seed in range(seeds):
        own = [*words, f"seed={seed}", *([f"data.seed={seed}"] if "seed" in cfg.data else [])]
        folder = out / name / f"seed={seed}"
        found = run(own, folder, start=start)
        if found is not None:
            runs.append(found)
            folders.append(folder)
    if not runs:
        return Case(name, dataset, missing="not run")
    return Case(name, dataset, runs, folders)


def run(words: list[str], folder: Path, *, start: bool) -> dict[str, Any] | None:
    """metrics.json of one run of train.py and the ``seconds`` that the whole command took."""
    shown = shlex.join(["python", "train.py", *words])
    files = folder / "metrics.json", folder / RUN
    if all(file.is_file() for file in files):
        metrics, about = (json.loads(file.read_text()) for file in files)
        if metrics["command"] == shown and metrics["fit"]["reason"] != lfrtorch.Reason.INTERRUPTED:
            return metrics | about
    if not start:
        return None
    print(shown, flush=True)
    shutil.rmtree(folder, ignore_errors=True)
    clock = time.perf_counter()
    command = [sys.executable, str(ROOT / "train.py"), *words, f"hydra.run.dir='{folder}'"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"failed: {shown}\n{done.stderr}")
    about = {"seconds": time.perf_counter() - clock, "machine": machine()}
    with whole_file(folder / RUN) as file:
        file.write_text(json.dumps(about) + "\n")
    metrics = json.loads((folder / "metrics.json").read_text())
    for name, score in metrics["scores"].items():
        print(f"    {name}: {shown_in(score['rmse'], score['unit'])}", flush=True)
    return metrics | about


def written(cases: Sequence[Case], figures: dict[str, list[Path]], *, quick: bool) -> str:
    """RESULTS.md."""
    lines = [
        "# Results",
        "",
        "Simulation RMSE on the test records, written by `python scripts/reproduce.py "
        "data.root=DIR`. *chosen* is the run that is best on validation (of the tanks, all of "
        "whose samples train, on training), then the median and the range of all runs (seeds 0, "
        "1, ...); *linear* is the best linear approximation (of parwh one a level). *seconds* are "
        "those of the whole command, the linear model, all starts, scores and figures included "
        "(median). Sizes of a mean are those of each start; its parameters count the zeros "
        "between them.",
        "",
    ]
    if quick:
        lines += [f"**A quick try ({' '.join(QUICK)}, one run): no result to quote.**", ""]
    lines += [
        "| benchmark | test | source | unit | linear | **chosen** | median | best .. worst | runs "
        "| best published | samples - skip |",
        "|---" * 11 + "|",
    ]
    for each in cases:
        lines += rows(each)
    lines += [
        "",
        "| benchmark | nx, nz, nw, nn | parameters (net) | samples | starts | iterations "
        "| seconds | ms an iteration | command |",
        "|---" * 9 + "|",
    ]
    lines += [costs(each) for each in cases if each.runs]
    lines += ["", *references(cases), ""]
    if made_on := machines(cases):
        lines += [
            "Made on the machine below. Another processor rounds in other ways, and a fit may end "
            "in another minimum there: compare medians.",
            "",
            *(f"- {line}" for line in made_on),
            "",
        ]
    for each in cases:
        if figures.get(each.name):
            lines += [f"## {each.name}", ""]
            lines += [f"![{path.stem}]({path.as_posix()})" for path in figures[each.name]]
            lines += [""]
    return "\n".join(lines)


def rows(each: Case) -> list[str]:
    """Rows of the table of errors, one a test record."""
    if not each.runs or each.dataset is None:
        return [f"| {each.name} | {each.missing} |" + " |" * 9]
    of_runs = [errors_of(run, each.dataset) for run in each.runs]
    shown = of_runs[each.chosen]
    errors = {line: [run[line][1]["rmse"] for run in of_runs] for line in shown}
    errors = {line: [np.inf if e is None else e for e in of] for line, of in errors.items()}
    (plain,) = {score["unit"] for score, _ in shown.values()}
    linear = [of["lti_rmse"] or 0.0 for _, of in shown.values()]
    unit, scale = prefixed(plain, min(map(min, errors.values())), max(linear))
    found = []
    for line, (score, of) in shown.items():
        values = errors[line]
        best = published(each, line)
        cells = [of["lti_rmse"], values[each.chosen], np.median(values)]
        cells = [three_digits(value, scale) for value in cells]
        cells[1] = f"**{cells[1]}**"
        spread = f"{three_digits(min(values), scale)} .. {three_digits(max(values), scale)}"
        other = ", ".join(f"{three_digits(p.scores[line], scale)} ({named(p)})" for p in best)
        window = f"{score['samples']} - {score['skip']}"
        head = [each.name, line, score["source"], unit]
        row = [*head, *cells, spread, str(len(values)), other or "-", window]
        found.append(f"| {' | '.join(row)} |")
    return found


def errors_of(run: dict[str, Any], dataset: Dataset) -> dict[str, tuple[dict[str, Any], Any]]:
    """The entry and the errors of each line of a run: a score, or one output of it."""
    named = {key.rpartition(" ")[2] for p in dataset.published for key in p.scores if " " in key}
    found = {}
    for name, score in run["scores"].items():
        found[name] = score, {of: score[of] for of in ERRORS}
        for i, output in enumerate(score.get("outputs", [])):
            if output in named:
                errors = {of: score[f"{of}_by_output"] for of in ERRORS}
                own = {of: each[i] if each else None for of, each in errors.items()}
                found[f"{name} {output}"] = score, own
    return found


def costs(each: Case) -> str:
    """What the runs of a benchmark take, as a line of the table."""
    run = each.runs[each.chosen]
    mean = run.get("averaged", 1)
    sizes = ", ".join(
        str(run["sizes"][name] // mean)
        for name in ("nx", "nz", "nw", "nn", "degree")
        if name in run["sizes"]
    )
    iteration = np.median([r["fit"]["seconds_per_iteration"] for r in each.runs])
    cells = [
        each.name,
        sizes,
        f"{run['parameters']} ({run['parameters_net']})",
        str(run["data"]["samples"]),
        str(run["starts"]) + (f", mean of {mean}" if mean > 1 else ""),
        str(run["fit"]["iterations"]),
        f"{np.median([r['seconds'] for r in each.runs]):.0f}",
        f"{1e3 * iteration:.0f}",
        f"`{anywhere(run['command'])}`",
    ]
    return f"| {' | '.join(cells)} |"


def anywhere(command: str) -> str:
    """A command as it is on another machine."""
    return re.sub(r"data\.root=\S+", "data.root=DIR", command)


def published(each: Case, test: str) -> list[Published]:
    """The best published result on an official test record, and one on older splits if better.

    Those for the sizes of the runs go before those of other sizes and models.
    """
    dataset = each.dataset
    if dataset is None or any(r.name == test and r.source == STAND_IN for r in dataset.tests):
        return []
    known = [p for p in dataset.published if test in p.scores]
    if each.runs:
        run = each.runs[each.chosen]
        mine = tuple(run["sizes"][name] // run.get("averaged", 1) for name in ("nz", "nw"))
        known = [p for p in known if p.sizes == mine] or known
    known.sort(key=lambda p: p.scores[test])
    now = next((i for i, p in enumerate(known) if not p.reference.startswith(LEGACY)), len(known))
    return [*known[now : now + 1], *known[: min(now, 1)]]


def named(published: Published) -> str:
    """Label, and sizes if it has some."""
    sizes = published.sizes
    return published.label + ("" if sizes is None else f", nz {sizes[0]}, nw {sizes[1]}")


def references(cases: Sequence[Case]) -> list[str]:
    """Where the published numbers stand."""
    lines = []
    for each in cases:
        if each.dataset is None or not each.runs:
            continue
        for test in errors_of(each.runs[0], each.dataset):
            lines += [f"- {each.name}, {named(p)}: {p.reference}" for p in published(each, test)]
        lines += [f"- {each.name}: {note}" for note in each.dataset.notes]
    return list(dict.fromkeys(lines))


def entries(cases: Sequence[Case]) -> list[leaderboard.Entry]:
    """Entries of the leaderboard: the chosen models on the records that the package cuts."""
    return [
        leaderboard.entry(
            each.name,
            lfrtorch.load(each.folders[each.chosen]),
            each.dataset.leaderboard,
            groups=each.dataset.groups,
            seconds=each.runs[each.chosen]["seconds"],
            command=anywhere(each.runs[each.chosen]["command"]),
        )
        for each in cases
        if each.runs and each.dataset is not None and each.dataset.leaderboard
    ]


def gallery(cases: Sequence[Case], folder: Path, start: Path) -> dict[str, list[Path]]:
    """Figures of the chosen runs, copied; their paths from ``start`` by benchmark.

    For each test the spectrum of the errors, or their course if the test is short; and the static
    map.
    """
    folder.mkdir(parents=True, exist_ok=True)
    copied: dict[str, list[Path]] = {}
    for each in cases:
        if not each.runs:
            continue
        drawn = each.folders[each.chosen] / "figures"
        groups = {} if each.dataset is None else each.dataset.groups
        for name, score in each.runs[each.chosen]["scores"].items():
            test = next(r for r in groups.get(name, [name]) if (drawn / f"{r}.png").is_file())
            density = drawn / f"{test}_density.png"
            dense = density.is_file() and score["samples"] > LONG
            figures = [density if dense else drawn / f"{test}.png"]
            copied[each.name] = copied.get(each.name, []) + figures
        copied[each.name].append(drawn / "static_map.png")
    for name, figures in copied.items():
        for i, figure in enumerate(figures):
            target = folder / f"{name}_{figure.name}"
            shutil.copyfile(figure, target)
            figures[i] = target.relative_to(start)
    return copied


def machines(cases: Sequence[Case]) -> list[str]:
    """What the runs ran on."""
    return list(dict.fromkeys(f"{run['machine']}" for each in cases for run in each.runs))


def machine() -> str:
    """Processor, cores, system and versions."""
    cpuinfo = Path("/proc/cpuinfo")
    names = cpuinfo.read_text().splitlines() if cpuinfo.is_file() else []
    model = next((n.split(":")[1].strip() for n in names if n.startswith("model name")), "")
    versions = f"Python {platform.python_version()}, lfrtorch {lfrtorch.__version__}"
    return f"{model or platform.machine()}, {os.cpu_count()} cores, {platform.system()}, {versions}"


def prefixed(unit: str, least: float, largest: float) -> tuple[str, float]:
    """The unit with the prefix that makes values readable, and what to multiply by."""
    shown, scale = unit, 1.0
    for prefix in ("m", "µ"):
        if unit in ("V", "m") and least * scale < 0.1 and largest * scale < 2.0:
            shown, scale = f"{prefix}{unit}", 1e3 * scale
    return shown, scale


def three_digits(value: float | None, scale: float = 1.0) -> str:
    """A value in three digits; None or infinite if a simulation diverges."""
    if value is None or not np.isfinite(value):
        return "diverges"
    return number(scale * value)


def shown_in(value: float | None, unit: str) -> str:
    """Value and unit."""
    prefix, scale = prefixed(unit, value or 1.0, value or 1.0)
    return f"{three_digits(value, scale)} {prefix}".strip()


if __name__ == "__main__":
    sys.exit(main())
