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
    from lfrtorch.reporting.comparison import Comparison

ABOUT = """Compare runs: a table on the terminal, and comparison.html, .md and .csv.

    lfrtorch compare runs/study
    lfrtorch compare runs/study runs/boucwen/DATE out=compared
    lfrtorch compare runs/study +bench=boucwen
    lfrtorch compare runs/run data=file data.path=x.csv data.inputs=[u] data.outputs=[y] data.fs=750

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
    from lfrtorch.cli.errors import user_errors

    words = parser().parse_args().words
    outs = [word.removeprefix("out=") for word in words if word.startswith("out=")]
    with user_errors():
        settings = [word for word in words if is_setting(word) and not word.startswith("out=")]
        folders = [Path(word) for word in words if not is_setting(word)]
        run(folders, *outs[-1:], record=chosen(settings) if settings else None)


def is_setting(word: str) -> bool:
    """Whether it is NAME=VALUE, and no folder: those of a study have such names, as a/nn=5."""
    name, given, _ = word.partition("=")
    return bool(given) and "/" not in name and not Path(word).is_dir()


def chosen(words: Sequence[str]) -> Record | None:
    """The record of the data that words choose, as those of ``lfrtorch fit``."""
    from lfrtorch.cli.composition import check_words, composed
    from lfrtorch.cli.config import one_record
    from lfrtorch.cli.quotes import quoted

    check_words("evaluate", words)
    return one_record(composed("evaluate", [quoted(word) for word in words]))


def of_best_run(compared: Comparison) -> Record | None:
    """The record of the data of the best run; None of Python's runs, and if it is not there now."""
    from lfrtorch.cli.composition import composed
    from lfrtorch.cli.config import one_record
    from lfrtorch.cli.quotes import quoted
    from lfrtorch.cli.run_folder import OVERRIDES, words_of

    folder = compared.runs[0].folder
    if not (folder / OVERRIDES).is_file():
        return None
    try:
        return one_record(composed("config", [quoted(word) for word in words_of(folder)]))
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

    for folder in folders:
        if not folder.is_dir():
            raise InputError(f"'{folder}' is no folder; give those of runs.")
    if not folders:
        raise InputError("no folder is given; give those of runs.")
    found = comparison.compare(folders)
    target = Path(os.path.commonpath([real(path) for path in folders]) if out is None else out)
    records = {one.name: record or of_best_run(one) for one in found}
    comparison.write(found, target, records)
    print("\n\n".join(map(str, found)))
    print(f"\nFigures and all runs: {target / 'comparison.html'}, comparison.md and comparison.csv")
