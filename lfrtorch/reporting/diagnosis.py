"""What the records, their simulations and the history of a fit say about its errors, in numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import scipy

from lfrtorch._support.reasons import SPENT, Reason
from lfrtorch._support.types import Array
from lfrtorch.fitting.trainer import FitResult
from lfrtorch.linear.spectra import spectra_of_periods
from lfrtorch.metrics import rms
from lfrtorch.records import Record
from lfrtorch.reporting.advice import Evidence
from lfrtorch.reporting.simulations import Response

AVERAGES = 8
"""Segments for each regressor that a coherence is estimated from, at least."""

LONGEST, SHORTEST = 1024, 64
"""Samples of a segment: as long as the memory of an error filter may be, and too few to tell."""

BEGINNING = 0.05
"""Part of a record that is its beginning."""


def evidence(
    result: FitResult,
    responses: Sequence[Response],
    *,
    noise_rms: float | None = None,
    continued: bool = False,
    ridge: bool = False,
    searched: bool = False,
    trainer: str = "LevenbergMarquardt",
) -> Evidence:
    """The numbers that advice rests on.

    Args:
        result: the fit.
        responses: of the training records, and of validation and tests if there are any.
        noise_rms: of the training outputs in their unit, if it is known.
        continued: whether the fit went on from a model.
        ridge: whether it had one.
        searched: whether validation chose the sizes.
        trainer: its class.
    """
    train, validation, tests = (
        [response for response in responses if response.use == use]
        for use in ("train", "validation", "test")
    )
    y = np.concatenate([response.scored for response in train])
    scale = np.std(y, axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    noise = noise_of_periods([response.record for response in train])
    if noise is None and noise_rms is not None:
        noise = np.full(len(scale), noise_rms)
    linear, nonlinear = explained_parts(train)
    peak = _peak(train, result.model.scaler.u_offset)
    return Evidence(
        train=_error([r.error for r in train], scale),
        linear_train=_error([r.linear_error for r in train], scale),
        validation=_error([r.error for r in validation], scale),
        linear_validation=_error([r.linear_error for r in validation], scale),
        outputs=_by_output(validation or train),
        noise=None if noise is None else float(rms(noise / scale)),
        linear=linear,
        nonlinear=nonlinear,
        transient=_transient(train, scale),
        falling=falling(result),
        iterations=result.iterations,
        starts=_finished(result),
        started=max(1, len(result.starts)),
        continued=continued,
        sizes=result.model.sizes,
        searched=searched,
        trainer=trainer,
        ridge=ridge,
        louder={
            test.record.name: float(
                np.max(_peak([test], result.model.scaler.u_offset) / np.where(peak > 0, peak, 1.0))
            )
            for test in tests
        },
        diverged=[test.record.name for test in tests if test.diverged],
    )


def noise_of_periods(records: Sequence[Record]) -> Array | None:
    """Standard deviation (ny,) of the noise in the outputs, from the differences between periods.

    None if no record has two periods, if an input does not repeat, or if the periods differ.
    """
    try:
        spectra = spectra_of_periods(records)
    except ValueError:
        return None
    if not spectra.freedom:
        return None
    power = np.diagonal(spectra.C, axis1=1, axis2=2).real  # of each line
    return np.sqrt(power[1:, : records[0].y.shape[1]].sum(axis=0))


def explained_parts(train: Sequence[Response]) -> tuple[float | None, float | None]:
    """Parts of the errors' power that linear filters would explain.

    Returns:
        What filters of the inputs explain, and what those of the squares and cubes of the simulated
        outputs explain beyond: the first says that states are missing, the second that the static
        map is too small. None if the records are too short, or a simulation diverges.
    """
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
    if linear is None or beyond is None:
        return linear, None
    return linear, max(0.0, beyond - linear)


def coherent_part(signals: Sequence[Array], errors: Sequence[Array]) -> float | None:
    """Part of the errors' power that linear filters of the signals explain, by Welch's method.

    At each line, it is the multiple coherence times the error's power. The coherence is corrected
    for its bias with n signals and K segments, as the adjusted R² is. With several outputs the
    largest part counts.

    Args:
        signals: one array a record.
        errors: those of the simulations, one array a record.

    Shape:
        signals: (T, n), errors: (T, ny) each.

    Returns:
        0 to 1, or None if the records are too short.
    """
    n = signals[0].shape[1]
    T, shortest = sum(map(len, errors)), min(map(len, errors))
    N = 2 ** int(math.log2(max(1, min(LONGEST, T / (AVERAGES * n), shortest))))
    if N < SHORTEST:
        return None
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
    # Lines that an input does not excite must not divide by their rounding errors.
    largest = float(np.real(np.trace(Sxx, axis1=1, axis2=2)).max())
    floor = np.eye(n) * max(1e-9 * largest, np.finfo(float).eps)
    explained = np.einsum("fxe,fxe->fe", Sxe.conj(), np.linalg.solve(Sxx + floor, Sxe)).real
    total = power.sum(axis=0)
    K = T / N
    left = np.minimum((power - explained) * K / (K - n), power)
    part = np.where(total > 0, (power - left).sum(axis=0) / np.where(total > 0, total, 1.0), 0.0)
    return float(np.clip(part.max(), 0.0, 1.0))


def falling(result: FitResult) -> float:
    """Part by which the error that chooses fell over the last tenth of the iterations.

    0 if the search ended for another reason than its limit.
    """
    history = result.history
    if result.reason not in SPENT or len(history) < 2:
        return 0.0
    tenth = max(1, len(history) // 10)
    before = min(p.score for p in history[:-tenth])
    after = min(p.score for p in history)
    if not (math.isfinite(before) and before > 0):
        return 0.0
    return 1.0 - math.sqrt(after / before)


def _error(errors: Sequence[Array], scale: Array) -> float | None:
    """RMS of errors in units of the scale; None without records or if one diverges."""
    if not errors:
        return None
    error = float(rms(rms(np.concatenate(errors), axis=0) / scale))
    return error if math.isfinite(error) else None


def _by_output(responses: Sequence[Response]) -> dict[str, float]:
    """The NL-LFR's error over the linear model's by output, if there are several."""
    outputs = responses[0].record.outputs
    linear, error = (
        rms(np.concatenate(errors), axis=0)
        for errors in ([r.linear_error for r in responses], [r.error for r in responses])
    )
    if len(outputs) == 1 or not np.isfinite(error).all():
        return {}
    return {c.name: float(e / b) for c, e, b in zip(outputs, error, linear, strict=True) if b > 0}


def _transient(train: Sequence[Response], scale: Array) -> float | None:
    """Error at the beginning of the records over the rest; None if their start is known."""
    first, rest = [], []
    for response in train:
        if response.record.start not in ("periodic", "estimated"):
            error = response.error / scale
            count = math.ceil(BEGINNING * len(error))
            first.append(error[:count])
            rest.append(error[count:])
    if not first or not sum(map(len, rest)):
        return None
    beginning, usual = (float(np.mean(rms(np.concatenate(part), axis=0))) for part in (first, rest))
    return beginning / usual if 0 < usual < math.inf and math.isfinite(beginning) else None


def _peak(responses: Sequence[Response], offset: Array) -> Array:
    """Largest deviation (nu,) of the inputs from the operating point."""
    return np.max([np.abs(r.record.u - offset).max(axis=0) for r in responses], axis=0)


def _finished(result: FitResult) -> list[float]:
    """Errors of the starts that went to the end, on validation if there is one."""
    found = [
        start.train if math.isnan(start.validation) else start.validation
        for start in result.starts
        if start.reason != Reason.OTHERS_BETTER
    ]
    return sorted(error for error in found if math.isfinite(error))
