"""Fits over a horizon: records are cut into windows, and each window is simulated by itself.

The simulation error of a whole record compares outputs even after thousands of samples. Far from
its minimum this error has many poor local minima. Where small changes of θ grow along a trajectory
(unstable transients, chaos), it is not a smooth function of θ (Ribeiro et al., 2020). Over windows
of h samples, changes grow for at most h samples, and the error is still a simulation error.

Each window begins in its own state, which is fitted with the parameters, as for a record with an
estimated start: multiple shooting without constraints between windows. The fitted state absorbs
white output noise in nx directions of each window's errors, whatever the parameters. So windows of
a linear model have the same minimum as whole records, apart from chance. The alternative is a state
from the one-step predictor of an innovation form, for predictions 1 to h samples ahead. It needs
the gain K, which the data do not determine while the model is poor, and which models with exact
integrators do not have. That state also depends on θ through all samples before the window. The
start states of windows are eliminated (``lfrtorch.least_squares.start_states``), so they do not
enlarge the linear system of a step.

If ``start="measured"``, outputs determine the states, and a window begins at an output, with no
state to estimate: its errors are those of predictions 1 to h samples ahead. In each record, errors
are divided by the error of holding the output. Otherwise errors that grow fast, as those of rates
do, would hide the others. Outputs of the same unit have the same weight. Errors of a window are
about proportional to its motion. So a window is weighted by the inverse of its rms motion, and its
squared errors count like absolute values. Otherwise the few windows in which a manoeuvre ends badly
would decide the fit.

Windows of the validation records choose the iterate. Each window is simulated from a state fitted
to samples before it, so no scored sample has determined its state. Whole simulations do not rank
unfinished models well: where small changes grow, even a nearly right model is wrong after some
time.

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
"""Number of outputs per state that determine the start of a validation window. Good models of the
wells in ``benchmarks/horizon.py`` have two states. There 40 samples determine the start of 81 of 81
windows, 50 samples that of 78, and 100 samples that of 61 of 84. Where small changes grow, the
error over more samples has many minima."""


_STILL = 0.1
"""Squared motion, relative to that of holding the output, that is added to each window's own. It
bounds the weight of windows at rest."""


def windows(
    records: Sequence[Record],
    horizon: int,
    nx: int,
    *,
    fitted: bool = True,
    y_scale: Array | None = None,
) -> list[Record]:
    """Cut the scored samples of records into windows of ``horizon`` samples."""
    # Windows of a record are spread evenly and overlap as little as possible; together their
    # samples have the weight of the record's samples. The first window begins as the record does,
    # with its skipped samples. All others begin in estimated states. If ``fitted``, these states
    # are parameters of the fit. Otherwise they are estimated from skipped samples before the
    # window: ``BEFORE`` outputs for each state, or as many samples as the record skips, if these
    # are more. A window with fewer samples before it begins as the record does.
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
                f"record '{record.name}' has line_weight, which does not fit the frequency lines "
                "of windows; give horizon=None, or records without it."
            )
        before = max(math.ceil(BEFORE * nx / record.y.shape[1]), record.skip)
        found += _windows(record, horizon, 0 if fitted else before)
    return found


def begins_at_outputs(records: Sequence[Record]) -> bool:
    """Tell if all records have measured starts; raise a ValueError if only some have."""
    measured = {record.start == "measured" for record in records}
    if len(measured) > 1:
        raise InputError(
            "some records have start 'measured' and others not; give all records this start or "
            "none: with it the model's states are its outputs."
        )
    return measured == {True}


def in_windows(records: Sequence[Record], horizon: int | None) -> Sequence[Record]:
    """Training records, cut into windows if a horizon is given and they have measured starts."""
    if horizon is None or any(record.start != "measured" for record in records):
        return records
    return windows(records, horizon, records[0].y.shape[1])


def windows_from_outputs(
    record: Record, horizon: int, apart: int, y_scale: Array | None
) -> list[Record]:
    """Windows that begin at measured outputs; together they weigh as much as the record."""
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
    """Rms error of holding each output over a horizon, pooled over outputs of the same unit."""
    ahead = range(1, min(horizon, record.samples - 1) + 1)
    squares = np.mean([((record.y[h:] - record.y[:-h]) ** 2).mean(axis=0) for h in ahead], axis=0)
    units = np.array([channel.unit or channel.name for channel in record.outputs])
    together = np.array([squares[units == unit].mean() for unit in units])
    return np.sqrt(np.where(together > 0, together, 1.0))


def _windows(record: Record, horizon: int, before: int) -> list[Record]:
    """Windows of one record that is longer than a window, with samples before them."""
    scored = record.samples - record.skip
    count = math.ceil(scored / horizon)
    weight = np.asarray(record.weight) * scored / (count * horizon)
    found = []
    for b in record.skip + np.linspace(0, scored - horizon, count).round().astype(int):
        needed = np.split(record.is_valid[max(b - before, 0) : b + horizon], [min(before, b)])
        if not all(part.any(axis=0).all() for part in needed if len(part)):
            continue  # an output has no valid sample in the window, or before it
        if record.start != "periodic" and b <= max(before, record.skip):
            first = record.part(
                slice(b + horizon), start=record.start, skip=b, period=None, weight=weight
            )
            found.append(first)
        else:  # in steady state the last samples precede the first one
            cut = np.arange(b - before, b + horizon)
            amid = record.part(
                cut, start="estimated", x0=None, skip=before, period=None, weight=weight
            )
            found.append(amid)
    if not found:
        raise InputError(
            f"record '{record.name}' has no window of {horizon} samples with a valid sample of "
            "each output; give a longer horizon, or horizon=None."
        )
    return found
