"""Simulation of a model on the inputs of a file: start, outputs in another file, scores."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lfrtorch._support.atomic import whole_file
from lfrtorch._support.errors import InputError
from lfrtorch._support.tables import number
from lfrtorch._support.types import Array
from lfrtorch.data.metrics import BlockScores, rmse
from lfrtorch.data.periods import find_period, find_transient
from lfrtorch.data.records import Record
from lfrtorch.data.score_window import PART, WINDOW, score_window, warm_up
from lfrtorch.files.stream import Block, FileStream
from lfrtorch.files.writer import table_writer
from lfrtorch.model.model import Model, simulate_blocks

BEGINNING = 100
"""Samples in which the transient of a wrong start state is looked for."""

_TRANSIENT = 3.0  # smallest ratio of the error in these samples to the later one in a transient
_LOOKED_AT = 1_000_000  # largest number of samples of a file in which a period is looked for
_FAR = 6.0  # standard deviations of the training input within which most signals stay


class Start(NamedTuple):
    """The state before the first sample (None for 0), samples that are not scored, and a note."""

    x0: Array | None
    skip: int
    note: str = ""


def estimated_start(
    model: Model, stream: FileStream, *, samples: int | None = None, skip: int | None = None
) -> Start:
    """Return the most probable start state given the first measured outputs, which do not score."""
    # ``samples``: number of samples that are used. Default: skip, or as many as for a record.
    _require_outputs(stream, "estimated")
    asked = samples or skip
    u, y = _beginning(stream, asked or PART * WINDOW)
    if not len(u):
        return Start(None, 0)
    N = asked or max(1, score_window(len(u)))
    u, y = u[:N], y[:N]
    name = stream.table.path.name
    record = Record(u, y, fs=model.fs, start="estimated", name=name, valid=np.isfinite(y))
    trajectory = model.signals(record)
    fitted = rmse(record, model.scaler.restore_y(trajectory.y[0].double().numpy()))
    there, at_rest = map(number, (fitted, rmse(record, model.simulate(u))))
    note = (
        f"start: the state is estimated from the first {len(u)} samples of '{name}'; RMSE there "
        f"{there}, from zero state {at_rest} (they are not scored)"
    )
    return Start(trajectory.x[0, 0].numpy(), max(len(u), skip or 0), note)


def measured_start(model: Model, stream: FileStream, *, skip: int | None = None) -> Start:
    """The state from the first measured output; that sample is not scored."""
    _require_outputs(stream, "measured")
    u, y = _beginning(stream, 2)
    if len(u) < 2 or not np.isfinite(y[0]).all():
        raise InputError(
            f"start=measured needs two samples and all outputs of the first: {len(u)} that begin "
            f"with {y[:1].tolist()}; remove rows at the beginning, or use start=estimated."
        )
    record = Record(u, y, fs=model.fs, start="measured", valid=np.isfinite(y))
    return Start(model.signals(record).x[0, 0].numpy(), max(1, skip or 0))


def _require_outputs(stream: FileStream, start: str) -> None:
    """Refuse a start that needs outputs if the file has none."""
    if not stream.y:
        raise InputError(
            f"start={start} needs measured outputs; name their columns with data.outputs=[...], "
            "or use start=zero."
        )


def start_at_rest(stream: FileStream, *, skip: int | None = None) -> Start:
    """State 0; the score leaves out as many samples as ``lfrtorch.load_records`` does."""
    if skip is not None or not stream.y:
        return Start(None, skip or 0)
    samples = sum(len(block.u) for block in stream.blocks())
    settling = 0
    if samples <= _LOOKED_AT:
        u, y = _beginning(stream, _LOOKED_AT)
        period = find_period(u) if np.isfinite(y).all() else None
        settling = 0 if period is None else find_transient(y, period)
    return Start(None, warm_up(samples, settling))


def _beginning(stream: FileStream, samples: int) -> tuple[Array, Array]:
    """The first inputs and outputs of a file, fewer if the file is shorter."""
    u, y, count = [np.empty((0, len(stream.u)))], [np.empty((0, len(stream.y)))], 0
    for block in stream.blocks(samples):
        u.append(block.u.copy())  # a view would keep the whole block in memory
        y.append(block.y.copy())
        count += len(block.u)
        if count >= samples:
            break
    return np.concatenate(u)[:samples], np.concatenate(y)[:samples]


class Simulated(NamedTuple):
    """Result of the simulation of a file.

    Args:
        samples, skip: number of samples written, and how many of these are not scored, at first.
        scores: scores of measured outputs after the skipped samples.
        settled: scores without the first ``BEGINNING`` scored samples as well.
        peaks: largest inputs about the operating point, in standard deviations of the model's
            training inputs, (nu,).
    """

    samples: int
    skip: int
    scores: BlockScores
    settled: BlockScores
    peaks: Array


def simulate_file(
    model: Model, stream: FileStream, out: Path, start: Start, *, asked: int = 0
) -> Simulated:
    """Simulate a file block by block into another; ``asked``: samples that the user skips."""
    names = [channel.name for channel in model.outputs]
    scores, settled = (BlockScores(len(names), start.skip + more) for more in (0, BEGINNING))
    first, peaks = 0, np.zeros(len(model.inputs))
    read: list[Block] = []

    def inputs() -> Iterator[Array]:
        for block in stream.blocks():
            read[:] = [block]
            yield block.u

    with whole_file(out) as fresh, table_writer(fresh) as write:
        for y_hat in simulate_blocks(model, inputs(), x0=start.x0):
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
    return Simulated(first, start.skip, scores, settled, peaks)


def notes_on(result: Simulated, model: Model, *, estimated: bool) -> list[str]:
    """Return what a user should know before using the outputs."""
    notes = [
        f"the input {channel.name} goes {number(peak)} standard deviations of the training "
        "input away from its mean: the model extrapolates there"
        for channel, peak in zip(model.inputs, result.peaks, strict=True)
        if peak > _FAR and model.sizes["nz"]  # a linear model holds at all amplitudes
    ]
    scores, settled = result.scores, result.settled
    with np.errstate(invalid="ignore"):
        before = scores.samples * scores.rmse**2 - settled.samples * settled.rmse**2
        beginning = np.sqrt(before / (scores.samples - settled.samples))
        transient = (settled.samples >= BEGINNING) & (beginning > _TRANSIENT * settled.rmse)
    if not estimated and transient.any():
        ratio = (beginning / settled.rmse)[transient].max()
        notes.append(
            f"the error over the first {BEGINNING} scored samples is {number(ratio)} "
            "times that of the rest: start=estimated finds the start state, skip=N leaves out the "
            "transient"
        )
    return notes
