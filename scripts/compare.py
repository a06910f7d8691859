"""One table of the runs in folders, the least validation error first.

    python scripts/compare.py runs/study runs/boucwen/DATE

All runs that came to their end in the folders and below them are read, by their ``metrics.json``.
Choose by the validation errors: the tests beside them are for the one model that is chosen.
"""

import json
import math
import os
import sys
from pathlib import Path
from typing import Any

from lfrtorch._support.tables import Cell, quantity, table


def main(folders: list[str]) -> None:
    """Print a table for each set of data."""
    files = sorted({file for folder in folders for file in Path(folder).rglob("metrics.json")})
    if not files:
        sys.exit("error: no run came to its end there; give folders with metrics.json.")
    runs = [(file.parent, read(file)) for file in files]
    root = os.path.commonpath([folder.parent for folder, _ in runs])
    for bench in dict.fromkeys(run["bench"] for _, run in runs):
        own = [(os.path.relpath(f, root), run) for f, run in runs if run["bench"] == bench]
        units = {score["unit"] for _, run in own for score in run["scores"].values()}
        unit = units.pop() if len(units) == 1 else ""
        unit = f" ({unit})" if unit and "," not in unit else ""  # of several it is relative
        print(f"{bench}: RMSE{unit}\n\n{table(*rows(own))}\n")


def read(file: Path) -> dict[str, Any]:
    """What a run wrote of itself; other files end the program with a message."""
    try:
        run = json.loads(file.read_text(encoding="utf-8"))
        if not {"bench", "validation", "scores", "fit", "parameters_net"} <= run.keys():
            raise ValueError
    except (OSError, ValueError, AttributeError):
        sys.exit(f"error: '{file}' is not of a run; leave its folder out, or move it away.")
    return run


def rows(runs: list[tuple[str, dict[str, Any]]]) -> tuple[list[str], list[list[Cell]]]:
    """Head and rows; a star marks runs that none with as few parameters beats."""

    def error(run: dict[str, Any]) -> float:
        found = run["validation"]["rmse"]
        return math.inf if found is None else found

    tests = list(dict.fromkeys(name for _, run in runs for name in run["scores"]))
    least, starred = math.inf, set[str]()
    for name, run in sorted(runs, key=lambda one: (one[1]["parameters_net"], error(one[1]))):
        if error(run) < least:
            least = error(run)
            starred.add(name)
    head = ["run", "", "parameters", "validation", "linear", *tests, "time", "outcome"]
    body: list[list[Cell]] = [
        [
            name,
            "*" if name in starred else "",
            run["parameters_net"],
            run["validation"]["rmse"],
            run["validation"]["lti_rmse"],
            *(run["scores"].get(test, {}).get("rmse") for test in tests),
            quantity(run["fit"]["seconds"], "s"),
            run["fit"]["reason"],
        ]
        for name, run in sorted(runs, key=lambda one: error(one[1]))
    ]
    return head, body


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit((__doc__ or "").strip())
    main(sys.argv[1:])
