"""Parametric best linear approximation (BLA): a linear state-space model of a given order.

Records or a response become a least-squares problem in normalised units (``pose``), whose best
minimum ``minima`` finds. The result is put into balanced coordinates and physical units, with its
covariance and notes on what is doubtful.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Literal, NamedTuple

import numpy as np

from lfrtorch._support.arguments import typed
from lfrtorch._support.checks import integer, true_or_false
from lfrtorch._support.errors import InputError
from lfrtorch._support.tables import number, radius
from lfrtorch._support.threads import spread_by_hand
from lfrtorch._support.types import Array
from lfrtorch.data.metrics import rms
from lfrtorch.data.records import Record, Scaler, as_records, without_coordinates
from lfrtorch.linear.frf import FRF, estimate_frf
from lfrtorch.linear.integrators import (
    differenced,
    differenced_response,
    differenced_weight,
    gain,
    integrated,
    integrators_of,
    placed,
    scored,
    simulation_errors,
    whitening_pole,
    without_limits,
)
from lfrtorch.linear.minima import (
    Problem,
    best_minimum,
    candidates,
    search_from,
    transformation,
)
from lfrtorch.linear.model import LinearFit, LinearModel
from lfrtorch.linear.refinement import Refined
from lfrtorch.linear.requirements import (
    check_length,
    check_signals,
    check_spectral_data,
    excitation_notes,
    of_response,
    steady_state,
    without_inputs,
)
from lfrtorch.linear.response_fit import ResponseFit
from lfrtorch.linear.signal_fit import SignalFit
from lfrtorch.linear.spectral_data import (
    Weight,
    spectral_data_of_records,
    spectral_data_of_response,
)
from lfrtorch.linear.subspace import SubspaceEstimate
from lfrtorch.model.model import state_moment

Criterion = Literal["simulation", "prediction", "frequency"]

_NEAR, _SETTLED = 12, 1e-4  # largest number of iterations, and the decrease that ends them

FILTERS = 4
"""At most so many models of a differenced output, each but the first with its own filter."""


@typed()
@spread_by_hand()
def estimate_bla(
    data: Record | Sequence[Record] | FRF,
    nx: int,
    *,
    refine: Criterion | None = None,
    weight: Weight | Array | None = None,
    offset: bool = True,
    feedthrough: bool = True,
    integrators: int | Sequence[int] = 0,
    max_iter: int = 200,
) -> LinearModel:
    """Best linear approximation of order ``nx``: a model that minimises a squared error.

    Subspace methods estimate A and C, linear least squares B and D, and Levenberg-Marquardt refines
    the best of these models in the error of choice. Unstable poles of a subspace estimate are
    reflected into the unit circle, and the refinement rejects every step to an unstable model. Only
    a prediction error can give an unstable model, for a system in a loop, if that model predicts
    clearly better.

    - ``"simulation"``, the default for records in steady state or without a reference: simulated
      minus measured output. For periodic records in steady state it is computed from their
      spectra at the excited lines, at a fraction of the work; the steady state may begin after
      the skipped samples. A note names the band of these lines if a measured input has power at
      other lines. Given two periods or more, neither noise on the inputs nor its feedback by a
      controller causes a bias. A resonance is kept wider than the spacing of the lines, and than
      about its distance from the excited band, unless the data clearly ask for less.
    - ``"prediction"``: output predicted one sample ahead by an innovation model, more precise if
      disturbances act on the states. The gain K is part of the model. For records in steady state
      an initial state is estimated, as their noise does not repeat.
    - ``"frequency"``, the only criterion for a response, and the default for records with a
      reference that are not in steady state: error from the nonparametric response, weighted by
      its variance if wanted. ``estimate_frf`` turns records into a response.

    Args:
        data: records, or a nonparametric response. A given ``x0`` of a record is in the coordinates
            of another model, so that the initial state is estimated instead.
        nx: order.
        refine: the error. Default: see above.
        weight: weights of a response's errors: ``"total"`` or ``"noise"`` for one over that
            variance, ``"none"``, or an array. Default: none for periodic data, as that model
            simulates best; the total variance for other data, whose inputs have little power at
            some lines. With integrators: the total variance, else the noise variance, if known.
        offset: remove constants and store them as operating point.
        feedthrough: the input acts on the output at once; otherwise D is 0, as it must be
            for data under feedback, which a prediction fits without bias.
        integrators: number of exact poles at z = 1 behind each output: 1 from a speed to a
            position, 2 from a force to a position without friction. Or a list with 0 or 1 for each
            output: ``[1, 0]`` for a position and a speed. ``nx`` includes these poles. The fit is
            then to (z - 1)ⁿ G, by a simulation error filtered to be about white, and D is 0 unless
            it lowers the error by 1 %. Not for a prediction, nor for records in steady state,
            which an integrating system does not have.
        max_iter: iterations of the refinement; 0 keeps the best subspace estimate.

    Shape:
        weight: (F, ny, nu).

    Returns:
        The model in balanced coordinates, its states of unit standard deviation over the data (for
        a response: under an input of equal power at all lines), with the covariance of its
        parameters, and notes in ``fit``.
        The covariance holds for errors of any spectrum; for predictions, and for millions of
        samples, it assumes white errors.

    Raises:
        ValueError: an order below 1, a constant channel, or too few data for the order.

    Example:
        >>> bla = lfrtorch.estimate_bla(record, nx=1)
        >>> bla.poles.real.round(1)
        array([0.7])
        >>> bla.fit.criterion, bla.fit.notes
        ('simulation', ())

    References:
        Pintelon and Schoukens, System Identification, 2nd ed., Wiley 2012, chapters 4, 9 and 10.
        Ljung, System Identification, 2nd ed., Prentice Hall 1999, chapters 7 and 10.
    """
    clock = time.perf_counter()
    integer("nx", nx, 1)
    integer("max_iter", max_iter, 0)
    about = data if isinstance(data, FRF) else as_records(data)[0]
    counts = integrators_of(integrators, len(about.outputs))
    if any(counts) and refine == "prediction":
        raise InputError(
            "integrators are for refine='simulation' or 'frequency'; a prediction finds poles near "
            "1 without."
        )
    if isinstance(data, FRF):
        if refine not in (None, "frequency"):
            raise InputError(f"refine is {refine!r}, an error of records; a response has none.")
        refine = "frequency"
    else:
        data = [without_coordinates(record) for record in as_records(data)]
        check_signals(data)
        refine = refine or default_criterion(data)
    true_or_false("feedthrough", feedthrough)
    if refine != "frequency" and weight is not None:
        raise InputError("weight is for a response only: use refine='frequency'.")
    settings = Settings(refine, weight, offset, feedthrough, max_iter)
    estimate = partial(_integrating, counts=counts) if any(counts) else _stable
    model = estimate(data, nx, settings)
    fit = _fit(model)
    notes = fit.notes
    if fit.rmse > 0.7 and refine != "frequency":  # half of the power
        notes += (
            f"the model explains little: {100 * fit.rmse:.0f} % of the output's rms remain. Are "
            "columns swapped, or is there drift, a long delay, noise, an even nonlinearity?",
        )
    if not isinstance(data, FRF) and (refine != "prediction" or np.abs(model.poles).max() < 1.0):
        moment = state_moment(model.to_model(), data)
        model = replace(model, state_covariance=moment.numpy())
    return replace(model, fit=replace(fit, seconds=time.perf_counter() - clock, notes=notes))


@spread_by_hand()
def refined_near(model: LinearModel, records: Sequence[Record]) -> LinearModel:
    """Fit a model of the same order to other records by simulation error, from the given model."""
    # A refit without some of the samples needs no more. A model with exact integrators is
    # estimated anew; any other model that is not asymptotically stable is returned as it is.
    data = [without_coordinates(record) for record in records]
    offset = bool(model.y_offset.any() or model.u_offset.any())
    if model.poles.size and np.abs(model.poles).max() >= 1.0:
        integrate = _integrating_outputs(model)
        if not any(integrate):
            return model
        feedthrough = bool(model.D.any())
        return estimate_bla(
            data, model.nx, offset=offset, feedthrough=feedthrough, integrators=integrate
        )
    scaler = Scaler.of(data, offset=offset)
    problem = SignalFit(
        [scaler.normalise(record) for record in data],
        offset=offset,
        prediction=False,
        feedthrough=bool(model.D.any()),
    )
    _, matrices = problem.with_input_matrices(model.A, model.C / scaler.y_scale[:, None])
    search = search_from(problem, matrices).advance(_NEAR, _SETTLED)
    found = problem.refined(search)
    near = physical(found, scaler, data[0])
    near = near.transformed(*transformation(problem, found.matrices))
    if found.constant is not None:
        near = replace(near, y_offset=near.y_offset + scaler.y_scale * found.constant)
    fit = LinearFit("simulation", found.rmse, found.iterations, found.reason, 0.0)
    moment = state_moment(near.to_model(), data).numpy()
    return replace(near, state_covariance=moment, fit=fit)


def _integrating_outputs(model: LinearModel) -> list[int]:
    """Return the integrators behind each output, 0 or 1; zeros if another pole is not stable."""
    values, vectors = np.linalg.eig(model.A)
    exact = np.isclose(values, 1.0, rtol=0.0, atol=1e-12)
    if np.abs(values[~exact]).max(initial=0.0) >= 1.0:
        return [0] * len(model.C)
    seen = np.abs(model.C @ vectors[:, exact])
    return [int(row.any()) for row in seen > 1e-9 * np.abs(model.C).max()]


def default_criterion(records: Sequence[Record]) -> Criterion:
    """Return the criterion by which records are fitted by default."""
    return "frequency" if of_response(records) else "simulation"


class Settings(NamedTuple):
    """Settings of :func:`estimate_bla`, checked."""

    refine: Criterion
    weight: Weight | Array | None
    offset: bool
    feedthrough: bool
    max_iter: int


class _Posed(NamedTuple):
    """Least-squares problem in normalised units, and the data that it stands for."""

    problem: Problem
    scaler: Scaler
    about: FRF | Record  # rate and channels of the models
    records: list[Record]
    notes: list[str]


def pose(data: list[Record] | FRF, settings: Settings, direct: int = 0) -> _Posed:
    """Pose the problem of a criterion: on spectra where that is the same as on signals.

    The last ``direct`` inputs act on the output alone. For a response they are computed here, as
    differences of its inputs.
    """
    refine, weight, offset, feedthrough, _ = settings
    records = [] if isinstance(data, FRF) else data
    if refine == "frequency":
        response = data if isinstance(data, FRF) else estimate_frf(records)
        differences = direct // len(response.inputs)
        spectra, scaler, known, more = spectral_data_of_response(
            response, weight, offset=offset, differences=differences
        )
        about = replace(response, inputs=response.inputs * (1 + differences))
        problem = ResponseFit(spectra, known=known, feedthrough=feedthrough, direct=direct)
        notes = [*about.notes, *more]
    else:
        prediction = refine == "prediction"
        if not prediction:
            records = steady_state(records) or records
        about, notes = records[0], []
        scaler = Scaler.of(records, offset=offset)
        normalised = [scaler.normalise(record) for record in records]
        spectra = None if prediction else spectral_data_of_records(normalised, offset=offset)
        if spectra is None:
            problem = SignalFit(
                normalised,
                offset=offset,
                prediction=prediction,
                feedthrough=feedthrough,
                direct=direct,
            )
            return _Posed(problem, scaler, about, records, notes)
        problem = ResponseFit(spectra, known=False, feedthrough=feedthrough)
    if spectra.left_out:
        f = np.abs(np.angle(spectra.z)) * about.fs / (2 * np.pi)
        notes.append(
            f"the fit is to the {len(f)} lines that the input excites, {f.min():.4g} to "
            f"{f.max():.4g} Hz; {spectra.left_out} lines with noise, hum or distortion at the "
            "input are left out."
        )
    return _Posed(problem, scaler, about, records, notes)


def _stable(
    data: list[Record] | FRF,
    nx: int,
    settings: Settings,
    direct: int = 0,
    near: LinearModel | None = None,
) -> LinearModel:
    """Fit a model with all poles inside the unit circle; A and C of ``near`` are a start, too."""
    refine, weight, offset, _, max_iter = settings
    problem, scaler, about, records, notes = pose(data, settings, direct)
    if isinstance(problem, ResponseFit):
        check_spectral_data(problem.data, nx, direct)
    else:
        driving = [without_inputs(record, direct) for record in records]
        check_length(driving, nx)
        notes += excitation_notes(driving, nx)
    given = []
    if near is not None:
        values = np.array(_fit(near).singular_values)
        given = [SubspaceEstimate(near.A, near.C / scaler.y_scale[:, None], values, None)]
    tried = candidates(problem, nx, given)
    estimate, found = best_minimum(problem, tried, max_iter)
    if isinstance(problem, SignalFit):
        found = problem.unstable(found, max_iter)
    notes += _doubts(problem, estimate, found)
    weighted = isinstance(problem, ResponseFit) and problem.data.weight is not None
    if weighted and isinstance(weight, str | None) and found.rmse > 2.0:  # good fits reached 1.3
        cause = "nonlinear distortion or " if weight == "noise" else ""
        notes.append(
            f"the error is {number(found.rmse)} times its {weight or 'total'} standard deviation: "
            f"{cause}too low an order."
        )
    if max_iter and found.iterations >= max_iter:
        notes.append(
            f"the search was stopped after {max_iter} iterations: "
            f"use estimate_bla(max_iter={2 * max_iter})."
        )
    model = physical(found, scaler, about)
    if np.abs(model.poles).max() < 1.0:  # the states of an unstable model have no finite variance
        model = model.transformed(*transformation(problem, found.matrices))
    rmse = found.rmse
    if found.constant is not None:
        model = replace(model, y_offset=model.y_offset + scaler.y_scale * found.constant)
    if records and refine != "prediction":
        errors = np.concatenate([r.errors(model.simulate(r)) for r in records])
        if offset and found.constant is None:  # the fit to spectra has eliminated the constant
            model = replace(model, y_offset=model.y_offset + errors.mean(axis=0))
            errors = errors - errors.mean(axis=0)
        if refine == "simulation":
            rmse = float(rms((errors / scaler.y_scale)[scored(records)]))
    fit = LinearFit(
        refine, rmse, found.iterations, found.reason, 0.0,
        tuple(map(float, estimate.singular_values)), tuple(notes),
    )  # fmt: skip
    return replace(model, fit=fit)


def _integrating(
    data: list[Record] | FRF, nx: int, settings: Settings, counts: tuple[int, ...]
) -> LinearModel:
    """Fit the differenced output, and put the integrators behind that model."""
    about = data if isinstance(data, FRF) else data[0]
    nu, integrators, added = len(about.inputs), max(counts), sum(counts)
    integrates, refine = np.array(counts) > 0, settings.refine
    mixed = not integrates.all()
    given = [] if isinstance(data, FRF) else data
    order, records = nx - added, [without_limits(record, integrates) for record in given]
    if order < (refine == "frequency"):
        more = ", and a fit to a response takes one more" if refine == "frequency" else ""
        raise InputError(
            f"nx is {nx}, and integrators behind {int(integrates.sum())} output(s) take {added} "
            f"states{more}: raise nx."
        )
    if mixed and refine == "frequency":
        raise InputError(
            "a list of integrators is for refine='simulation'; a response has the same behind each "
            "output."
        )
    if refine != "frequency" and any(r.start == "periodic" for r in records):
        raise InputError(
            "start is 'periodic', and a system that integrates has no steady state of its own: "
            "use start='estimated'."
        )
    own, response = settings._replace(feedthrough=settings.feedthrough or not mixed), None
    if isinstance(data, FRF):
        response = differenced_response(data, integrators)
        if isinstance(own.weight, np.ndarray):
            own = own._replace(weight=differenced_weight(data, own.weight, integrators))
        elif own.weight is None:  # differences raise the noise of the highest lines
            known = [w for w in ("total", "noise") if getattr(data, f"var_{w}") is not None]
            own = own._replace(weight=known[0] if known else None)
    elif refine == "frequency":
        response = estimate_frf(differenced(records, integrators))

    def found(
        differences: int,
        own: Settings,
        pole: float = 0.0,
        near: LinearModel | None = None,
        whole: LinearModel | None = None,
    ) -> tuple[LinearModel, list[Record]]:
        if response is not None:
            return _stable(response, order, own, nu * differences, near), []
        some = integrates if mixed else None
        parts = differenced(records, integrators, differences, pole, some, whole)
        if not order:
            return gain(parts, offset=own.offset), parts
        return _stable(parts, order, own, len(parts[0].inputs) - nu, near), parts

    differences, pole, models = integrators - 1, 0.0, []
    model, parts = found(differences, own)
    if settings.feedthrough and not mixed:
        at_once, _ = found(integrators, own._replace(max_iter=0), near=model)
        # Few systems have a D, and it costs precision at high frequencies.
        if _fit(at_once).rmse < 0.99 * _fit(model).rmse:
            differences = integrators
            model, parts = found(differences, own, near=model)
    while True:
        whole = integrated(model, about, integrators, differences, integrates)
        if records:
            whole = placed(whole, records, added, integrates, offset=own.offset)
        models.append(whole)
        if refine == "frequency" or mixed or len(models) == FILTERS:
            break
        before, errors = pole, [simulation_errors(model, part) for part in parts]
        pole = whitening_pole(errors, integrators, pole)
        # An error that is almost white, or as coloured as in the last round, needs no other filter.
        if pole < 0.3 or 1.0 - pole > 0.7 * (1.0 - before):
            break
        model, parts = found(differences, own, pole, model, whole)
    model = min(models, key=lambda each: _fit(each).rmse)
    notes = tuple(f"of the differenced output: {note}" for note in _fit(model).notes)
    return replace(model, fit=replace(_fit(model), criterion=refine, notes=notes))


def _fit(model: LinearModel) -> LinearFit:
    assert model.fit is not None
    return model.fit


def _doubts(problem: Problem, estimate: SubspaceEstimate, found: Refined) -> list[str]:
    """Return notes on data and order from the subspace estimate and the poles."""
    nx, notes, s = len(found.A), [], estimate.singular_values
    carried = int((s > 1e-10).sum())
    if len(s) >= nx > carried:
        notes.append(
            f"order {nx} is above what the data carry: the subspace has {carried} direction(s) "
            f"above rounding errors; try nx={max(1, carried)}."
        )
    slowest = float(np.abs(np.linalg.eigvals(found.A)).max())
    if slowest >= 1.0:
        return [
            *notes,
            f"the system is unstable, with a pole of radius {radius(slowest)}: predictions hold, a "
            "simulation without its controller diverges.",
        ]
    if estimate.unstable is not None and found.rmse > 1e-6:  # a perfect fit is stable
        cost, _ = problem.with_input_matrices(estimate.unstable, estimate.C)
        stable, _ = problem.with_input_matrices(found.A, found.C)
        if cost < 0.25 * stable:
            outside = float(np.abs(np.linalg.eigvals(estimate.unstable)).max())
            return [
                *notes,
                f"the data come from an unstable system: a pole of radius {radius(outside)} "
                "explains them much better than any stable model. Look for drift or feedback.",
            ]
    if slowest > 1.0 - 1e-5 and found.K is None:
        notes.append(
            f"a pole lies at the limit of stability, radius {radius(slowest)}: the data drift, "
            "integrate, or come from an unstable plant in a loop;\nfor such a plant give "
            "refine='prediction' (noise='innovation')."
        )
    elif slowest > 1.0 - 1e-4:
        notes.append(
            f"the slowest pole has radius {radius(slowest)}: the data drift or integrate, or nx is "
            "above the order that they carry; look at the data, or lower nx."
        )
    return notes


def physical(found: Refined, scaler: Scaler, about: FRF | Record) -> LinearModel:
    """Return the model in physical units, with its covariance."""
    nx = len(found.A)
    by_u, by_y = 1.0 / scaler.u_scale, scaler.y_scale[:, None]
    sizes = [np.ones((nx, nx)), np.tile(by_u, (nx, 1)), np.tile(by_y, (1, nx)), by_y * by_u]
    size = np.concatenate([part.ravel() for part in sizes])
    S = found.innovation_covariance
    return LinearModel(
        *(part * matrix for part, matrix in zip(sizes, found.matrices, strict=True)),
        fs=about.fs,
        u_offset=scaler.u_offset,
        y_offset=scaler.y_offset,
        inputs=about.inputs,
        outputs=about.outputs,
        K=None if found.K is None else found.K / scaler.y_scale,
        innovation_covariance=None if S is None else by_y * S * scaler.y_scale,
        covariance=None if found.covariance is None else size[:, None] * found.covariance * size,
    )
