"""Runs side by side: one table, and one page with figures.

lfrtorch compare runs/study
lfrtorch compare runs/boucwen/* out=boucwen
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from lfrtorch._support.errors import InputError

ABOUT = """Compare runs: a table on the terminal, and comparison.html, .md and .csv.

    lfrtorch compare runs/study
    lfrtorch compare runs/study runs/boucwen/DATE out=compared

All runs in the folders, and in those below them, that came to their end are read. Runs of different
data have tables of their own.

  out=DIR   folder of the files. Default: the one that all folders that are given lie in
"""


def parser() -> argparse.ArgumentParser:
    """Reads the command line."""
    found = argparse.ArgumentParser(
        prog=sys.argv[0], description=ABOUT, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    found.add_argument("words", nargs="+", metavar="FOLDER", help="of runs, or out=DIR")
    return found


def launch() -> None:
    """The command line."""
    from lfrtorch.cli.errors import user_errors

    words = parser().parse_args().words
    outs = [word.removeprefix("out=") for word in words if word.startswith("out=")]
    with user_errors():
        run([Path(word) for word in words if not word.startswith("out=")], *outs[-1:])


def run(folders: list[Path], out: str | Path | None = None) -> None:
    """Print the tables, and write the files."""
    from lfrtorch.reporting import comparison

    for folder in folders:
        if not folder.is_dir():
            raise InputError(f"'{folder}' is no folder; give those of runs.")
    if not folders:
        raise InputError("no folder is given; give those of runs.")
    found = comparison.compare(folders)
    target = Path(os.path.commonpath([path.resolve() for path in folders]) if out is None else out)
    comparison.write(found, target)
    print("\n\n".join(map(str, found)))
    print(f"\nFigures and all runs: {target / 'comparison.html'}, comparison.md and comparison.csv")
