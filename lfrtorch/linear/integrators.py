"""Integrators in a linear model: one or two poles at z = 1, exactly, behind outputs.

The output of a system that integrates is y = G(z) u with (z - 1)ⁿ G = G₁ + (z - 1) Q₁ + ... +
(z - 1)ⁿ Qₙ, where G₁ is stable. So the difference v = (z - 1)ⁿ y is the output of G₁ for the input
u, plus constants times differences of u. Methods for stable systems find G₁ and the constants. The
integrators are put back behind them:

    x+ = A x + B u,   s₁+ = s₁ + C x + D u,   s₂+ = s₂ + s₁ + Q₁ u,   ...   y = sₙ + Qₙ u.

The difference turns white noise of y into blue noise, and errors that the system has integrated,
such as those of friction, into white noise. Both together make the error of the difference a
moving average 1 - λ z⁻¹ of white noise. All signals are filtered by 1 / (1 - λ z⁻¹), which whitens
the error and leaves G₁ as it is: with λ = 0 the fit is to the difference, with λ near 1 to the
output itself. The unknown initial state of the filters adds a multiple of λᵏ to the output; the
multiple is a parameter.

Some outputs may have one integrator and others none, as a position and a speed do. Then only the
outputs with an integrator are differenced, and nothing is filtered, as the errors of the two kinds
of output differ.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy
from jaxtyping import Bool

from lfrtorch._support.errors import InputError
from lfrtorch._support.types import Array, Booleans
from lfrtorch.data.metrics import rms
from lfrtorch.data.records import Channel, NormalisedRecord, Record, Scaler, interpolated
from lfrtorch.engine.lfr import LFR
from lfrtorch.linear.frf import FRF
from lfrtorch.linear.model import LinearFit, LinearModel, linear_cell
from lfrtorch.model.model import simulate_record

_SAME_LINE = 1e-9
"""A line nearer to z = 1 than this is the line at 0 Hz, where the response is infinite."""


def integrators_of(integrators: int | Sequence[int], ny: int) -> tuple[int, ...]:
    """Return the number of integrators behind each output."""
    each = np.ravel(np.asarray(integrators, dtype=object)).tolist()
    each = each * ny if len(each) == 1 else each
    if len(each) != ny or any(n not in (0, 1, 2) for n in each):
        raise InputError(
            f"integrators is {integrators!r}; give 0, 1 or 2, or a list with one of them for each "
            f"of {ny} output(s)."
        )
    if len({*each}) > 1 and 2 in each:
        raise InputError(
            f"integrators is {integrators!r}; two are for all outputs or none: give 0 or 1 each."
        )
    return tuple(map(int, each))


def without_limits(record: Record, integrates: Bool[Booleans, " ny"]) -> Record:
    """Return a record whose integrating outputs are not valid where they are at a limit.

    The distance of an output beyond its limit is not known, and neither are its differences.
    """
    if record.limits is None or record.start == "periodic":
        return record
    none = np.array([[-np.inf], [np.inf]])
    return replace(
        record,
        valid=record.is_valid & ~(integrates & (record.beyond != 0)),
        limits=np.where(integrates, none, np.asarray(record.limits)),
    )


def differenced(
    records: Sequence[Record],
    integrators: int,
    differences: int = 0,
    pole: float = 0.0,
    integrates: Bool[Booleans, " ny"] | None = None,
    whole: LinearModel | None = None,
) -> list[Record]:
    """Return the records of G₁: the output differenced n times, and all signals filtered.

    If only some outputs integrate, the others stay as they are. A difference is valid if all its
    samples are. Holes are filled from a model of the ``whole`` system, for the filters.

    The new inputs are u, its ``differences`` and, for filters with a pole λ, their free responses.
    """
    found = []
    for i, record in enumerate(records):
        u, v, r, T = record.u, record.y, record.reference, record.samples - integrators
        if record.start == "periodic":
            for _ in range(integrators):
                v = np.roll(v, -1, axis=0) - v
            periods = record.with_signals(
                u=u, y=v, reference=r, valid=None, limits=None, start="periodic",
                skip=record.skip, period=record.period,
            )  # fmt: skip
            found.append(periods)
            continue
        there = record.is_valid
        if whole is not None and record.valid is not None:
            y = whole.simulate(replace(record, skip=0))
            v = y + interpolated(v - y, there)
        u = np.hstack([np.diff(u, times, axis=0)[:T] for times in range(differences + 1)])
        changes, skip = np.diff(v, integrators, axis=0), min(record.skip, T - 1)
        valid = np.logical_and.reduce([there[k : T + k] for k in range(integrators + 1)])
        if integrates is not None:
            changes = np.where(integrates, changes, v[:T])
            valid = np.where(integrates, valid, there[:T])
        v = changes
        if pole:
            u, v = (_filtered(signal, integrators, pole) for signal in (u, v))
            starts = np.zeros((T, len(records), integrators))
            starts[skip:, i] = _filter_starts(T - skip, integrators, pole)
            u = np.hstack([u, starts.reshape(T, -1)])
        more = tuple(Channel(f"added {j}") for j in range(u.shape[1] - len(record.inputs)))
        r = None if r is None or more else r[:T]
        differenced = record.with_signals(
            u=u, y=v, reference=r, valid=valid, limits=record.limits, start="estimated",
            skip=skip, period=None, inputs=record.inputs + more,
        )  # fmt: skip
        found.append(differenced)
    return found


def _filtered(signal: Array, times: int, pole: float) -> Array:
    """Filter a signal some times about its mean."""
    mean = signal.mean(axis=0)
    signal = signal - mean
    for _ in range(times):
        signal = scipy.signal.lfilter([1.0 - pole], [1.0, -pole], signal, axis=0)
    return signal + mean


def whitening_pole(errors: Sequence[Array], integrators: int, pole: float = 0.0) -> float:
    """Return the pole λ of n filters that makes errors of G₁, filtered by ``pole`` so far, white.

    The errors count as white noise of the output, differenced n times, plus white noise of G₁.
    That is a moving average (1 - λ z⁻¹)ⁿ of white noise, and its λ leaves the least power.
    """
    n, T = integrators, min(map(len, errors))
    plain = [scipy.signal.lfilter(np.poly([pole] * n), [1.0], e, axis=0)[n:] for e in errors]
    # The filters together have a time constant of at most a tenth of the shortest record.
    poles = 1.0 - np.geomspace(1.0, min(1.0, n / (0.1 * T)), 50)
    left = np.array([np.sum([_squares(e, n, pole) for e in plain], axis=0) for pole in poles])
    return float(poles[np.argmin(np.log(np.maximum(left, 1e-300)).sum(axis=1))])


def _squares(errors: Array, n: int, pole: float) -> Array:
    """Return the squares (ny,) of filtered errors (T, ny), for the best start and constant."""
    T, ny = errors.shape
    signals = np.hstack([errors, np.ones((T, 1))])
    filtered = scipy.signal.lfilter([1.0], np.poly([pole] * n), signals, axis=0)
    known = np.hstack([filtered[:, ny:], _filter_starts(T, n, pole)])
    known /= np.maximum(np.linalg.norm(known, axis=0), 1e-300)
    left = filtered[:, :ny] - known @ np.linalg.lstsq(known, filtered[:, :ny], rcond=None)[0]
    return np.sum(left**2, axis=0)


def _filter_starts(samples: int, n: int, pole: float) -> Array:
    """Return the free responses (T, n) of n filters: λᵏ, k λᵏ, ..."""
    k = np.arange(float(samples))[:, None]
    return pole**k * k ** np.arange(n)


def differenced_response(frf: FRF, integrators: int) -> FRF:
    """(z - 1)ⁿ times a response, without the line at 0."""
    z = np.exp(2j * np.pi * frf.frequencies / frf.fs)
    kept = np.abs(z - 1.0) > _SAME_LINE
    z = z[kept]
    factor = (z - 1.0) ** integrators
    size = np.abs(factor)[:, None, None] ** 2
    return replace(
        frf,
        frequencies=frf.frequencies[kept],
        G=factor[:, None, None] * frf.G[kept],
        cov_noise=None if frf.cov_noise is None else size * frf.cov_noise[kept],
        cov_total=None if frf.cov_total is None else size * frf.cov_total[kept],
        y_offset=np.zeros_like(frf.y_offset),
        distortion=None,
        errors=frf.errors and frf.errors.at(kept).times(factor[:, None], 1.0),
    )


def differenced_weight(frf: FRF, weight: Array, integrators: int) -> Array:
    """Turn weights (F, ny, nu) of the errors of a response into weights of the errors of G₁."""
    size = np.abs(np.exp(2j * np.pi * frf.frequencies / frf.fs) - 1.0)
    kept = size > _SAME_LINE
    return weight[kept] / size[kept, None, None] ** (2 * integrators)


def gain(records: Sequence[Record], *, offset: bool) -> LinearModel:
    """Fit a model without states, the input times a matrix, by least squares."""
    first, scaler = records[0], Scaler.of(records, offset=offset)
    parts = [(scaler.normalise(r), r.skip) for r in records]
    u = np.concatenate([n.u[skip:] for n, skip in parts])
    y = np.concatenate([n.y[skip:] for n, skip in parts])
    rows, valid = np.hstack([u, np.full((len(u), 1), float(offset))]), scored(records)
    each = [np.linalg.lstsq(rows[s], y[s, i], rcond=None)[0] for i, s in enumerate(valid.T)]
    solved, nu = np.column_stack(each), u.shape[1]
    return LinearModel(
        np.zeros((0, 0)),
        np.zeros((0, nu)),
        np.zeros((y.shape[1], 0)),
        scaler.y_scale[:, None] * solved[:nu].T / scaler.u_scale,
        first.fs,
        scaler.u_offset,
        scaler.restore_y(solved[nu]),
        first.inputs,
        first.outputs,
        fit=LinearFit(
            "simulation", float(rms((y - rows @ solved)[valid])), 0, "linear least squares", 0.0
        ),
    )


def scored(records: Sequence[Record]) -> Booleans:
    """Return the mask of the scored outputs of all records, after the skipped samples."""
    return np.concatenate([record.scored[record.skip :] for record in records])


def simulation_errors(model: LinearModel, record: Record) -> Array:
    """Return errors (T - skip, ny), 0 where not scored; all samples estimate the start."""
    if model.nx:
        y = model.simulate(replace(record, skip=0))
    else:
        y = model.y_offset + (record.u - model.u_offset) @ model.D.T
    return record.errors(y)


def integrated(
    model: LinearModel,
    like: FRF | Record,
    integrators: int,
    differences: int,
    integrates: Bool[Booleans, " ny"],
) -> LinearModel:
    """Put integrators behind outputs of a model; their states come last.

    The operating point of the input moves to where the integrators stand still, or nearly so.
    """
    nu, added = len(like.inputs), int(integrates.sum())

    def behind(A: Array, B: Array, C: Array, D: Array, one: float = 1.0) -> list[Array]:
        B, one_each = B[:, :nu], one * np.eye(added)
        beside, C = C, C[integrates]
        known = np.pad(D[:, : nu * (differences + 1)], ((0, 0), (0, nu * integrators)))
        gains = [known[:, i * nu : (i + 1) * nu] for i in range(integrators + 1)]
        for gain in gains[:-1]:
            nothing = np.zeros((len(A), added))
            A = np.block([[A, nothing], [C, one_each]])
            B, C = np.vstack([B, gain[integrates]]), np.hstack([nothing.T, one_each])
        whole = np.pad(beside, ((0, 0), (0, len(A) - beside.shape[1])))
        whole[integrates] = C
        return [A, B, whole, np.where(integrates[:, None], gains[-1], D[:, :nu])]

    matrices = model.A, model.B, model.C, model.D
    covariance = model.covariance
    if covariance is not None:  # all entries are entries of the given matrices, or constants
        sizes = [matrix.size for matrix in matrices]
        numbers = np.split(np.arange(1.0, 1.0 + sum(sizes)), np.cumsum(sizes)[:-1])
        numbered = (n.reshape(m.shape) for n, m in zip(numbers, matrices, strict=True))
        entries = np.concatenate([part.ravel() for part in behind(*numbered, one=0.0)]).astype(int)
        covariance = np.pad(covariance, ((1, 0), (1, 0)))[np.ix_(entries, entries)]
    u_offset, others = model.u_offset[:nu], model.u_offset[nu:]
    constant = model.y_offset - model.D[:, nu:] @ others
    if constant[integrates].any():
        at_rest = model.D + model.C @ np.linalg.solve(np.eye(model.nx) - model.A, model.B)
        still = at_rest[integrates, :nu]
        step = -np.linalg.lstsq(still, constant[integrates], rcond=None)[0]
        u_offset, constant = u_offset + step, constant + at_rest[:, :nu] @ step
    A, B, C, D = behind(*matrices)
    return replace(
        model,
        A=A,
        B=B,
        C=C,
        D=D,
        u_offset=u_offset,
        y_offset=np.where(integrates, 0.0, constant),
        inputs=like.inputs,
        outputs=like.outputs,
        covariance=covariance,
    )


def placed(
    model: LinearModel,
    records: Sequence[Record],
    integrators: int,
    integrates: Bool[Booleans, " ny"],
    *,
    offset: bool,
) -> LinearModel:
    """Put a model about the operating point of records, with states of unit standard deviation."""
    records = [replace(r, start="estimated") if r.start == "periodic" else r for r in records]
    scaler = Scaler.of(records, offset=offset)
    model = replace(model, y_offset=np.where(integrates, scaler.y_offset, model.y_offset))
    at_rest = [record for record in records if record.start == "zero"]
    if offset and at_rest:  # an estimated start state has the output's offset in it
        errors = np.concatenate([simulation_errors(model, r) for r in at_rest])
        error = errors.sum(axis=0) / scored(at_rest).sum(axis=0)
        model = replace(model, y_offset=model.y_offset + error)
    lfr = LFR(linear_cell(model.A, model.B, model.C, model.D))
    states = []
    for r in records:
        about = NormalisedRecord(r.u - model.u_offset, r.y - model.y_offset, replace(r, skip=0))
        states.append(simulate_record(lfr, about, r.start).x[0, :-1].numpy())
    std = np.concatenate(states).std(axis=0)
    std = np.where(std > 0, std, 1.0)
    model = model.transformed(np.diag(1.0 / std), np.diag(std))
    last = range(model.nx - integrators, model.nx)
    A = model.A.copy()
    A[last, last] = 1.0  # without rounding
    model, fit = replace(model, A=A), model.fit
    assert fit is not None
    if fit.criterion == "simulation":
        errors = np.concatenate([simulation_errors(model, r) for r in records])
        fit = replace(fit, rmse=float(rms((errors / scaler.y_scale)[scored(records)])))
    return replace(model, fit=fit)
