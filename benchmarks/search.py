"""`lfrtorch search` against sizes on auto, at equal cost: validation errors over seeds.

    python benchmarks/search.py --root DIR --out runs/search_cost

Each seed is one fit with nx, nz, nw and nn on auto, and then one search over the same sizes, which
begins no run after the seconds that the fit took. Both are whole commands on one thread. Data are
the official estimation records; runs write scores of tests at hand, which nothing here reads. What
is done is in the folder and is not done again.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np


class Board(NamedTuple):
    """A benchmark, shortened so that both ways take some minutes.

    Args:
        words: of both ways.
        space: of the search, what auto tries.
    """

    words: list[str]
    space: list[str]


SIZES = ["nz=1,2,3", "nw=1,2,3", "nn=range(5,26)"]
BOARDS = {
    "silverbox": Board(["trainer.max_iter=60"], ["nx=range(1,13)", *SIZES]),
    "f16": Board(
        [
            *("data.train=[multisine_3,multisine_7]", "data.validation=[multisine_5]"),
            *("first_part=1", "modes=0", "nx_max=12", "trainer.max_iter=20"),
        ],
        ["nx=range(1,13)", *SIZES],
    ),
    "fine_steering_mirror": Board(
        [
            *("data.levels=[200]", "relaxations=0", "nx_max=12"),
            *("sizes_search.nz=[2,4,8]", "sizes_search.nw=[2,4]", "sizes_search.nn=[10,20]"),
            *("first_iterations=10", "trainer.max_iter=8"),
        ],
        ["nx=range(1,13)", "nz=2,4,8", "nw=2,4", "nn=range(10,21)"],
    ),
}
COMMON = ["threads=1", "figures=false", "refit=false", "average=1"]
AUTO = ["nx=auto", "nz=auto", "nw=auto", "nn=auto", "starts=2"]
SEEDS = 5


def main() -> int:
    """Do what is missing, then print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--root", type=Path, required=True, help="folder of the benchmarks")
    parser.add_argument("--out", type=Path, required=True, help="folder of the runs")
    parser.add_argument("--only", nargs="+", choices=BOARDS, default=list(BOARDS))
    options = parser.parse_args()
    for seed in range(SEEDS):
        for name in options.only:
            compared(name, seed, options.root, options.out / name)
    print(table(options.only, options.out))
    return 0


def compared(name: str, seed: int, root: Path, out: Path) -> None:
    """Both ways with a seed; their numbers go to a file."""
    found = out / f"{seed}.json"
    if found.is_file():
        return
    words = [f"+bench={name}", f"data.root={root}", f"seed={seed}", *COMMON, *BOARDS[name].words]
    folder = out / f"auto_{seed}"
    seconds = timed("fit", *words, *AUTO, f"hydra.run.dir={folder}", "overwrite=true")
    both = {"auto": ended(folder) | {"seconds": seconds}}
    folder = out / f"search_{seed}"
    shutil.rmtree(folder, ignore_errors=True)  # what an interrupted one left
    limits = ["trials=1000", f"minutes={seconds / 60}", f"out={folder}"]
    seconds = timed("search", *words, *BOARDS[name].space, *limits)
    runs = [ended(path.parent) for path in folder.glob("*/metrics.json")]
    best = min(runs, key=lambda run: run["error"])
    both["search"] = best | {"seconds": seconds, "runs": len(runs)}
    found.write_text(json.dumps(both))
    print(name, seed, both, flush=True)


def timed(*words: str) -> float:
    """Seconds of a command."""
    begun = time.perf_counter()
    command = [sys.executable, "-m", "lfrtorch.cli", *words]
    subprocess.run(command, env=os.environ | {"OMP_NUM_THREADS": "1"}, check=True)
    return time.perf_counter() - begun


def ended(folder: Path) -> dict[str, Any]:
    """What a run found."""
    metrics = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
    error = metrics["validation"]["rmse"]
    return {
        "error": math.inf if error is None else error,
        "parameters": metrics["parameters_net"],
        "sizes": [metrics["sizes"][size] for size in ("nx", "nz", "nw", "nn")],
    }


def table(names: list[str], out: Path) -> str:
    """Validation errors in the units of the records, in Markdown: each seed, and medians."""
    lines = ["| board | way | validation RMSE, each seed | median | parameters | seconds |"]
    lines.append("| --- " * 6 + "|")
    for name in names:
        found = [json.loads((out / name / f"{seed}.json").read_text()) for seed in range(SEEDS)]
        for way in ("auto", "search"):
            mine = [both[way] for both in found]
            errors = [run["error"] for run in mine]
            middle = [
                f"{np.median([r[key] for r in mine]):.0f}" for key in ("parameters", "seconds")
            ]
            each = ", ".join(f"{error:.4g}" for error in errors)
            cells = [name, way, each, f"{np.median(errors):.4g}", *middle]
            lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
