"""Part of a simulation's errors that is due to an uncertain start state.

The start state is fitted to the first N samples of a record, with the covariance P of the states
over the training data as a prior. Let S be the free responses of those outputs to the states
P^(1/2) a, cov a = I, and e the model's errors, of variance σ². The estimate is a = G y with
G = (SᵀS + σ² I)⁻¹ Sᵀ, and errs by

    cov(a - a₀) = (I - G S) (I - G S)ᵀ + G R Gᵀ,

where R is the autocovariance of e. A model's errors are as slow as its system; if they were taken
for white, the error of the start state would seem ten times smaller. R is estimated from the scored
samples, and the free responses carry the error of the start state on to these.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from scipy.linalg import matmul_toeplitz

from lfrtorch._support.types import Array
from lfrtorch.data.records import Record, of_one_unit
from lfrtorch.engine.initial_state import state_moments
from lfrtorch.engine.linear_recurrence import linear_recurrence
from lfrtorch.engine.linearised import linearise
from lfrtorch.engine.operating_point import double
from lfrtorch.model.model import Model

LONGEST = 1 << 13
"""Number of samples at the beginning of a record whose free responses are computed."""


@torch.no_grad()
def start_error(model: Model, record: Record, y_hat: Float[Array, "T ny"]) -> float | None:
    """Return the RMS error that the uncertain start state adds in the scored samples.

    In physical units, of outputs of several units normalised. None if no start state is estimated
    from skipped samples, or from too many.
    """
    N, T = record.skip, min(record.samples, LONGEST)
    if record.start != "estimated" or not 0 < N <= LONGEST // 2 or not np.isfinite(y_hat).all():
        return None
    cell, u = double(model.lfr.cell), torch.as_tensor(model.scaler.normalise(record).u)
    F, H = linearise(cell, model.signals(record).z[:, :T].double())
    moments, axes = np.linalg.eigh(state_moments(cell, u.unsqueeze(0)))
    root = torch.from_numpy(axes * np.sqrt(np.maximum(moments, 0.0))[:, None])
    free = (H @ linear_recurrence(F, torch.zeros_like(F), root)[:, :-1])[0].numpy()
    weight, scale = model.scaler.normalise(record).record.start_factors[:N], model.scaler.y_scale
    errors = np.sqrt(record.weight) / scale * record.errors(y_hat)
    S = (weight[:, :, None] * free[:N]).reshape(N * free.shape[1], -1)
    variance = np.mean(errors**2) + np.finfo(float).tiny
    G = np.linalg.solve(S.T @ S + variance * np.eye(S.shape[1]), S.T)
    covariance = np.eye(len(G)) - G @ S
    covariance = covariance @ covariance.T
    for g, e in zip(G.reshape(len(G), N, -1).transpose(2, 0, 1), errors.T, strict=True):
        covariance += g @ matmul_toeplitz(_autocovariance(e, N), g.T)
    added = np.einsum("kil,lm,kim->ki", free[N:], covariance, free[N:])
    added *= scale**2 if of_one_unit(record.outputs) else 1.0
    count = record.samples - N
    squares = added.sum(axis=0) + (count - len(added)) * added[-1]
    return float(np.sqrt(squares.mean() / count))


def _autocovariance(e: Float[Array, " M"], lags: int) -> Float[Array, " lags"]:
    """Autocovariance of errors about 0; 0 beyond their number."""
    spectrum = np.abs(np.fft.rfft(e, 2 * len(e))) ** 2
    found = np.fft.irfft(spectrum, 2 * len(e))[: min(lags, len(e))] / len(e)
    return np.pad(found, (0, lags - len(found)))
