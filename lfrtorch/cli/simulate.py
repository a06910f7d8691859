"""A trained model on new inputs: checkpoint and files -> simulated outputs, scores.

lfrtorch simulate checkpoint=runs/run/DATE data.path=new.csv out=predicted.csv
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import hydra
import numpy as np
from omegaconf import DictConfig, ListConfig

import lfrtorch
from lfrtorch._support import checkpoint, tables
from lfrtorch._support.atomic import refuse_existing, whole_file
from lfrtorch._support.checks import integer, number
from lfrtorch._support.errors import InputError
from lfrtorch._support.paths import expanded, real
from lfrtorch._support.types import Array
from lfrtorch.cli import CONF
from lfrtorch.cli.composition import take_words
from lfrtorch.cli.errors import user_errors
from lfrtorch.cli.hydra_versions import MAIN
from lfrtorch.cli.words import translated
from lfrtorch.files.load import listed_files
from lfrtorch.files.stream import Block, FileStream
from lfrtorch.files.writer import FORMATS, table_writer
from lfrtorch.metrics import BlockScores
from lfrtorch.periods import find_period, find_transient
from lfrtorch.reporting.scores import finite, of_samples
from lfrtorch.score_window import PART, WINDOW, score_window, warm_up

BEGINNING = 100
"""Samples in which the transient of a wrong start state would be seen."""

TRANSIENT = 3.0
"""Error there over that of the rest above which it is."""

LOOKED_AT = 1_000_000
"""Most samples of a file whose input is looked at for a period."""

FAR = 6.0
"""Standard deviations of the training input that Gaussian noise and most signals stay within."""


def simulate(cfg: DictConfig) -> None:
    """Simulate every file, write what comes out, and print the scores."""
    require(cfg)
    pairs = targets(cfg)
    model = opened(str(cfg.checkpoint))
    print(introduced(str(cfg.checkpoint), model))
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
                print(f"note: '{path}': {translated(note, cfg)}")
            if not stream.y:
                missing = ", ".join(stream.missing)
                print(f"note: '{path}' has no column {missing}, so nothing is scored")
            x0, skip = start_state(cfg, model, stream)
            result = written(model, stream, x0, out, skip, cfg.skip or 0)
        print(
            f"{out}: {result.samples} samples, {tables.quantity(time.perf_counter() - clock, 's')}"
        )
        for note in noted(result, model, cfg):
            print(f"note: {note}")
        rows += scored(path, model, result) if stream.y else []
    if rows:
        head = ["file", "output", "unit", "scored", "RMSE", "NRMSE (%)"]
        print(f"\n{tables.table(head, rows)}")


class Written(NamedTuple):
    """What is known of a file that was simulated.

    Args:
        samples, skip: written, and how many at the beginning are not scored.
        scores: of measured outputs after the skipped samples.
        settled: the same without the first ``BEGINNING`` of those, either.
        peaks: largest inputs about the operating point, in standard deviations of the model's
            training inputs, (nu,).
    """

    samples: int
    skip: int
    scores: BlockScores
    settled: BlockScores
    peaks: Array


def written(
    model: lfrtorch.Model,
    stream: FileStream,
    x0: Array | None,
    out: Path,
    skip: int,
    asked: int,
) -> Written:
    """Simulate a file block by block into another.

    Args:
        model, stream, x0, out: what is simulated, from where and to where.
        skip: samples that are not scored.
        asked: that the user wants to be skipped.
    """
    names = [channel.name for channel in model.outputs]
    scores, settled = (BlockScores(len(names), skip + more) for more in (0, BEGINNING))
    first, peaks = 0, np.zeros(len(model.inputs))
    read: list[Block] = []

    def inputs() -> Iterator[Array]:
        for block in stream.blocks():
            read[:] = [block]
            yield block.u

    with whole_file(out) as fresh, table_writer(fresh) as write:
        for y_hat in lfrtorch.simulate_blocks(model, inputs(), x0=x0):
            (block,) = read
            numbers = np.arange(first, first + len(y_hat))
            found = {stream.clock.name: block.times[:, 0] if stream.times else numbers}
            for i, name in enumerate(names):
                found[f"{name}_hat"] = y_hat[:, i]
                if stream.y:
                    found[name] = block.y[:, i]
                    found[f"{name}_error"] = block.y[:, i] - y_hat[:, i]
            if stream.y:
                scores.add(block.y, y_hat)
                settled.add(block.y, y_hat)
            peaks = np.maximum(peaks, np.abs(model.scaler.normalise_u(block.u)).max(axis=0))
            write(found)
            first += len(y_hat)
        if not first:
            raise InputError("there are no samples; give a file with data.")
        if stream.y and first <= asked:
            raise InputError(
                f"skip={asked} leaves none of the {first} samples to score; give a smaller one."
            )
    return Written(first, skip, scores, settled, peaks)


def noted(result: Written, model: lfrtorch.Model, cfg: DictConfig) -> list[str]:
    """What a user should know before the outputs are used."""
    notes = [
        f"the input {channel.name} goes {tables.number(peak)} standard deviations of the training "
        "input away from its mean: the model extrapolates there"
        for channel, peak in zip(model.inputs, result.peaks, strict=True)
        if peak > FAR and model.sizes["nz"]  # a linear model is the same at all amplitudes
    ]
    scores, settled = result.scores, result.settled
    with np.errstate(invalid="ignore"):
        before = scores.samples * scores.rmse**2 - settled.samples * settled.rmse**2
        beginning = np.sqrt(before / (scores.samples - settled.samples))
        transient = (settled.samples >= BEGINNING) & (beginning > TRANSIENT * settled.rmse)
    if cfg.start != "estimated" and transient.any():
        ratio = (beginning / settled.rmse)[transient].max()
        notes.append(
            f"the error over the first {BEGINNING} scored samples is {tables.number(ratio)} "
            "times that of the rest: start=estimated finds the start state, skip=N leaves out the "
            "transient"
        )
    return notes


def check_rate(cfg: DictConfig, model: lfrtorch.Model) -> None:
    """Refuse another sampling frequency than the model's."""
    if cfg.data.fs is not None and not np.isclose(cfg.data.fs, model.fs):
        raise InputError(
            f"data.fs is {cfg.data.fs} Hz and the model's sampling frequency {model.fs:g} Hz; "
            "resample the file."
        )


def start_state(
    cfg: DictConfig, model: lfrtorch.Model, stream: FileStream
) -> tuple[Array | None, int]:
    """The state to start from, None for zero, and how many samples are not scored.

    How a state was estimated is printed. It is never fitted to samples that are scored.
    """
    if cfg.start == "given":
        return np.array(cfg.x0, dtype=np.float64), cfg.skip or 0
    if cfg.start == "zero":
        return None, from_rest(stream) if stream.y and cfg.skip is None else cfg.skip or 0
    if not stream.y:
        raise InputError(
            "start=estimated needs measured outputs; name their columns with data.outputs=[...], "
            "or use start=zero."
        )
    asked = cfg.estimate or cfg.skip
    u, y = beginning(stream, asked or PART * WINDOW)
    if not len(u):
        return None, 0
    N = asked or max(1, score_window(len(u)))
    u, y = u[:N], y[:N]
    name = stream.table.path.name
    record = lfrtorch.Record(u, y, fs=model.fs, start="estimated", name=name, valid=np.isfinite(y))
    trajectory = model.signals(record)
    fitted = lfrtorch.rmse(record, model.scaler.restore_y(trajectory.y[0].double().numpy()))
    there, at_rest = map(tables.number, (fitted, lfrtorch.rmse(record, model.simulate(u))))
    print(
        f"start: the state is estimated from the first {len(u)} samples of '{name}'; RMSE there "
        f"{there}, from zero state {at_rest} (they are not scored)"
    )
    return trajectory.x[0, 0].numpy(), max(len(u), cfg.skip or 0)


def beginning(stream: FileStream, samples: int) -> tuple[Array, Array]:
    """The first inputs and outputs of a file, fewer if it has no more."""
    u, y, count = [np.empty((0, len(stream.u)))], [np.empty((0, len(stream.y)))], 0
    for block in stream.blocks(samples):
        u.append(block.u.copy())  # of a block with more columns
        y.append(block.y.copy())
        count += len(block.u)
        if count >= samples:
            break
    return np.concatenate(u)[:samples], np.concatenate(y)[:samples]


def from_rest(stream: FileStream) -> int:
    """Samples that the score of a file from rest leaves out, as ``lfrtorch.load_records`` does."""
    samples = sum(len(block.u) for block in stream.blocks())
    settling = 0
    if samples <= LOOKED_AT:
        u, y = beginning(stream, LOOKED_AT)
        period = find_period(u) if np.isfinite(y).all() else None
        settling = 0 if period is None else find_transient(y, period)
    return warm_up(samples, settling)


def scored(path: Path, model: lfrtorch.Model, result: Written) -> list[list]:
    """Rows of the table of scores, one an output."""
    scores = result.scores
    return [
        [
            path.name,
            channel.name,
            channel.unit,
            of_samples(
                {
                    "samples": result.samples,
                    "skip": result.skip,
                    "scored": int(scores.samples[i]),
                }
            ),
            finite(scores.rmse[i]),
            tables.in_percent(finite(scores.nrmse[i])),
        ]
        for i, channel in enumerate(model.outputs)
    ]


def opened(folder: str) -> lfrtorch.Model:
    """The model of a checkpoint, a linear one as an NL-LFR without static nonlinearity."""
    description, _ = checkpoint.read(folder)
    if "linear" in description:
        return lfrtorch.LinearModel.load(folder).to_model()
    return lfrtorch.load(folder)


def introduced(folder: str, model: lfrtorch.Model) -> str:
    """Channels, rate and sizes in a line."""
    sizes = ", ".join(f"{name} {size}" for name, size in model.sizes.items() if size)
    u, y = (", ".join(map(str, channels)) for channels in (model.inputs, model.outputs))
    return f"{folder}: {u} -> {y} at {model.fs:g} Hz, {sizes}"


def require(cfg: DictConfig) -> None:
    """Say what is missing or wrong on the command line before anything is read."""
    for option, value, example in (
        ("checkpoint", cfg.checkpoint, "DIR, the folder of a run or of a saved model"),
        ("data.path", cfg.data.path, "FILE, the file of inputs"),
        ("out", cfg.out, "FILE.csv, which is written, or for several files a FOLDER"),
    ):
        if value is None:
            raise InputError(f"{option} is not set: add {option}={example}.")
    if isinstance(cfg.out, DictConfig | ListConfig):
        raise InputError(f"out is {cfg.out}; give a file or a folder.")
    if cfg.start not in ("zero", "given", "estimated"):
        raise InputError(f"start is {cfg.start!r}; give zero, given (with x0=[...]) or estimated.")
    if (cfg.start == "given") != (cfg.x0 is not None):
        raise InputError(
            f"start is {cfg.start!r} and x0 is {cfg.x0}; "
            "a start state goes with start=given, and only with it."
        )
    x0 = cfg.x0 if isinstance(cfg.x0, ListConfig | None) else [None]
    if not all(isinstance(x, int | float) and np.isfinite(x) for x in x0 or []):
        raise InputError(f"x0 is {cfg.x0}; give a list of finite numbers, one a state.")
    for name, least in (("estimate", 1), ("skip", 0)):
        if cfg[name] is not None:
            integer(name, cfg[name], least)
    if cfg.data.fs is not None:
        number("data.fs", cfg.data.fs, positive=True)
    if f".{cfg.format}" not in FORMATS:
        raise InputError(f"format is {cfg.format!r}; give csv, npz or parquet.")


def targets(cfg: DictConfig) -> list[tuple[Path, Path]]:
    """Each file that is read with that which is written."""
    paths = listed_files(cfg.data.path, "data.path")
    out = expanded(str(cfg.out))
    if out.is_dir() or not out.suffix:
        # Of a compressed file the name within.
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
    """Name the file in a message that does not."""
    try:
        yield
    except InputError as error:
        if f"'{path}'" in str(error):
            raise
        raise InputError(f"'{path}': {error}") from error


@hydra.main(**MAIN, config_path=str(CONF), config_name="simulate")
def main(cfg: DictConfig) -> None:
    """The command line."""
    with user_errors(cfg=cfg):
        simulate(cfg)


def launch() -> None:
    """The command."""
    with user_errors():
        take_words("simulate")
    main()
