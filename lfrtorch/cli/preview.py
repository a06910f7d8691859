"""Look at measurements before any fit: a table, faults that will hurt a model, and a figure."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig, ListConfig

from lfrtorch._support import tables
from lfrtorch._support.atomic import whole_file
from lfrtorch._support.errors import InputError
from lfrtorch._support.paths import real
from lfrtorch.cli.checks import check_preview
from lfrtorch.cli.errors import as_words, user_errors
from lfrtorch.data.periods import find_period
from lfrtorch.data.records import Record, check_rate
from lfrtorch.files.formats import open_table
from lfrtorch.files.load import EVERYTHING, is_fraction, listed_files, stem_of
from lfrtorch.files.measurement import Measurement, look_at
from lfrtorch.linear.record_start import try_starts
from lfrtorch.reporting.survey_plots import survey_figure
from lfrtorch.survey.measurement import survey_measurement
from lfrtorch.survey.notes import examine

FIGURES = (".png", ".pdf", ".svg")


@user_errors()
def main(cfg: DictConfig) -> None:
    """Look at each file."""
    check_preview(cfg)
    data = cfg.data
    if data.fs is not None:
        check_rate("fs", data.fs)
    paths = listed_files(data.path, "path")
    records = {EVERYTHING, *map(stem_of, paths)}
    for use in ("validation", "test"):
        of_use = data[use] if isinstance(data[use], ListConfig) else [data[use]]
        if others := [one for one in of_use if isinstance(one, str) and one not in records]:
            paths += [path for path in listed_files(others, use) if path not in paths]
    names = [place(path) for path in paths]
    for path, name in zip(paths, names, strict=True):
        own = name if names.count(name) == 1 else f"{name}{path.suffix}"
        show(path, data, figure_path(cfg.out, own, len(paths)))


def place(path: Path) -> str:
    """A file's name with its folders: from the working directory on, if the file is below it."""
    full, here = real(path), real(Path())
    folders = full.relative_to(here) if full.is_relative_to(here) else full.relative_to(full.anchor)
    return "_".join([*folders.parts[:-1], stem_of(path)])


def figure_path(asked: str | None, name: str, files: int) -> Path:
    """Path of the figure of a file: ``out`` for one file, with the file's name for several."""
    if asked is None:
        return Path(f"{name}_preview.png")
    out = Path(asked)
    if out.suffix.lower() not in FIGURES:
        raise InputError(f"out is '{out}'; give a name that ends with {', '.join(FIGURES)}.")
    return out if files == 1 else out.with_stem(f"{out.stem}_{name}")


def show(path: Path, data: DictConfig, figure: Path) -> None:
    """Print the contents of a file, and draw it."""
    table = open_table(path)
    seen = look_at(table, data.inputs, data.outputs, time=data.time, fs=data.fs)
    found = survey_measurement(seen.u, seen.y, seen.fs, inputs=seen.inputs, outputs=seen.outputs)
    sentences = [*seen.doubts, *(note.text for note in examine(found, seen.u, seen.y))]
    remarks = [*seen.notes]
    if seen.fs is None:
        remarks.append("no sampling frequency: give fs=HZ; frequencies are in cycles/sample")
    if not seen.inputs:
        remarks.append("without inputs and outputs what lies between them is not looked at")
    if data.start == "auto":
        remarks += beginning(seen, data.test)
    print(f"{path}: {len(seen.y)} samples{'' if seen.fs is None else f' at {seen.fs:.6g} Hz'}")
    for remark in remarks:
        print(f"  {remark}")
    if table.contents:
        listed = [list(one) for one in table.contents]
        print(f"\n{tables.table(['variable', 'shape', 'taken for'], listed)}")
    print(f"\n{found}\n")
    for sentence in map(as_words, sentences):
        print(textwrap.fill(sentence, 100, initial_indent="- ", subsequent_indent="  "))
    if not sentences:
        print("Nothing found that would hurt a model.")
    with whole_file(figure) as fresh:
        survey_figure(found, np.hstack([seen.u, seen.y]), path.name).savefig(fresh, dpi=110)
    print(f"\nFigure in {figure}\n")


def beginning(seen: Measurement, test: Any) -> list[str]:
    """The start of a record that a fit would choose by linear models, in words."""
    T = len(seen.y) - (round(test * len(seen.y)) if is_fraction(test) else 0)
    u, y = seen.u[:T], seen.y[:T]
    if not seen.inputs or not np.isfinite(u).all() or find_period(u) is not None:
        return []
    try:
        return [str(try_starts(Record(u, y, fs=seen.fs or 1.0, valid=np.isfinite(y))))]
    except InputError:
        return []
