"""A trained model on new inputs: checkpoint and files -> simulated outputs, scores.

lfrtorch simulate checkpoint=runs/run new.csv out=predicted.csv
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from omegaconf import DictConfig

import lfrtorch
from lfrtorch._support import tables
from lfrtorch._support.atomic import refuse_existing
from lfrtorch._support.errors import InputError
from lfrtorch._support.paths import expanded, real
from lfrtorch.cli.checks import check_simulation
from lfrtorch.cli.errors import user_errors
from lfrtorch.files.load import listed_files
from lfrtorch.files.stream import FileStream
from lfrtorch.files.writer import FORMATS
from lfrtorch.reporting.evaluation import of_samples
from lfrtorch.use.file_simulation import (
    Simulated,
    Start,
    estimated_start,
    measured_start,
    notes_on,
    simulate_file,
    start_at_rest,
)


def simulate(cfg: DictConfig) -> None:
    """Simulate every file, write the outputs, and print the scores."""
    check_simulation(cfg)
    pairs = targets(cfg)
    model = lfrtorch.load(str(cfg.checkpoint))
    print(introduced(cfg.checkpoint, model))
    check_rate(cfg, model)
    rows = []
    for path, out in pairs:
        clock = time.perf_counter()
        with about(path):
            stream = FileStream(
                path, model.inputs, model.outputs, model.fs,
                inputs=cfg.data.inputs, outputs=cfg.data.outputs,
                time=cfg.data.time, find_time=cfg.data.fs is None,
            )  # fmt: skip
            for note in filter(None, (*stream.table.notes, stream.note)):
                print(f"note: '{path}': {note}")
            if not stream.y:
                missing = ", ".join(stream.missing)
                print(f"note: '{path}' has no column {missing}, so nothing is scored")
            start = start_state(cfg, model, stream)
            if start.note:
                print(start.note)
            result = simulate_file(model, stream, out, start, asked=cfg.skip or 0)
        print(
            f"{out}: {result.samples} samples, {tables.quantity(time.perf_counter() - clock, 's')}"
        )
        for note in notes_on(result, model, estimated=cfg.start == "estimated"):
            print(f"note: {note}")
        rows += scored(path, model, result) if stream.y else []
    if rows:
        head = ["file", "output", "unit", "scored", "RMSE", "NRMSE (%)"]
        print(f"\n{tables.table(head, rows)}")


def check_rate(cfg: DictConfig, model: lfrtorch.Model) -> None:
    """Refuse a sampling frequency that differs from the model's."""
    if cfg.data.fs is not None and not np.isclose(cfg.data.fs, model.fs):
        raise InputError(
            f"data.fs is {cfg.data.fs} Hz and the model's sampling frequency {model.fs:g} Hz; "
            "resample the file."
        )


def start_state(cfg: DictConfig, model: lfrtorch.Model, stream: FileStream) -> Start:
    """The start state that the settings ask for."""
    if cfg.start == "given":
        return Start(np.array(cfg.x0, dtype=np.float64), cfg.skip or 0)
    if cfg.start == "zero":
        return start_at_rest(stream, skip=cfg.skip)
    if cfg.start == "measured":
        return measured_start(model, stream, skip=cfg.skip)
    return estimated_start(model, stream, samples=cfg.estimate, skip=cfg.skip)


def scored(path: Path, model: lfrtorch.Model, result: Simulated) -> list[list[tables.Cell]]:
    """Rows of the table of scores, one for each output."""
    scores = result.scores
    counted = [of_samples(count, result.samples, result.skip) for count in scores.samples.tolist()]
    return [
        [path.name, c.name, c.unit, shown, scores.rmse[i], tables.in_percent(scores.nrmse[i])]
        for i, (c, shown) in enumerate(zip(model.outputs, counted, strict=True))
    ]


def introduced(folder: str, model: lfrtorch.Model) -> str:
    """A line with channels, rate and sizes."""
    sizes = ", ".join(f"{name} {size}" for name, size in model.sizes.items() if size)
    u, y = (", ".join(map(str, channels)) for channels in (model.inputs, model.outputs))
    return f"{folder}: {u} -> {y} at {model.fs:g} Hz, {sizes}"


def targets(cfg: DictConfig) -> list[tuple[Path, Path]]:
    """Pairs of each file that is read, and the file that is written for it."""
    paths = listed_files(cfg.data.path, "data.path")
    out = expanded(str(cfg.out))
    if out.is_dir() or not out.suffix:
        # A compressed file gives its name without the last ending.
        stems = [Path(path.name.removesuffix(".gz")).stem for path in paths]
        twice = next((stem for stem in stems if stems.count(stem) > 1), None)
        if twice is not None:
            raise InputError(
                f"several files are called '{twice}', and would be written to one in '{out}'; "
                "simulate them one by one."
            )
        pairs = [
            (path, out / f"{stem}.{cfg.format}") for path, stem in zip(paths, stems, strict=True)
        ]
    elif out.suffix.lower() not in FORMATS:
        raise InputError(f"out is '{out}'; give a file of {', '.join(FORMATS)}, or a folder.")
    elif len(paths) > 1:
        raise InputError(f"{len(paths)} files cannot be written to one, '{out}'; give a folder.")
    else:
        pairs = [(paths[0], out)]
    for path, file in pairs:
        if real(file) == real(path):
            raise InputError(f"'{file}' is the file that is read; give another name to out.")
        if not cfg.overwrite:
            refuse_existing(file, "overwrite=true")
    return pairs


@contextmanager
def about(path: Path) -> Iterator[None]:
    """Context that adds the file's name to messages without it."""
    try:
        yield
    except InputError as error:
        if f"'{path}'" in str(error):
            raise
        raise InputError(f"'{path}': {error}") from error


main = user_errors()(simulate)
"""The command."""
