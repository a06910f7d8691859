"""Covariances of the noise inside a system, from records of it."""

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
    """The noise that an extended Kalman filter of a model needs, from records.

    A model in innovation form has the mean square Λ of the innovations, and then Q = K Λ Kᵀ,
    S = K Λ and R = Λ. Any other model has diagonal Q and R, those of the greatest likelihood
    of the records: of the filter's errors one sample ahead, each with the variance that it says.
    Errors of the model count as noise, too. Skipped samples are not scored in the
    innovation form; a filter begins at the first sample.

    It takes some hundred passes over the records; a few thousand samples are enough.

    Args:
        model: it is not changed.
        records: inputs and measured outputs, best not those of the fit.

    Raises:
        ValueError: records of other channels or another rate.

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
    unit = np.log(y_rms / model.scaler.y_scale).mean()  # so that the search ends alike in all

    def noise_of(logarithms: Array) -> NoiseCovariance:
        rms = np.exp(logarithms / 2.0)
        return NoiseCovariance(np.diag((rms[:nx] * x_rms) ** 2), np.diag((rms[nx:] * y_rms) ** 2))

    def cost(logarithms: Array) -> float:
        noise = noise_of(logarithms)
        log_p = sum(model.observer(noise=noise, P0=P0).follow(u, y) for u, y in signals)
        return -log_p / count - unit if np.isfinite(log_p) else np.inf

    # Variances relative to mean squares in the records. The search begins from above, as one that
    # is far too small makes no difference to the likelihood; eps: of a finite difference.
    first = (1e-4, 1e-2)
    starts = [np.log([q] * nx + [r] * len(y_rms)) for q, r in product(first, first)]
    found = scipy.optimize.minimize(
        cost, min(starts, key=cost), method="L-BFGS-B",
        bounds=[(np.log(1e-12), np.log(1e2))] * (nx + len(y_rms)), options={"eps": 1e-4},
    )  # fmt: skip
    return noise_of(found.x)


def _of_innovations(model: Model, records: Sequence[Record]) -> NoiseCovariance:
    """Return the noise of the innovation form."""
    assert model.K is not None
    errors = [(record.y - model.predict(record))[record.skip :] for record in records]
    e = np.concatenate(errors)
    K, innovations = model.K.double().cpu().numpy() / model.scaler.y_scale, e.T @ e / len(e)
    across = K @ innovations
    return NoiseCovariance(across @ K.T, innovations, across)
