"""Fits over a horizon: records are cut into windows, and each window is simulated by itself.

A simulation error of a whole record asks the model for the right output after thousands of samples.
Far from the minimum it has many poor ones, and where small changes of θ grow along a trajectory
(unstable transients, chaos) it is no smooth function of θ (Ribeiro et al., 2020). Over windows of
h samples changes grow for h samples at most, and the error is still one of a simulation.

Each window begins in a state of its own that is fitted with the parameters, as that of a record
with an estimated start is: multiple shooting without constraints. White noise on the outputs
puts nx ny errors of each window into its state, for all parameters, so that windows of a
linear model have the minimum of whole records but for chance. The alternative, a state from the
one-step predictor of an innovation form (the error of predictions 1 to h samples ahead), needs the
gain K, which the data do not tell while the model is poor, and does not exist for models with exact
integrators; and it still depends on θ through all samples before the window. As start states are
eliminated (``lfrtorch.least_squares.start_states``), theirs are no parameters of a step's system.
No constraint joins a window to the next one.

Where outputs tell the states (``start="measured"``) a window begins at an output, with nothing to
estimate: the error over it is that of predictions 1 to h samples ahead. It is weighed by that of
holding the output, in each record: errors that grow fast, as those of rates do, would hide the
others. Outputs of one unit have one weight. Errors are about as large as what moves, so windows
weigh by the inverse of that, and their squares count as absolute values do: otherwise the few in
which a manoeuvre ends badly would decide.

Windows of the validation records choose the iterate, each simulated from a state that is fitted to
samples before it, so that no error is of a sample that its state was fitted to. A whole simulation
is a poor judge of a model on its way: where small changes grow, it is wrong after some time even if
the model is nearly right.

References:
    Bock, "Numerical treatment of inverse problems in chemical reaction kinetics", in Modelling of
    Chemical Reaction Systems, 1981.
    Ribeiro, Tiels, Umenberger, Schön and Aguirre, "On the smoothness of nonlinear system
    identification", Automatica 121, 2020.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lfrtorch._support.checks import integer
from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array
from lfrtorch.data.records import Record

BEFORE = 20
"""Outputs for each state before a window of validation. For good models of the wells in
``benchmarks/horizon.py``, with two states, 40 samples told the start of 81 of 81 windows, 50 of 78,
and 100 of 61 of 84: where small changes grow, the error over more samples has many minima."""


_STILL = 0.1
"""Squared motion of a window, relative to its record's, that adds to its own: one at rest is no
better than others."""


def windows(
    records: Sequence[Record],
    horizon: int,
    nx: int,
    *,
    fitted: bool = True,
    y_scale: Array | None = None,
) -> list[Record]:
    """The samples that a fit scores, in windows of ``horizon`` samples."""
    # Windows of a record are spread evenly and overlap as little as they can; their samples have
    # the weight of the record's together. The first one begins as the record does, with what is
    # skipped, and all others in states to be estimated: parameters of a fit, or else estimated from
    # skipped samples before the window, ``BEFORE`` for each state or, if these are more, as many as
    # the record skips. A window that has fewer begins as the record does.
    integer("horizon", horizon, 2)
    found = []
    for record in records:
        if record.start == "measured":
            found += windows_from_outputs(record, horizon, horizon, y_scale)
            continue
        if record.samples - record.skip <= horizon:
            found.append(record)
            continue
        if horizon * record.y.shape[1] < 2 * nx:
            raise InputError(
                f"horizon is {horizon}, too few samples of {record.y.shape[1]} output(s) to tell "
                f"{nx} states; give {math.ceil(2 * nx / record.y.shape[1])} or more."
            )
        if record.line_weight is not None:
            raise InputError(
                f"record '{record.name}' has line_weight, and windows have other lines; give "
                "horizon=None, or records without it."
            )
        before = max(math.ceil(BEFORE * nx / record.y.shape[1]), record.skip)
        found += _windows(record, horizon, 0 if fitted else before)
    return found


def begins_at_outputs(records: Sequence[Record]) -> bool:
    """Tell if all records have measured starts; a ValueError if some have."""
    measured = {record.start == "measured" for record in records}
    if len(measured) > 1:
        raise InputError(
            "some records have start 'measured' and others not; give all the same, as the model's "
            "states are then its outputs."
        )
    return measured == {True}


def in_windows(records: Sequence[Record], horizon: int | None) -> Sequence[Record]:
    """Training records as a fit simulates them: in windows if they begin at outputs, else whole."""
    if horizon is None or any(record.start != "measured" for record in records):
        return records
    return windows(records, horizon, records[0].y.shape[1])


def windows_from_outputs(
    record: Record, horizon: int, apart: int, y_scale: Array | None
) -> list[Record]:
    """Windows that begin at measured outputs, with the weight of the record's samples together."""
    record.require_all_valid("a fit from measured outputs")
    last = max(record.samples - 1 - horizon, 0)
    begins = np.linspace(0, last, 1 + math.ceil(last / apart)).round().astype(int)
    weight = np.asarray(record.weight) * (record.samples - 1) / (len(begins) * horizon)
    cuts = [slice(b, b + horizon + 1) for b in begins]
    found = [record.part(c, start=record.start, skip=1, period=None, weight=weight) for c in cuts]
    if y_scale is None:
        return found
    scale = _held(record, horizon)
    squares = np.array([np.mean(((each.y[1:] - each.y[0]) / scale) ** 2) for each in found])
    own = 1.0 / np.sqrt(squares + _STILL)
    own /= own.mean()
    weight = weight * (y_scale / scale) ** 2
    return [replace(each, weight=weight * w) for each, w in zip(found, own, strict=True)]


def _held(record: Record, horizon: int) -> Array:
    """Rms error of holding each output over a horizon, together with those of its unit."""
    ahead = range(1, min(horizon, record.samples - 1) + 1)
    squares = np.mean([((record.y[h:] - record.y[:-h]) ** 2).mean(axis=0) for h in ahead], axis=0)
    units = np.array([channel.unit or channel.name for channel in record.outputs])
    together = np.array([squares[units == unit].mean() for unit in units])
    return np.sqrt(np.where(together > 0, together, 1.0))


def _windows(record: Record, horizon: int, before: int) -> list[Record]:
    """Those of one record that is longer, with samples before them."""
    scored = record.samples - record.skip
    count = math.ceil(scored / horizon)
    weight = np.asarray(record.weight) * scored / (count * horizon)
    found = []
    for b in record.skip + np.linspace(0, scored - horizon, count).round().astype(int):
        needed = np.split(record.is_valid[max(b - before, 0) : b + horizon], [min(before, b)])
        if not all(part.any(axis=0).all() for part in needed if len(part)):
            continue  # a hole, where an output tells nothing of the window or of its start
        if record.start != "periodic" and b <= max(before, record.skip):
            first = record.part(
                slice(b + horizon), start=record.start, skip=b, period=None, weight=weight
            )
            found.append(first)
        else:  # in steady state what is before the first sample are the last ones
            cut = np.arange(b - before, b + horizon)
            amid = record.part(
                cut, start="estimated", x0=None, skip=before, period=None, weight=weight
            )
            found.append(amid)
    if not found:
        raise InputError(
            f"record '{record.name}' has no window of {horizon} samples with a valid one of each "
            "output; give a longer horizon, or horizon=None."
        )
    return found
