"""Covariances of process and measurement noise of a system, estimated from records."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np
import scipy

from lfrtorch._support.arguments import typed
from lfrtorch._support.types import Array
from lfrtorch.data.records import Record, as_records, rms_scale
from lfrtorch.fitting.state_scaling import state_moment
from lfrtorch.model.extended_kalman_filter import NoiseCovariance, inside_limits
from lfrtorch.model.model import Model


@typed()
def estimate_noise(model: Model, records: Record | Sequence[Record]) -> NoiseCovariance:
    """Noise covariances for an extended Kalman filter of a model, estimated from records.

    For a model in innovation form, Λ is the mean square of the innovations over the records, and
    Q = K Λ Kᵀ, S = K Λ and R = Λ. For any other model Q and R are diagonal, and maximise the
    likelihood of the records: the likelihood of the filter's errors one sample ahead, under the
    variances that the filter computes. Errors of the model count as noise, too. In the innovation
    form skipped samples are left out; a filter begins at the first sample.

    The maximisation takes some hundred passes over the records; a few thousand samples are enough.

    Args:
        model: a model; it is not changed.
        records: inputs and measured outputs; best are records that were not fitted.

    Raises:
        ValueError: records whose channels or rate are not those of the model.

    References:
        Ljung, "System Identification: Theory for the User", 2nd ed., 1999, sections 4.3 and 7.4.

    Example:
        >>> noise = lfrtorch.estimate_noise(model, record)
        >>> np.asarray(noise.Q).shape, np.asarray(noise.R).shape
        ((1, 1), (1, 1))
        >>> observer = model.observer(noise=noise, after=record)
    """
    records = as_records(records)
    for record in records:
        model.check(record)
    if model.K is not None:
        return _of_innovations(model, records)
    nx, signals = model.lfr.cell.nx, [(record.u, inside_limits(record)) for record in records]
    count = sum(int(np.isfinite(y).sum()) for _, y in signals)
    P0 = state_moment(model, records).numpy()
    if not np.isfinite(P0).all():
        P0 = model.state_covariance
    x_rms = np.sqrt(np.where(np.diag(P0) > 0.0, np.diag(P0), 1.0))
    y_rms = rms_scale([record.y for record in records], model.scaler.y_offset)
    unit = np.log(y_rms / model.scaler.y_scale).mean()  # so that units do not change where it ends

    def noise_of(logarithms: Array) -> NoiseCovariance:
        rms = np.exp(logarithms / 2.0)
        return NoiseCovariance(np.diag((rms[:nx] * x_rms) ** 2), np.diag((rms[nx:] * y_rms) ** 2))

    def cost(logarithms: Array) -> float:
        noise = noise_of(logarithms)
        log_p = sum(model.observer(noise=noise, P0=P0).follow(u, y) for u, y in signals)
        return -log_p / count - unit if np.isfinite(log_p) else np.inf

    # Variances are relative to mean squares in the records. The search begins at large variances,
    # as the likelihood hardly depends on a variance that is far too small. eps is the step of the
    # finite differences.
    first = (1e-4, 1e-2)
    starts = [np.log([q] * nx + [r] * len(y_rms)) for q, r in product(first, first)]
    found = scipy.optimize.minimize(
        cost, min(starts, key=cost), method="L-BFGS-B",
        bounds=[(np.log(1e-12), np.log(1e2))] * (nx + len(y_rms)), options={"eps": 1e-4},
    )  # fmt: skip
    return noise_of(found.x)


def _of_innovations(model: Model, records: Sequence[Record]) -> NoiseCovariance:
    """Return the noise covariances of a model in innovation form."""
    assert model.K is not None
    errors = [(record.y - model.predict(record))[record.skip :] for record in records]
    e = np.concatenate(errors)
    K, innovations = model.K.double().cpu().numpy() / model.scaler.y_scale, e.T @ e / len(e)
    across = K @ innovations
    return NoiseCovariance(across @ K.T, innovations, across)
