"""Part of simulation errors that a filter explains: the model lacks these dynamics."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import scipy

from lfrtorch._support.types import Array
from lfrtorch.reporting.evaluation import Response

LONGEST = 1024
"""Largest number of samples of a segment, which limits the memory of an error filter."""

SHORTEST = 64
"""Smallest number of samples of a segment."""


SHIFTS = 0.276, 0.382, 0.618, 0.724
"""Shifts of the errors, as parts of the records, that show what is explained by chance. None is
near a simple fraction, so that periodic errors do not coincide with themselves."""


def explained_parts(train: Sequence[Response]) -> tuple[float | None, float | None]:
    """Part of the errors that filters of the inputs explain, and further part by outputs² and ³."""
    # If the first is large, states are missing; if the second is large, the static map is too
    # small. Both are None if the records are too short, or a simulation diverges.
    errors = [response.error for response in train]
    inputs = [response.record.u[response.record.skip :] for response in train]
    if any(response.diverged for response in train):
        return None, None
    outputs = [response.y_hat[response.record.skip :] for response in train]
    every = np.concatenate(outputs)
    centre, scale = every.mean(axis=0), every.std(axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    powers = [np.hstack([((y - centre) / scale) ** degree for degree in (2, 3)]) for y in outputs]
    linear = coherent_part(inputs, errors)
    both = [np.hstack(pair) for pair in zip(inputs, powers, strict=True)]
    beyond = coherent_part(both, errors)
    alike = coherent_part(inputs, errors, of=both[0].shape[1])  # with the same memory of filters
    if beyond is None or alike is None:
        return linear, None
    return linear, max(0.0, beyond - alike)


def coherent_part(
    signals: Sequence[Array],
    errors: Sequence[Array],
    *,
    of: int | None = None,  # number of signals that sets the memory of the filters; default: n
) -> float | None:
    """Part of the errors' power that linear filters of the signals explain, by Welch's method."""
    # At each line, the explained power is the multiple coherence times the error's power. It is
    # corrected for its bias with n signals and K segments, like the adjusted R². With several
    # outputs, the largest part is returned.
    n = signals[0].shape[1]
    T, shortest = sum(map(len, errors)), min(map(len, errors))
    # A coherence is estimated from at least 8 segments for each regressor.
    most = T / (8 * (of or n))
    N = 2 ** int(math.log2(max(1, min(LONGEST, most, shortest))))
    if N < SHORTEST:
        return filtered_part(signals, errors, min(int(most), shortest // 2))
    S = np.zeros((N // 2 + 1, n + errors[0].shape[1], n + errors[0].shape[1]), complex)
    for x, e in zip(signals, errors, strict=True):
        both = np.hstack([x, e])
        deviation = np.where(both.std(axis=0) > 0, both.std(axis=0), 1.0)
        scaled = both / np.hstack([deviation[:n], np.ones(e.shape[1])])
        _, _, Z = scipy.signal.stft(
            scaled.T, nperseg=N, boundary=None, padded=False, detrend="constant"
        )
        S += np.einsum("ift,jft->fij", Z, Z.conj())
    Sxx, Sxe = S[:, :n, :n], S[:, :n, n:]
    power = np.real(np.diagonal(S, axis1=1, axis2=2))[:, n:]
    # At lines that an input does not excite, Sxx is a rounding error, and must not divide.
    largest = float(np.real(np.trace(Sxx, axis1=1, axis2=2)).max())
    floor = np.eye(n) * max(1e-9 * largest, np.finfo(float).eps)
    explained = np.einsum("fxe,fxe->fe", Sxe.conj(), np.linalg.solve(Sxx + floor, Sxe)).real
    total = power.sum(axis=0)
    K = T / N
    left = np.minimum((power - explained) * K / (K - n), power)
    part = np.where(total > 0, (power - left).sum(axis=0) / np.where(total > 0, total, 1.0), 0.0)
    return float(np.clip(part.max(), 0.0, 1.0))


def filtered_part(signals: Sequence[Array], errors: Sequence[Array], lags: int) -> float | None:
    """Part of the errors' power that filters of ``lags`` samples explain, by least squares."""
    # The part that is explained by chance is subtracted: the mean part for errors that are shifted
    # in time. It is far larger for slow errors than for white ones. The result is None for filters
    # with too short a memory.
    if lags < 12:
        return None
    memory = np.concatenate(
        [
            np.lib.stride_tricks.sliding_window_view(x, lags, axis=0).reshape(-1, x.shape[1] * lags)
            for x in signals
        ]
    )
    left = np.concatenate([e[lags - 1 :] for e in errors])
    memory, left = memory - memory.mean(axis=0), left - left.mean(axis=0)
    U, s, _ = np.linalg.svd(memory, full_matrices=False)
    U = U[:, s > 1e-9 * max(s[0], np.finfo(float).tiny)]
    total = np.sum(left**2, axis=0)
    total = np.where(total > 0, total, 1.0)
    explained, *chance = (
        np.sum((U.T @ np.roll(left, round(part * len(left)), axis=0)) ** 2, axis=0) / total
        for part in (0.0, *SHIFTS)
    )
    by_chance = np.minimum(np.mean(chance, axis=0), 1.0 - 1e-9)
    return float(np.clip(np.max((explained - by_chance) / (1.0 - by_chance)), 0.0, 1.0))
