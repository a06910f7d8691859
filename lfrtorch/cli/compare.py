"""Runs side by side: one table, and one page with figures.

lfrtorch compare runs/study
lfrtorch compare runs/boucwen/* +bench=boucwen out=boucwen
"""

from __future__ import annotations

import os
from pathlib import Path

from omegaconf import DictConfig

from lfrtorch._support.errors import InputError, LfrtorchError, brief
from lfrtorch._support.paths import real
from lfrtorch.cli.composition import composed, started
from lfrtorch.cli.config import one_record
from lfrtorch.cli.quotes import quoted
from lfrtorch.cli.run_folder import OVERRIDES, words_of
from lfrtorch.records import Record
from lfrtorch.reporting import comparison


def launch() -> None:
    """The command; a word without a name is a folder."""
    started("compare", chosen, unnamed="folders")


def chosen(cfg: DictConfig) -> None:
    """Compare the runs that are named."""
    if not cfg.folders:
        raise InputError("no folder of runs is named; give one or several.")
    out = [] if cfg.out is None else [str(cfg.out)]
    record = None if cfg.get("data") is None else one_record(cfg)
    folders = [cfg.folders] if isinstance(cfg.folders, str) else cfg.folders
    run([Path(folder) for folder in folders], *out, record=record)


def _record_of_run(folder: Path) -> Record | None:
    """The record of a run's data; None of Python's runs, and if it is not there now."""
    if not (folder / OVERRIDES).is_file():
        return None
    try:
        return one_record(composed("config", [quoted(word) for word in words_of(folder)]))
    except (LfrtorchError, OSError) as error:
        print(
            f"note: the data of '{folder}' cannot be read ({brief(error)}), so the page shows no "
            "record; words of lfrtorch fit choose other data: data.path=FILE\n"
        )
        return None


def run(folders: list[Path], out: str | Path | None = None, record: Record | None = None) -> None:
    """Print the tables, and write the files: by default where all folders lie."""
    for folder in folders:
        if not folder.is_dir():
            raise InputError(f"'{folder}' is no folder of runs; give one or several.")
    found = comparison.compare(folders)
    target = Path(os.path.commonpath([real(path) for path in folders]) if out is None else out)
    records = {one.name: record or _record_of_run(one.runs[0].folder) for one in found}
    comparison.write(found, target, records)
    print("\n\n".join(map(str, found)))
    print(f"\nFigures and all runs: {target / 'comparison.html'}, comparison.md and comparison.csv")
