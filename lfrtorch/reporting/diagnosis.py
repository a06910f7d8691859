"""What the records, their simulations and the history of a fit say about its errors, in numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import scipy

from lfrtorch._support.reasons import SPENT, Reason
from lfrtorch._support.types import Array
from lfrtorch.fitting.size_search import SizeSearch
from lfrtorch.fitting.trainer import FitResult, Trainer
from lfrtorch.least_squares.levenberg_marquardt import LevenbergMarquardt
from lfrtorch.linear.model import LinearModel
from lfrtorch.linear.spectra import spectra_of_periods
from lfrtorch.metrics import rms
from lfrtorch.records import Record
from lfrtorch.reporting.advice import Evidence
from lfrtorch.reporting.simulations import Response
from lfrtorch.reporting.verdict import Verdict

AVERAGES = 8
"""Segments for each regressor that a coherence is estimated from, at least."""

LONGEST, SHORTEST = 1024, 64
"""Samples of a segment: as long as the memory of an error filter may be, and too few to tell."""

LAGS = 12
"""Least memory of a filter that is fitted in time, to records too short for segments."""

SHIFTS = 0.276, 0.382, 0.618, 0.724
"""Parts of the records by which errors are shifted to see what is explained by chance: no fractions
of few periods."""

BEGINNING = 0.05
"""Part of a record that is its beginning."""

LAST = 5
"""Iterations that the pace of a search is taken from, at least; of a long one the last tenth."""

PARTS = 10
"""Parts of time in which the differences between periods are looked at."""

STEADY = 4.0
"""Power of the differences between periods in a tenth of them over the median of all tenths, from
which on they are no noise but a transient or a disturbance."""


def evidence(
    result: FitResult,
    responses: Sequence[Response],
    *,
    bla: LinearModel | None = None,
    noise_rms: float | None = None,
    continued: bool = False,
    ridge: bool = False,
    search: SizeSearch | None = None,
    trainer: Trainer | None = None,
    verdict: Verdict | None = None,
) -> Evidence:
    """The numbers that advice rests on.

    Args:
        result: the fit.
        responses: of the training records, and of validation and tests if there are any.
        bla: the linear model of the training records, whose free responses tell a wrong start.
        noise_rms: of the training outputs in their unit, if it is known.
        continued: whether the fit went on from a model.
        ridge: whether it had one.
        search: for the sizes, if validation chose them.
        trainer: of the fit. Default: Levenberg-Marquardt.
        verdict: on the fit, which advice agrees with.
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
    transient, free = (None, None) if bla is None else _transient(train, scale, bla)
    test = _error([r.error for r in tests], scale)
    linear_test = _error([r.linear_error for r in tests], scale)
    return Evidence(
        train=_error([r.error for r in train], scale),
        linear_train=_error([r.linear_error for r in train], scale),
        validation=_error([r.error for r in validation], scale),
        linear_validation=_error([r.linear_error for r in validation], scale),
        outputs=_by_output(validation or train),
        parameters=result.model.net_parameter_count,
        samples=sum(len(r.scored) for r in train),
        noise=None if noise is None else float(rms(noise / scale)),
        linear=linear,
        nonlinear=nonlinear,
        transient=transient,
        free=free,
        falling=falling(result),
        iterations=result.iterations,
        starts=_finished(result),
        started=max(1, len(result.starts)),
        continued=continued,
        sizes=result.model.sizes,
        searched=search is not None,
        largest=[] if search is None else search.largest,
        trainer=LevenbergMarquardt() if trainer is None else trainer,
        ridge=ridge,
        louder={
            test.record.name: float(
                np.max(_peak([test], result.model.scaler.u_offset) / np.where(peak > 0, peak, 1.0))
            )
            for test in tests
        },
        diverged=[r.record.name for r in responses if r.use != "train" and r.diverged],
        tests=test / linear_test if test and linear_test else None,
        verdict=verdict,
    )


def noise_of_periods(records: Sequence[Record]) -> Array | None:
    """Standard deviation (ny,) of the noise in the outputs, from the differences between periods.

    None if no record has two periods, if an input does not repeat, if the periods differ, or if
    the differences are not steady: those of a transient or a disturbance are no noise.
    """
    try:
        spectra = spectra_of_periods(records)
    except ValueError:
        return None
    if not spectra.freedom or not all(_steady(record, spectra.N) for record in records):
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
    alike = coherent_part(inputs, errors, of=both[0].shape[1])  # by the same filters' memory
    if beyond is None or alike is None:
        return linear, None
    return linear, max(0.0, beyond - alike)


def coherent_part(
    signals: Sequence[Array], errors: Sequence[Array], *, of: int | None = None
) -> float | None:
    """Part of the errors' power that linear filters of the signals explain, by Welch's method.

    At each line, it is the multiple coherence times the error's power. The coherence is corrected
    for its bias with n signals and K segments, as the adjusted R² is. With several outputs the
    largest part counts. For records too short for that see :func:`filtered_part`.

    Args:
        signals: one array a record.
        errors: those of the simulations, one array a record.
        of: number of signals that the filters' memory is short enough for. Default: n.

    Shape:
        signals: (T, n), errors: (T, ny) each.

    Returns:
        0 to 1, or None if the records are too short.
    """
    n = signals[0].shape[1]
    T, shortest = sum(map(len, errors)), min(map(len, errors))
    most = T / (AVERAGES * (of or n))
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
    # Lines that an input does not excite must not divide by their rounding errors.
    largest = float(np.real(np.trace(Sxx, axis1=1, axis2=2)).max())
    floor = np.eye(n) * max(1e-9 * largest, np.finfo(float).eps)
    explained = np.einsum("fxe,fxe->fe", Sxe.conj(), np.linalg.solve(Sxx + floor, Sxe)).real
    total = power.sum(axis=0)
    K = T / N
    left = np.minimum((power - explained) * K / (K - n), power)
    part = np.where(total > 0, (power - left).sum(axis=0) / np.where(total > 0, total, 1.0), 0.0)
    return float(np.clip(part.max(), 0.0, 1.0))


def filtered_part(signals: Sequence[Array], errors: Sequence[Array], lags: int) -> float | None:
    """Part of the errors' power that filters of a finite memory explain, by least squares.

    What they explain by chance is taken off: the mean of what they explain of the errors shifted in
    time, which is far more for slow errors than for white ones. With several outputs the largest
    part counts.

    Args:
        signals, errors: see :func:`coherent_part`.
        lags: samples of the memory.

    Returns:
        0 to 1, or None if the memory is too short.
    """
    if lags < LAGS:
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


def falling(result: FitResult) -> float:
    """Part by which the error that chooses fell over a tenth of the iterations, at the last pace.

    The pace is that of the last tenth, and of five iterations at least. 0 if the search ended for
    another reason than its limit, or rises.
    """
    history = result.history
    iterations = len(history) - 1
    if result.reason not in SPENT or not iterations:
        return 0.0
    last = min(max(LAST, iterations // 10), iterations)
    before = min(p.score for p in history[:-last])
    after = min(p.score for p in history)
    lately = min(p.score for p in history[-math.ceil(last / 2) :])
    if not (math.isfinite(before) and before > 0) or lately > after:
        return 0.0
    return 1.0 - math.sqrt(after / before) ** (iterations / 10 / last)


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


def _steady(record: Record, N: int) -> bool:
    """Whether the differences between successive periods of N samples have the same power in time.

    The first of two periods may have a transient, which is no noise.
    """
    count = (record.samples - record.skip) // N
    if count < 2:
        return True
    periods = record.y[record.samples - count * N :].reshape(count, N, -1)
    power = np.diff(periods, axis=0).reshape((count - 1) * N, -1) ** 2
    parts = np.array([part.mean(axis=0) for part in np.array_split(power, PARTS)])
    return bool(np.all(parts.max(axis=0) <= STEADY * np.median(parts, axis=0)))


def _transient(
    train: Sequence[Response], scale: Array, bla: LinearModel
) -> tuple[float | None, float | None]:
    """What the errors at the beginning of the records say of the start states.

    Returns:
        The error there over that in the rest, and the part of its power that free responses of the
        linear model explain: their states are fitted to the first half of the beginning, and are to
        be right in the second, too. None if the starts are known or fitted.
    """
    first, rest, left = [], [], []
    for response in train:
        if response.record.start in ("periodic", "estimated"):
            continue
        error = response.error / scale
        count = math.ceil(BEGINNING * len(error))
        first.append(error[:count])
        rest.append(error[count:])
        x, free = np.linalg.matrix_power(bla.A, response.record.skip), []
        for _ in range(count):
            free.append(bla.C @ x / scale[:, None])
            x = bla.A @ x
        half = max(1, count // 2)
        if half * len(scale) > bla.nx and np.isfinite(error[:count]).all():
            response_to = np.array(free)
            state = np.linalg.lstsq(
                response_to[:half].reshape(-1, bla.nx), error[:half].ravel(), rcond=None
            )[0]
            left.append(error[:count] - response_to @ state)
    if not first or not sum(map(len, rest)):
        return None, None
    beginning, usual = (float(np.mean(rms(np.concatenate(part), axis=0))) for part in (first, rest))
    if not (0 < usual < math.inf and math.isfinite(beginning)):
        return None, None
    free_part = None
    if len(left) == len(first) and beginning > 0:
        powers = [sum(float(np.sum(part**2)) for part in parts) for parts in (left, first)]
        free_part = max(0.0, 1.0 - powers[0] / powers[1])
    return beginning / usual, free_part


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
