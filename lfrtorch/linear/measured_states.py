"""The linear model whose states are the outputs: it predicts each sample from the one before."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np

from lfrtorch.data.records import Record, Scaler
from lfrtorch.linear.model import LinearFit, LinearModel

_RIDGE = 1e-9
"""Ridge relative to regressors of unit rms: it keeps the weight of a constant regressor at 0."""


def measured_states_model(records: Sequence[Record]) -> LinearModel:
    """The model y(k+1) = A y(k) + B u(k) + constant of least squares, about the mean signals.

    It exists for unstable and integrating systems, too, as every sample begins at a measurement.
    """
    clock, first, scaler = time.perf_counter(), records[0], Scaler.of(records)
    u_offset, y_offset = scaler.u_offset, scaler.y_offset
    whole = [np.all(r.is_valid, axis=1) for r in records]
    u, y, after = (
        np.concatenate([part[v[:-1] & v[1:]] for part, v in zip(parts, whole, strict=True)])
        for parts in (
            [r.u[:-1] - u_offset for r in records],
            [r.y[:-1] - y_offset for r in records],
            [r.y[1:] - y_offset for r in records],
        )
    )
    v = np.hstack([y, u])
    scale = np.where((rms := np.sqrt((v**2).mean(axis=0))) > 0, rms, 1.0)
    v = np.hstack([v / scale, np.ones((len(v), 1))])
    # Fit the change from sample to sample, which rounding would lose in a fit of the samples.
    normal = v.T @ v + _RIDGE * len(v) * np.eye(v.shape[1])
    weights = np.linalg.solve(normal, v.T @ (after - y))
    error = after - y - v @ weights
    ny = y.shape[1]
    matrices = (weights[:-1] / scale[:, None]).T
    relative = error / np.where((std := y.std(axis=0)) > 0, std, 1.0)
    return LinearModel(
        A=np.eye(ny) + matrices[:, :ny],
        B=matrices[:, ny:],
        C=np.eye(ny),
        D=np.zeros((ny, u.shape[1])),
        fs=first.fs,
        u_offset=u_offset,
        y_offset=y_offset,
        inputs=first.inputs,
        outputs=first.outputs,
        fit=LinearFit(
            criterion="prediction",
            rmse=float(np.sqrt((relative**2).mean())),
            iterations=1,
            reason="least squares of the next sample",
            seconds=time.perf_counter() - clock,
        ),
    )
