"""Look at measurements before any fit: a table, what will hurt a model, and a figure."""

from __future__ import annotations

import argparse
import glob
import os
import re
import sys
import textwrap
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from omegaconf import OmegaConf

from lfrtorch._support import tables
from lfrtorch._support.atomic import whole_file
from lfrtorch._support.errors import InputError
from lfrtorch._support.paths import expanded, real
from lfrtorch._support.types import Array, Integers
from lfrtorch.cli import CONF
from lfrtorch.cli.composition import parsed
from lfrtorch.cli.errors import user_errors
from lfrtorch.cli.preview_words import parser
from lfrtorch.cli.words import translated
from lfrtorch.files.formats import BLOCK, Table, open_table
from lfrtorch.files.load import stem_of
from lfrtorch.files.time_stamps import UnevenError, column_sampling, is_time
from lfrtorch.records import Channel, check_largest, check_rate
from lfrtorch.reporting.survey_plots import survey_figure
from lfrtorch.survey.measurement import Survey, survey_measurement
from lfrtorch.survey.notes import examine
from lfrtorch.survey.signal import SignalSurvey

LARGEST = 2**22
"""Values that are read of a file, of all channels together: what comes after is not looked at."""

RATE = 0.01
"""Relative difference of two sampling frequencies that are the same."""

THOUSANDS = {1e3: "milliseconds", 1e6: "microseconds", 1e9: "nanoseconds"}

BLA, FILE = (CONF / name for name in ("bla/state_space.yaml", "data/file.yaml"))
"""Settings whose names the notes use."""

FIGURES = (".png", ".pdf", ".svg")


class Roles(NamedTuple):
    """Columns of a table by their use; without roles all signals are among the outputs."""

    inputs: tuple[int, ...]
    outputs: tuple[int, ...]
    time: int | None


class Gaps(NamedTuple):
    """Samples that follow a gap in the times, and how many are missing in each."""

    first: Integers
    missing: Integers


NO_GAPS = Gaps(np.zeros(0, np.int64), np.zeros(0, np.int64))

USES = {
    "data.path": "paths",
    "data.inputs": "inputs",
    "data.outputs": "outputs",
    "data.fs": "fs",
    "data.time": "time",
}
"""Where the words of other commands are kept."""

SETTING = re.compile(r"[a-z_.]+=")
"""What a word NAME=VALUE begins with."""


def launch(words: Sequence[str] | None = None) -> None:
    """The command line."""
    given = sys.argv[1:] if words is None else words
    data = [word for word in given if SETTING.match(word) and not os.path.exists(word)]
    options = parser().parse_args([word for word in given if word not in data])
    with user_errors():
        for word in data:
            if word != "data=file":
                take(word, options)
        if not options.paths:
            raise InputError("no file is named; give its path, or data.path=FILE.")
        if options.fs is not None:
            check_rate("data.fs", options.fs)
        paths = matching(options.paths)
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
        if name == "data.path" and not all(isinstance(path, str) for path in listed):
            raise InputError(f"data.path is {value}; give a file, a pattern or a list of these.")
        setattr(options, USES[name], value if name in ("data.fs", "data.time") else listed)


def matching(patterns: Sequence[str]) -> list[Path]:
    """The files that are named or match a pattern, each once.

    Raises:
        ValueError: a pattern that no file matches.
    """
    found: dict[Path, None] = {}
    for pattern in patterns:
        path = expanded(pattern)
        paths = [path] if path.exists() else sorted(map(Path, glob.glob(str(path))))
        if not paths and glob.has_magic(pattern):
            raise InputError(f"no file matches '{pattern}'.")
        found |= dict.fromkeys(paths or [path])
    return list(found)


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
    roles, remarks = chosen(table, options)
    wanted = [*roles.inputs, *roles.outputs]
    signals, more = read(table, wanted if roles.time is None else [*wanted, roles.time])
    fs, sentences, gaps = options.fs, [], NO_GAPS
    for name, said in table.rates.items():
        remarks.append(f"{name!r} says {said:.6g} Hz")
        fs = said if fs is None else fs
    if roles.time is not None:
        fs, remark, sentences, gaps = clock(signals[:, -1], table.columns[roles.time], fs)
        remarks.append(remark)
        signals = signals[:, :-1]
    remarks = [*table.notes, *remarks]
    if more:
        remarks.append(f"the first {len(signals)} samples are read, and no more")
    for i, signal in zip(wanted, signals.T, strict=True):
        known = np.abs(signal[np.isfinite(signal)])
        check_largest(f"'{path}': {table.columns[i].name!r}", known.max(initial=0.0))
    if fs is not None:
        check_rate(f"'{path}': the sampling frequency", fs)
    count = len(roles.inputs)
    u, y = signals[:, :count], signals[:, count:]
    found = survey_measurement(
        u,
        y,
        fs,
        inputs=[table.columns[i] for i in roles.inputs],
        outputs=[table.columns[i] for i in roles.outputs],
    )
    words = OmegaConf.create({"bla": OmegaConf.load(BLA), "data": OmegaConf.load(FILE)})
    sentences += [translated(note.text, words) for note in examine(found, u, y)]
    if found.fs is None:
        remarks.append("no sampling frequency: give data.fs=HZ; frequencies are in cycles/sample")
    if not roles.inputs:
        remarks.append(
            "without data.inputs and data.outputs what lies between them is not looked at"
        )
    print(f"{path}: {len(signals)} samples{'' if found.fs is None else f' at {found.fs:.6g} Hz'}")
    for remark in remarks:
        print(f"  {remark}")
    if table.contents:
        listed = [list(one) for one in table.contents]
        print(f"\n{tables.table(['variable', 'shape', 'taken for'], listed)}")
    print(f"\n{numbers(found)}\n")
    for sentence in sentences:
        print(textwrap.fill(sentence, 100, initial_indent="- ", subsequent_indent="  "))
    if not sentences:
        print("Nothing found that would hurt a model.")
    with whole_file(figure) as fresh:
        survey_figure(found, spread(signals, gaps), path.name).savefig(fresh, dpi=110)
    print(f"\nFigure in {figure}\n")


def chosen(table: Table, options: argparse.Namespace) -> tuple[Roles, list[str]]:
    """The columns by their use, and remarks on the choice.

    Raises:
        ValueError: a column that is not there or has two uses, or none of numbers.
    """
    inputs = table.find(options.inputs, "data.inputs") if options.inputs else ()
    outputs = table.find(options.outputs, "data.outputs") if options.outputs else ()
    time = table.find(options.time, "data.time") if options.time is not None else ()
    named = [*inputs, *outputs, *time]
    twice = [table.headers[i] for i in dict.fromkeys(named) if named.count(i) > 1]
    if twice or len(time) > 1:
        raise InputError(
            f"'{table.path}': {', '.join(map(repr, twice)) or 'data.time'} stands for several; "
            "give every column one use, and one column of times."
        )
    heads, remarks = {}, list[str]()
    if not table.contents:
        remarks += [f"left out: {name!r} {reason}" for name, reason in table.refused.items()]
    rest = sorted(set(range(len(table.columns))) - set(named))
    if table.lengths:
        counted = Counter(table.lengths[i] for i in named or rest)
        usual = max(counted, key=lambda T: (counted[T], T), default=0)
        short = [table.columns[i].name for i in rest if table.lengths[i] != usual]
        rest = [i for i in rest if table.lengths[i] == usual]
        if short:
            remarks.append(f"left out: {', '.join(short)}, of other lengths than {usual} samples")
    for i in rest:
        try:
            heads[i] = next(table.blocks([i], BLOCK))[:, 0]
        except InputError as error:
            remarks.append(f"left out: {error}")
    if not time:
        time = clocks(table, heads)[:1]
    others = tuple(i for i in heads if i not in time)
    if not inputs and not outputs:
        outputs = others
    elif not inputs or not outputs:
        side = "outputs" if inputs else "inputs"
        names = ", ".join(table.columns[i].name for i in others)
        remarks.append(f"{side}: {names}, all other columns")
        inputs, outputs = inputs or others, outputs or others
    if not outputs:
        lacking = "no column is left for the outputs" if inputs else "there is no column to show"
        raise InputError(f"'{table.path}': {lacking}; it has {table.listed}.")
    return Roles(inputs, outputs, time[0] if time else None), remarks


def clocks(table: Table, heads: Mapping[int, Array]) -> tuple[int, ...]:
    """Columns that look like times, the likeliest first: by name, even ones, sample numbers."""
    ranked = []
    for i, head in heads.items():
        named = is_time(table.columns[i])
        try:
            grid = column_sampling(head, table.columns[i])
        except UnevenError:
            even, counter = False, False
        else:
            even, counter = not grid.gaps.size, not named and grid.fs == 1
        if named or even:
            ranked.append((counter, not named, i))
    return tuple(i for *_, i in sorted(ranked))


def spread(signals: Array, gaps: Gaps) -> Array:
    """Signals (T, n) with NaN for the samples that are missing, unless these are too many."""
    if gaps.missing.sum() > LARGEST:
        return signals
    return np.insert(signals, np.repeat(gaps.first, gaps.missing), np.nan, axis=0)


def clock(
    times: Array, channel: Channel, fs: float | None
) -> tuple[float | None, str, list[str], Gaps]:
    """The sampling frequency, what a column of times was taken for, what is wrong, and its gaps."""
    name = f"'{channel.name}'"
    try:
        grid = column_sampling(times, channel)
    except UnevenError as error:
        said = f"the time column {name} {error}, at sample {error.sample}; {error.remedy}."
        return fs, f"{name} is taken for the time", [said], NO_GAPS
    if grid.fs == 1 and not is_time(channel):
        return fs, f"{name} is taken for sample numbers", [], NO_GAPS
    sentences, gaps = [], Gaps(grid.gaps, grid.missing)
    if grid.gaps.size:
        sentences.append(
            f"the times in {name} have {grid.gaps.size} gap(s) of {grid.missing.sum()} sample(s) "
            f"in all, the first after sample {grid.gaps[0] - 1}: data.gaps=split cuts the record "
            "there."
        )
    remark = f"{name} is taken for {grid}"
    if fs is None or abs(fs / grid.fs - 1) < max(RATE, grid.uncertainty):
        return fs or grid.fs, remark, sentences, gaps
    unit = next((u for f, u in THOUSANDS.items() if abs(fs / grid.fs / f - 1) < RATE), None)
    sentences.append(
        f"fs looks like {grid.fs:.6g} Hz, not {fs:g}, by the times in {name}"
        + (f", unless they are in {unit}." if unit else "; correct one of them.")
    )
    return fs, remark, sentences, gaps


def read(table: Table, wanted: Sequence[int]) -> tuple[Array, bool]:
    """The first samples (T, wanted), and whether there are more."""
    most = LARGEST // len(wanted)
    blocks, T = [], 0
    for block in table.blocks(wanted):
        blocks.append(block[: most - T])
        T += len(block)
        if most < T:
            break
    signals = np.concatenate(blocks)
    present = np.flatnonzero(~np.isnan(signals).all(axis=1))
    if not present.size:
        raise InputError(f"'{table.path}' has no values in the columns to show.")
    return signals[: present[-1] + 1], most < T  # spreadsheets end in empty lines


def numbers(found: Survey) -> str:
    """The table: a row a signal."""
    unit = "1/sample" if found.fs is None else "Hz"
    head = ["signal", "use", "samples", "missing", "mean", "rms", "min", "max", "% at min"]
    head += ["% at max", "run", f"from {unit}", f"to {unit}", "period", "periods"]
    rows = [row(one, found) for one in found.signals]
    text = tables.table([*head, "noise"], rows, digits=4)
    methods = {one.method for one in found.signals}
    legend = [
        "rms: about the mean; run: longest at an extreme; from, to: the band of 99 % of the power."
    ]
    if "periods" in methods:
        legend.append("Noise: the scatter from period to period.")
    if "spectrum" in methods:
        follows = " that follows no input" if found.inputs else ""
        legend.append(f"Noise ~: a guess from the quietest part of the spectrum{follows}.")
    return f"{text}\n{' '.join(legend)}"


def row(one: SignalSurvey, found: Survey) -> list[str | float | None]:
    """What the table says of a signal."""
    use = "" if not found.inputs else "input" if one in found.inputs else "output"
    ends = one.minimum, one.maximum
    factor, unit = tables.engineering([one.rms], one.channel.unit)
    noise = None if one.noise is None else tables.number(factor * one.noise, 4)
    return [
        str(one.channel._replace(unit=unit)),
        use,
        one.samples,
        one.missing,
        factor * one.mean,
        factor * one.rms,
        *(factor * end.value for end in ends),
        *(100 * end.samples / one.samples for end in ends),
        max(end.run for end in ends),
        *(one.band or (None, None)),
        one.period,
        None if one.period is None else one.samples / one.period,
        f"~ {noise}" if one.method == "spectrum" else noise,
    ]
