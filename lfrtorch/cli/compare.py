"""Runs side by side: one table, and one page with figures.

lfrtorch compare runs/study
lfrtorch compare runs/boucwen/* +bench=boucwen out=boucwen
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from lfrtorch._support.errors import InputError, LfrtorchError, brief
from lfrtorch._support.paths import real

if TYPE_CHECKING:
    from lfrtorch.records import Record

ABOUT = """Compare runs: a table on the terminal, and comparison.html, .md and .csv.

    lfrtorch compare runs/study
    lfrtorch compare runs/study runs/boucwen/DATE out=compared
    lfrtorch compare runs/study +bench=boucwen

All runs in the folders, and in those below them, that came to their end are read. Runs of different
data have tables of their own.

  out=DIR   folder of the files. Default: the one that all folders that are given lie in
  +bench=NAME or data=file data.path=FILE ..   as in lfrtorch fit. The page shows the first
            validation record, or the first test if there is none, simulated by the best models.
            Default: the data of the best run
"""


def parser() -> argparse.ArgumentParser:
    """Reads the command line."""
    found = argparse.ArgumentParser(
        prog=sys.argv[0], description=ABOUT, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    found.add_argument("words", nargs="+", metavar="FOLDER", help="of runs, or NAME=VALUE")
    return found


def launch() -> None:
    """The command line."""
    from lfrtorch.cli.composition import check_words
    from lfrtorch.cli.errors import user_errors

    words = parser().parse_args().words
    settings = [word for word in words if _is_setting(word)]
    outs = [word.removeprefix("out=") for word in settings if word.startswith("out=")]
    data = [word for word in settings if not word.startswith("out=")]
    with user_errors():
        check_words("evaluate", data)
        record = _record("evaluate", data) if data else None
        run([Path(word) for word in words if word not in settings], *outs[-1:], record=record)


def _is_setting(word: str) -> bool:
    """Whether it is NAME=VALUE, and no folder: those of a study have such names, as a/nn=5."""
    name, given, _ = word.partition("=")
    return bool(given) and "/" not in name and not Path(word).is_dir()


def _record(command: str, words: Sequence[str]) -> Record | None:
    """The first record of the data that words choose which was not fitted."""
    from lfrtorch.cli.composition import composed
    from lfrtorch.cli.config import one_record
    from lfrtorch.cli.quotes import quoted

    return one_record(composed(command, [quoted(word) for word in words]))


def _record_of_run(folder: Path) -> Record | None:
    """The record of a run's data; None of Python's runs, and if it is not there now."""
    from lfrtorch.cli.run_folder import OVERRIDES, words_of

    if not (folder / OVERRIDES).is_file():
        return None
    try:
        return _record("config", words_of(folder))
    except (LfrtorchError, OSError) as error:
        print(
            f"note: the data of '{folder}' cannot be read ({brief(error)}), so the page shows no "
            "record; words of lfrtorch fit choose other data: data=file data.path=FILE\n"
        )
        return None


def run(folders: list[Path], out: str | Path | None = None, record: Record | None = None) -> None:
    """Print the tables, and write the files.

    Args:
        folders: of the runs, or with runs in them.
        out: of the files. Default: the folder that all lie in.
        record: that the best models simulate on the page. Default: that of the best run's data.
    """
    from lfrtorch.reporting import comparison

    for folder in folders or [Path()]:
        if not (folders and folder.is_dir()):
            raise InputError(f"'{folder}' is no folder of runs; give one or several.")
    found = comparison.compare(folders)
    target = Path(os.path.commonpath([real(path) for path in folders]) if out is None else out)
    records = {one.name: record or _record_of_run(one.runs[0].folder) for one in found}
    comparison.write(found, target, records)
    print("\n\n".join(map(str, found)))
    print(f"\nFigures and all runs: {target / 'comparison.html'}, comparison.md and comparison.csv")
