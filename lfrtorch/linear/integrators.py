"""Integrators in a linear model: one or two poles at z = 1, exactly, behind each output.

The output of a system that integrates is y = G(z) u with G = G₁(z) / (z - 1), where G₁ is stable.
So G₁ is the system from u to the difference v(k) = y(k + 1) - y(k), which the methods for stable
systems find, and the integrator is put back behind it:

    x+ = A x + B u,   s+ = s + C x + D u,   y = s.

The difference turns white noise of y into blue noise, and errors that the system has integrated,
such as those of friction, into white noise. With both of them the error of the difference is a
moving average 1 - λ z⁻¹ of white noise. Both signals are filtered by 1 / (1 - λ z⁻¹), which whitens
the error and leaves G₁ as it is: with λ = 0 the fit is to the difference, with λ near 1 to the
output itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import comb

import numpy as np
import scipy

from lfrtorch._support.types import Array
from lfrtorch.engine.lfr import LFR
from lfrtorch.linear.frf import FRF
from lfrtorch.linear.model import LinearFit, LinearModel, linear_cell
from lfrtorch.metrics import rms
from lfrtorch.model import simulate_record
from lfrtorch.records import Channel, NormalisedRecord, Record, Scaler

FORGOTTEN = 3.0
"""The filter's time constants after which its start no longer counts."""

LONGEST = 0.1
"""Largest time constant of the n filters together, in lengths of the shortest record."""

SAME_LINE = 1e-9
"""Distance from z = 1 below which a line is the one at 0, where the response is infinite."""


def differenced(
    record: Record, integrators: int, pole: float = 0.0, *, feedthrough: bool
) -> Record:
    """The record of G₁: the output differenced, and both signals filtered.

    Args:
        record: u (T, nu) and y (T, ny).
        integrators: how often the output is differenced; each time takes one sample off, and the
            start state is unknown.
        pole: λ.
        feedthrough: whether v(k) = y(k) - y(k - 1), so that the input acts on the output at once.
    """
    u, r, v, n = record.u, record.reference, record.y, integrators
    if record.start == "periodic":
        for _ in range(n):
            v = v - np.roll(v, 1, axis=0) if feedthrough else np.roll(v, -1, axis=0) - v
        return replace(record, y=v, limits=None)
    kept = slice(n, None) if feedthrough else slice(len(u) - n)
    v, u, r = np.diff(v, n, axis=0), u[kept], None if r is None else r[kept]
    skip = record.skip
    if pole:
        for _ in range(n):
            u, v = (scipy.signal.lfilter([1.0 - pole], [1.0, -pole], s, axis=0) for s in (u, v))
        skip = max(skip, round(n * FORGOTTEN / (1.0 - pole)))
    outputs = tuple(Channel(f"{c.name} differenced", c.unit) for c in record.outputs)
    skip = min(skip, len(u) - 1)
    return replace(
        record, u=u, y=v, reference=r, skip=skip, start="estimated", outputs=outputs, period=None,
        limits=None,
    )  # fmt: skip


def whitening_pole(errors: Sequence[Array], integrators: int) -> float:
    """λ such that the errors of G₁ without a filter are white after n filters.

    The errors count as white noise of the output, n times differenced, and white noise of G₁: a
    moving average (1 - λ z⁻¹)ⁿ, whose autocorrelation at lag 1 gives λ.

    Args:
        errors: of each record, (T, ny).
        integrators: n.
    """
    products = sum(float(np.sum(e[1:] * e[:-1])) for e in errors)
    power = sum(float(np.sum(e**2)) for e in errors)
    most = max(0.0, 1.0 - integrators / (LONGEST * min(len(e) for e in errors)))
    poles = np.linspace(0.0, most, 200)
    signs = np.array([comb(integrators, i) * (-1.0) ** i for i in range(integrators + 1)])
    average = signs * poles[:, None] ** np.arange(integrators + 1)
    correlation = (average[:, 1:] * average[:, :-1]).sum(axis=1) / (average**2).sum(axis=1)
    return float(poles[np.argmin(np.abs(correlation - products / max(power, 1e-300)))])


def differenced_response(frf: FRF, integrators: int, *, feedthrough: bool) -> FRF:
    """The response of G₁, without the line at 0."""
    z = np.exp(2j * np.pi * frf.frequencies / frf.fs)
    kept = np.abs(z - 1.0) > SAME_LINE
    z = z[kept]
    factor = ((z - 1.0) / (z if feedthrough else 1.0)) ** integrators
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
    """Weights (F, ny, nu) of the errors of a response for those of G₁."""
    size = np.abs(np.exp(2j * np.pi * frf.frequencies / frf.fs) - 1.0)
    kept = size > SAME_LINE
    return weight[kept] / size[kept, None, None] ** (2 * integrators)


def gain(records: Sequence[Record], *, offset: bool) -> LinearModel:
    """A model without states: the input times a matrix, by least squares."""
    first = records[0]
    u, y = (np.concatenate([getattr(r, name)[r.skip :] for r in records]) for name in ("u", "y"))
    u_offset, y_offset = (s.mean(axis=0) * offset for s in (u, y))
    D = np.linalg.lstsq(u - u_offset, y - y_offset, rcond=None)[0].T
    ny, nu = D.shape
    errors = y - y_offset - (u - u_offset) @ D.T
    rmse = float(rms(errors / np.maximum(y.std(axis=0), 1e-300)))
    return LinearModel(
        np.zeros((0, 0)),
        np.zeros((0, nu)),
        np.zeros((ny, 0)),
        D,
        first.fs,
        u_offset,
        y_offset,
        first.inputs,
        first.outputs,
        fit=LinearFit("simulation", rmse, 0, "linear least squares", 0.0),
    )


def simulation_errors(model: LinearModel, record: Record) -> Array:
    """Errors (T - skip, ny) of what counts; an estimated start is that of all samples."""
    if model.nx:
        y = model.simulate(replace(record, skip=0))
    else:
        y = model.y_offset + (record.u - model.u_offset) @ model.D.T
    return (record.y - y)[record.skip :]


def integrated(model: LinearModel, *, feedthrough: bool) -> LinearModel:
    """The model with an integrator behind each output, whose states come last.

    The operating point of the input moves to where the output of the given model is 0, so that the
    integrators stay where they are; with fewer inputs than outputs as close to it as it can.
    """
    nx, ny = model.nx, len(model.outputs)

    def behind(A: Array, B: Array, C: Array, D: Array, one: float = 1.0) -> list[Array]:
        return [
            np.block([[A, np.zeros((nx, ny))], [C, one * np.eye(ny)]]),
            np.vstack([B, D]),
            np.hstack([C if feedthrough else np.zeros_like(C), one * np.eye(ny)]),
            D if feedthrough else np.zeros_like(D),
        ]

    matrices = model.A, model.B, model.C, model.D
    covariance = model.covariance
    if covariance is not None:  # all entries are entries of the given matrices, or constants
        sizes = [matrix.size for matrix in matrices]
        numbers = np.split(np.arange(1.0, 1.0 + sum(sizes)), np.cumsum(sizes)[:-1])
        numbered = (n.reshape(m.shape) for n, m in zip(numbers, matrices, strict=True))
        entries = np.concatenate([part.ravel() for part in behind(*numbered, one=0.0)]).astype(int)
        covariance = np.pad(covariance, ((1, 0), (1, 0)))[np.ix_(entries, entries)]
    u_offset = model.u_offset
    if model.y_offset.any():
        at_rest = model.D + model.C @ np.linalg.solve(np.eye(nx) - model.A, model.B)
        u_offset = u_offset - np.linalg.lstsq(at_rest, model.y_offset, rcond=None)[0]
    A, B, C, D = behind(*matrices)
    return replace(
        model,
        A=A,
        B=B,
        C=C,
        D=D,
        u_offset=u_offset,
        y_offset=np.zeros(ny),
        covariance=covariance,
    )


def placed(
    model: LinearModel, records: Sequence[Record], integrators: int, *, offset: bool
) -> LinearModel:
    """The model about the operating point of records, its states with unit deviation over them.

    Args:
        model: it ends with its integrators.
        records: signals; those in steady state are simulated from an estimated state.
        integrators: how many states they are.
        offset: whether the output has an operating point.
    """
    records = [replace(r, start="estimated") if r.start == "periodic" else r for r in records]
    scaler = Scaler.of(records, offset=offset)
    model = replace(model, y_offset=scaler.y_offset)
    if offset:
        error = np.concatenate([simulation_errors(model, r) for r in records]).mean(axis=0)
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
        fit = replace(fit, rmse=float(rms(errors / scaler.y_scale)))
    return replace(model, fit=fit)
