"""What a score of an estimated start leaves out: as many samples as determine the start state.

The start state is fitted to the first N samples, and the rest is scored. With the errors e of the
model and its free responses y(k) = U(k) a, U orthonormal over the record, the fit errs by a = G e,
G the pseudoinverse of U over the first N samples. Relative to e, the scored samples have

    added(N) = tr(G R Gᵀ Q) / ((T - N) tr R(0)),  Q = Σ U(k)ᵀ U(k) over the scored k,

more squared error, R the autocovariance of e on the training records. A model's errors are as slow
as its system: five samples say hardly more of the state than one, and if they were white, added
would be a tenth of what the scores show on parts of the cascaded tanks' and the Wiener-Hammerstein
system's estimation records.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.linalg import matmul_toeplitz

from lfrtorch._support.types import Array
from lfrtorch.dataset import Dataset
from lfrtorch.engine.linear_recurrence import linear_recurrence
from lfrtorch.engine.linearised import linearise
from lfrtorch.files.split import SHORTEST
from lfrtorch.linear.model import without_units
from lfrtorch.model import Model
from lfrtorch.records import Record, without_coordinates

PRICE = 0.25
"""The window is the N with the least added(N) + PRICE N / T: what is not scored is lost."""

MOST = 0.2
"""Most added(N) of a score, a tenth of its RMSE. On parts of the tanks' and the Wiener-Hammerstein
system's estimation records, scores with less are off by 12 % of the RMSE at most on average."""

LISTED = 3
"""Most records that have a note of their own."""

LONGEST = 1 << 15
"""Samples at the beginning of a record that are looked at; half of them determine any state."""

FINER = 1.1
"""Each N that is tried, over the one before."""

SEEN, FLOOR = 1e-9, 1e-6
"""Least free response relative to the largest; least error relative to the output's rms."""


def with_score_windows(dataset: Dataset, model: Model) -> Dataset:
    """The data with windows for scores: ``skip`` of an estimated start that left it open.

    The linear model sets them for all models that begin with it, so that they are scored alike.
    Records that have too few samples go to ``unscored``, and a note says so.

    Args:
        dataset: records by use; those of ``train`` stay as they are.
        model: ``linear.to_model()``, or the one to be scored if there is no linear model.

    Example:
        >>> from lfrtorch.linear.score_window import with_score_windows
        >>> test = lfrtorch.Record(u[100:], y[100:], fs=100.0, start="estimated", name="test")
        >>> data = lfrtorch.Dataset("mine", train=[record], validation=[], tests=[test])
        >>> data = with_score_windows(data, bla.to_model())
        >>> 0 < data.tests[0].skip < 30
        True
    """
    names = "validation", "selection", "tests"
    given = {name: getattr(dataset, name) for name in names}
    found = {
        name: settled(model, records, dataset.train) if records else ([], [])
        for name, records in given.items()
    }
    lost = [(name.removesuffix("s"), r) for name, (_, left) in found.items() for r in left]
    notes = [
        f"record '{record.name}' ({use}): {record.samples} samples are too few to determine the "
        "start state and score the rest: not scored"
        for use, record in lost
    ]
    if len(notes) > LISTED:
        more = f"and {len(notes) - 1} more records have too few samples: see the table of scores"
        notes = [notes[0], more]
    if given["validation"] and not found["validation"][0]:
        notes.append("no validation record can be scored, so the training error chooses")
    return replace(
        dataset,
        **{name: scored for name, (scored, _) in found.items()},
        unscored=(*dataset.unscored, *lost),
        notes=(*dataset.notes, *notes),
    )


def settled(
    model: Model, records: Sequence[Record], train: Sequence[Record]
) -> tuple[list[Record], list[Record]]:
    """The records that can be scored, with their windows, and those that cannot."""
    scored, lost, errors = [], [], None
    for record in records:
        if not is_open(record):
            scored.append(record)
            continue
        if errors is None:
            errors = [
                fitted_errors(model, beginning(without_coordinates(r)))[r.skip :] for r in train
            ]
        skip = determining_samples(model, without_units(record), errors)
        if skip is None:
            lost.append(record)
        else:
            scored.append(replace(record, skip=skip, skip_more=False))
    return scored, lost


def is_open(record: Record) -> bool:
    """Whether the model says how many samples a score of the record leaves out."""
    return record.start == "estimated" and (record.skip_more or not record.skip)


def determining_samples(
    model: Model, record: Record, errors: Sequence[Float[Array, "T ny"]] = ()
) -> int | None:
    """Samples at the record's beginning, ``skip`` at least, that determine its start state.

    Args:
        model: whose state it is; of a nonlinear one the linearisation along the record, from rest.
        record: that is to be scored.
        errors: of the model on training records, physical units. Default: those on this record.

    Returns:
        None if too few would be left.
    """
    if record.samples > LONGEST and record.skip > LONGEST // 2:
        return record.skip
    part = beginning(record)
    errors = errors or [fitted_errors(model, part)]
    weight = np.sqrt(part.weight) / model.scaler.y_scale
    U = _free_responses(model, part)
    T, ny, n = U.shape
    # A model that diverges is scored, and its score says so: no errors of it, no free responses.
    R = _autocovariance([weight * e for e in errors if np.isfinite(e).all()], T, ny)
    R[0] += FLOOR**2 * np.mean((weight * part.y) ** 2, axis=0) + np.finfo(float).tiny
    found, added, least = None, math.inf, math.inf
    N = max(record.skip, 1)
    while N <= T - SHORTEST and least > PRICE * N / T:
        seen = U[:N].reshape(N * ny, n)
        if np.linalg.matrix_rank(seen, tol=FLOOR) == n:  # every direction is seen
            G = np.linalg.pinv(seen).reshape(n, N, ny)
            P = sum(G[..., i] @ matmul_toeplitz(r[:N], G[..., i].T) for i, r in enumerate(R.T))
            Q = np.eye(n) - seen.T @ seen
            here = float(np.trace(P @ Q) / ((T - N) * R[0].sum()))
            if here + PRICE * N / T < least:
                found, added, least = N, here, here + PRICE * N / T
        N = max(N + 1, round(FINER * N))
    return found if added <= MOST else None


def fitted_errors(model: Model, record: Record) -> Float[Array, "T ny"]:
    """Errors in physical units; an estimated start is fitted to all samples, as in a fit."""
    return record.y - model.simulate(fitted(record))


def fitted(record: Record) -> Record:
    """The record in such a way that a simulation fits an estimated start to all samples."""
    return replace(record, skip=0) if record.start == "estimated" else record


def beginning(record: Record) -> Record:
    """The first ``LONGEST`` samples of a record, from its own start."""
    if record.samples <= LONGEST or record.start == "periodic":
        return record
    skip = min(record.skip, LONGEST - 1)
    return replace(record[:LONGEST], start=record.start, x0=record.x0, skip=skip)


@torch.no_grad()
def _free_responses(model: Model, record: Record) -> Float[Array, "T ny n"]:
    """An orthonormal basis of the weighted outputs that start states make without input."""
    cell = model.lfr.cell
    z = model.signals(record, start="zero").z.nan_to_num(0.0, 0.0, 0.0)
    F, H = (part.cpu() for part in linearise(cell, z.to(cell.A)))
    identity = torch.eye(cell.nx).to(F).unsqueeze(0)
    free = H @ linear_recurrence(F, torch.zeros_like(F), identity)[:, :-1]
    weighted = np.sqrt(record.weight)[..., None] * free[0].double().numpy()
    if not np.isfinite(weighted).all():
        return np.zeros((*weighted.shape[:2], 0))
    U, s, _ = np.linalg.svd(weighted.reshape(-1, cell.nx), full_matrices=False)
    return U[:, s > SEEN * s[0]].reshape(*weighted.shape[:2], -1)


def _autocovariance(
    errors: Sequence[Float[Array, "S ny"]], T: int, ny: int
) -> Float[Array, "T ny"]:
    """Of each output's errors about 0, at lags 0 to T - 1."""
    total = np.zeros((T, ny))
    for e in errors:
        spectrum = np.abs(np.fft.rfft(e, 2 * len(e), axis=0)) ** 2
        found = np.fft.irfft(spectrum, 2 * len(e), axis=0)[: min(T, len(e))]
        total[: len(found)] += found
    return total / max(1, sum(map(len, errors)))
