"""Look at measurements before any fit: a table, what will hurt a model, and a figure."""

from __future__ import annotations

import argparse
import os
import re
import sys
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from lfrtorch._support import tables
from lfrtorch._support.atomic import whole_file
from lfrtorch._support.errors import InputError
from lfrtorch._support.paths import real
from lfrtorch.cli import CONF
from lfrtorch.cli.composition import parsed
from lfrtorch.cli.errors import user_errors
from lfrtorch.cli.preview_words import parser
from lfrtorch.cli.words import translated
from lfrtorch.files.formats import open_table
from lfrtorch.files.glance import look_at
from lfrtorch.files.load import listed_files, stem_of
from lfrtorch.records import check_rate
from lfrtorch.reporting.survey_plots import survey_figure
from lfrtorch.survey.measurement import survey_measurement
from lfrtorch.survey.notes import examine

BLA, FILE = (CONF / name for name in ("bla/state_space.yaml", "data/file.yaml"))
"""Settings whose names the notes use."""

FIGURES = (".png", ".pdf", ".svg")


USES = {
    "data.path": "paths",
    "data.inputs": "inputs",
    "data.outputs": "outputs",
    "data.fs": "fs",
    "data.time": "time",
}
"""Where the words of other commands are kept."""

_SETTING = re.compile(r"[a-z_.]+=")  # what a word NAME=VALUE begins with


def launch(words: Sequence[str] | None = None) -> None:
    """The command line."""
    given = sys.argv[1:] if words is None else words
    data = [word for word in given if _SETTING.match(word) and not os.path.exists(word)]
    options = parser().parse_args([word for word in given if word not in data])
    with user_errors():
        for word in data:
            if word != "data=file":
                take(word, options)
        if not options.paths:
            raise InputError("no file is named; give its path, or data.path=FILE.")
        if options.fs is not None:
            check_rate("data.fs", options.fs)
        paths = listed_files(options.paths, "data.path")
        names = [place(path) for path in paths]
        for path, name in zip(paths, names, strict=True):
            own = name if names.count(name) == 1 else f"{name}{path.suffix}"
            show(path, options, figure_path(options.out, own, len(paths)))


def take(word: str, options: argparse.Namespace) -> None:
    """Read a word of other commands into the options.

    Raises:
        ValueError: one that is none of ``USES``, or is given already.
    """
    read = parsed(word)
    name = read.key_or_group
    if name not in USES:
        raise InputError(f"preview does not read {name}; it takes {', '.join(USES)}.")
    if read.is_sweep_override():
        raise InputError(f"for several values write {name}=[{read.get_value_string()}].")
    if getattr(options, USES[name]):
        raise InputError(f"{name} is given twice; a path alone is data.path, too.")
    value: Any = read.value()
    if value is not None:
        listed = value if isinstance(value, list) else [value]
        setattr(options, USES[name], value if name in ("data.fs", "data.time") else listed)


def place(path: Path) -> str:
    """A file's name with its folders below the working one, or all: files are called alike."""
    full, here = real(path), real(Path())
    folders = full.relative_to(here) if full.is_relative_to(here) else full.relative_to(full.anchor)
    return "_".join([*folders.parts[:-1], stem_of(path)])


def figure_path(out: Path | None, name: str, files: int) -> Path:
    """Where the figure of a file goes: ``out`` for one, beside it by the file's name for several.

    Raises:
        ValueError: an extension that is none of a figure.
    """
    if out is None:
        return Path(f"{name}_preview.png")
    if out.suffix.lower() not in FIGURES:
        raise InputError(f"--out is '{out}'; give a name that ends with {', '.join(FIGURES)}.")
    return out if files == 1 else out.with_stem(f"{out.stem}_{name}")


def show(path: Path, options: argparse.Namespace, figure: Path) -> None:
    """Print what a file holds, and draw it."""
    table = open_table(path)
    seen = look_at(table, options.inputs, options.outputs, time=options.time, fs=options.fs)
    found = survey_measurement(seen.u, seen.y, seen.fs, inputs=seen.inputs, outputs=seen.outputs)
    words = OmegaConf.create({"bla": OmegaConf.load(BLA), "data": OmegaConf.load(FILE)})
    sentences = [*seen.doubts]
    sentences += [translated(note.text, words) for note in examine(found, seen.u, seen.y)]
    remarks = [*seen.remarks]
    if seen.fs is None:
        remarks.append("no sampling frequency: give data.fs=HZ; frequencies are in cycles/sample")
    if not seen.inputs:
        remarks.append(
            "without data.inputs and data.outputs what lies between them is not looked at"
        )
    print(f"{path}: {len(seen.y)} samples{'' if seen.fs is None else f' at {seen.fs:.6g} Hz'}")
    for remark in remarks:
        print(f"  {remark}")
    if table.contents:
        listed = [list(one) for one in table.contents]
        print(f"\n{tables.table(['variable', 'shape', 'taken for'], listed)}")
    print(f"\n{found}\n")
    for sentence in sentences:
        print(textwrap.fill(sentence, 100, initial_indent="- ", subsequent_indent="  "))
    if not sentences:
        print("Nothing found that would hurt a model.")
    with whole_file(figure) as fresh:
        survey_figure(found, seen.spread(), path.name).savefig(fresh, dpi=110)
    print(f"\nFigure in {figure}\n")
