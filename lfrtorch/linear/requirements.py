"""Requirements on data for a linear model of an order: excitation, length, equations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lfrtorch._support.errors import InputError
from lfrtorch.data.metrics import rms
from lfrtorch.data.periods import find_transient
from lfrtorch.data.records import Record
from lfrtorch.linear.spectral_data import SpectralData
from lfrtorch.linear.subspace import shortest, suffice

_REPEATS = 0.1
"""Largest relative standard deviation of an input's periods, and of an output's period means."""


def check_signals(records: list[Record]) -> None:
    """Refuse a channel that is constant in all records."""
    for signals, channels in (
        ([r.u for r in records], records[0].inputs),
        ([r.y for r in records], records[0].outputs),
    ):
        everything = np.concatenate(signals)
        for channel, span in zip(channels, np.ptp(everything, axis=0), strict=True):
            if span == 0:
                raise InputError(
                    f"signal '{channel.name}' is constant in all records; "
                    "a model needs an input that excites and an output that responds: "
                    "check the columns."
                )


def check_length(records: list[Record], nx: int) -> None:
    """Refuse records that are too short for a subspace of the order."""
    nu, ny = len(records[0].inputs), len(records[0].outputs)
    lengths = [r.samples for r in records]
    if not suffice(lengths, nx, nu, ny):
        raise InputError(
            f"the longest of {len(records)} record(s) has {max(lengths)} samples; order nx={nx} "
            f"with {nu} input(s) and {ny} output(s) needs one of {shortest(nx, nu, ny)}, or many "
            "shorter ones:\nrecord more, or lower nx."
        )


def without_inputs(record: Record, last: int) -> Record:
    """Return the record without its last inputs."""
    kept = len(record.inputs) - last
    return replace(record, u=record.u[:, :kept], inputs=record.inputs[:kept], reference=None)


def steady_state(records: Sequence[Record]) -> list[Record] | None:
    """Return the whole periods in steady state, or ``None`` if a record has too few of them."""
    found = [_steady_part(record) for record in records]
    return [record for record in found if record] if all(found) else None


def of_response(records: Sequence[Record]) -> bool:
    """Tell if records are best fitted by their response: a reference, and no steady state.

    A controller makes part of such inputs from the output, which biases a simulation error.
    """
    referred = all(record.reference is not None for record in records)
    return referred and steady_state(records) is None


def _steady_part(record: Record) -> Record | None:
    N, scored = record.period, record.samples - record.skip
    if record.start == "periodic" and not record.skip:
        return record
    if N is None or record.start in ("periodic", "given"):
        return None
    settling = find_transient(record.y[record.skip :], N)
    P = (scored - settling) // N
    if (1 if record.skip >= N else 2) > P or settling > scored / 3:
        return None
    cut = slice(record.samples - P * N, None)
    if not record.is_valid[cut].all():
        return None
    part = record.part(cut, start="periodic", skip=0, period=N)
    y, repeated = part.y, part.u if part.reference is None else part.reference
    periods = repeated.reshape(P, N, -1)
    changes = (periods - periods.mean(axis=0)).std(axis=(0, 1))
    drift = y.reshape(P, N, -1).mean(axis=1).std(axis=0)
    if (changes > _REPEATS * repeated.std(axis=0)).any() or (
        drift > _REPEATS * y.std(axis=0)
    ).any():
        return None
    return part


def check_spectral_data(data: SpectralData, nx: int, direct: int = 0) -> None:
    """Refuse fewer equations than unknowns; ``direct`` inputs act on the output alone."""
    nu, ny = data.U.shape[1] - direct, data.Y.shape[1]
    unknowns, equations = nx * (nu + ny) + (nu + direct) * ny, data.equations
    if equations < unknowns:
        raise InputError(
            f"{len(data.z)} excited line(s) make {equations} equations; order nx={nx} with {nu} "
            f"input(s) and {ny} output(s) has {unknowns} unknowns: excite more lines, or lower nx."
        )


def excited_directions(records: Sequence[Record], nx: int) -> tuple[int, int]:
    """Count the directions in which the input moves, and those that a model of the order has."""
    nu = records[0].u.shape[1]
    wanted = 2 * nx + 1
    windows = [
        np.lib.stride_tricks.sliding_window_view(r.u - r.u.mean(axis=0), wanted, axis=0)
        for r in records
        if r.samples >= wanted
    ]
    rows = np.concatenate([w.reshape(len(w), -1) for w in windows])
    rows = rows / np.maximum(rms(rows, axis=0), 1e-300)
    size = np.linalg.eigvalsh(rows.T @ rows)
    return int((size > 1e-10 * size[-1]).sum()), nu * wanted


def excitation_notes(records: list[Record], nx: int) -> list[str]:
    """Return a note if the input moves in too few directions to tell all parameters apart."""
    excited, wanted = excited_directions(records, nx)
    if excited == wanted:
        return []
    return [
        f"the input is too narrow: it excites {excited} of the {wanted} directions that "
        f"order {nx} has; between its frequencies the model is a guess."
    ]
