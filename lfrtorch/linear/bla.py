"""Parametric best linear approximation (BLA): a linear state-space model of an order.

Records or a response become a least-squares problem in normalised units, whose best minimum
``minima`` finds. The result is put into balanced coordinates and physical units, with its
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
from lfrtorch.linear.frf import FRF, estimate_frf
from lfrtorch.linear.integrators import (
    differenced,
    differenced_response,
    differenced_weight,
    gain,
    integrated,
    placed,
    simulation_errors,
    whitening_pole,
)
from lfrtorch.linear.minima import Problem, best_minimum, candidates, transformation
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
    SpectralData,
    Weight,
    spectral_data_of_records,
    spectral_data_of_response,
)
from lfrtorch.linear.subspace import SubspaceEstimate
from lfrtorch.metrics import rms
from lfrtorch.model import state_moment
from lfrtorch.records import Record, Scaler, as_records, without_coordinates
from lfrtorch.survey.integration import integrators as count_integrators

Criterion = Literal["simulation", "prediction", "frequency"]

EMPTY = 1e-10
"""Relative singular values below this are rounding errors: the data do not carry the order."""

AT_THE_LIMIT = 1.0 - 1e-4
"""Radius of a pole above which the data may drift or come from an unstable system."""

ROUNDING = 1e-6
"""A fit with a relative error below this is perfect."""

POOR = 0.7
"""A model with an error above this part of the output's rms explains little: half its power."""

AT_ONCE = 0.99
"""D of a system that integrates is a parameter if that brings the error below this part of what it
is without: few have one, and it costs precision at high frequencies."""

COLOURED, CLOSER, ROUNDS = 0.3, 0.7, 4
"""A differenced output is fitted without a filter if its pole λ is below COLOURED. Others are fit
again, ROUNDS times at most, while 1 - λ of the errors is below the part CLOSER of the last one."""

FAR = 2.0
"""A normalised residual above this is not explained by the variances: that of good fits to 50 lines
or more was 1.3 at most."""

BETTER = 0.25
"""The data come from an unstable system if its cost is below this part of a stable model's."""


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
    integrators: Literal[0, 1, 2] = 0,
    max_iter: int = 200,
) -> LinearModel:
    """Best linear approximation of order ``nx``: a stable model that minimises a squared error.

    Subspace methods estimate A and C, linear least squares B and D, and Levenberg-Marquardt refines
    the best of these models in the error of choice. Unstable poles of a subspace estimate are
    reflected into the unit circle, and the refinement rejects every step to an unstable model.

    - ``"simulation"``, the default for records in steady state or without a reference: simulated
      minus measured output. For periodic records in steady state, also if that begins after the
      skipped samples, it is computed from their spectra at the excited lines, at a fraction of the
      work. A note names their band if a measured input has power elsewhere. Noise of the inputs,
      which two periods tell, and what a controller feeds back to them leave no bias there. Poles
      are kept from being narrower than the lines are apart, and than their distance from the band,
      unless the data clearly ask for that.
    - ``"prediction"``: output predicted one sample ahead by an innovation model, more precise if
      disturbances act on the states. The gain K is part of the model. For records in steady state
      an initial state is estimated, as their noise does not repeat.
    - ``"frequency"``, the default for a response and its only one, and that for other records with
      a reference: the nonparametric response, weighted by its variance if wanted. ``estimate_frf``
      turns records into a response.

    Args:
        data: records, or a nonparametric response. A given ``x0`` of a record is in the coordinates
            of another model, so that the initial state is estimated instead.
        nx: order.
        refine: the error. Default: see above.
        weight: of the errors of a response: one over its ``"total"`` or ``"noise"`` variance,
            ``"none"``, or own weights. Default: none for periodic data, as that model simulates
            best; the total variance for others, whose input has lines of little power; with
            integrators the total or the noise variance if one is known.
        offset: whether constants are removed and stored as operating point.
        feedthrough: whether the input acts on the output at once; otherwise D is 0, as it must be
            for data under feedback, which a prediction fits without bias.
        integrators: poles at z = 1 behind each output, exactly: 1 from a speed to a position, 2
            from a force without friction. ``nx`` counts them. Then (z - 1)ⁿ G is fitted, in a
            simulation error that is filtered so that it is about white, and D is 0 unless it lowers
            the error by 1 %. Not for a prediction, and not for records in steady state: the system
            has none of its own.
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
    if integrators and refine == "prediction":
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
        refine = refine or ("frequency" if of_response(data) else "simulation")
    true_or_false("feedthrough", feedthrough)
    if refine != "frequency" and weight is not None:
        raise InputError("weight is that of a response: use refine='frequency'.")
    settings = _Settings(refine, weight, offset, feedthrough, max_iter)
    estimate = partial(_integrating, integrators=integrators) if integrators else _stable
    model = estimate(data, nx, settings)
    fit = _fit(model)
    notes = fit.notes
    if not integrators and not isinstance(data, FRF):
        notes += _integrator_notes(data)
    if fit.rmse > POOR and refine != "frequency":
        notes += (
            f"the model explains little: {100 * fit.rmse:.0f} % of the output's rms remain. Are "
            "columns swapped, or is there drift, a long delay, noise, an even nonlinearity?",
        )
    if not isinstance(data, FRF):
        moment = state_moment(model.to_model(), data)
        model = replace(model, state_covariance=moment.numpy())
    return replace(model, fit=replace(fit, seconds=time.perf_counter() - clock, notes=notes))


def _integrator_notes(records: list[Record]) -> tuple[str, ...]:
    """What to do about outputs that integrate, by the longest record."""
    longest = max(records, key=lambda record: record.samples)
    u, y = longest.u[longest.skip :], longest.y[longest.skip :]
    counts = [count_integrators(u, y[:, i]) for i in range(y.shape[1])]
    if not any(counts):
        return ()
    names = ", ".join(f"'{c.name}'" for c, n in zip(longest.outputs, counts, strict=True) if n)
    return (f"output {names} integrates: use integrators={max(counts)} for exact poles at z = 1.",)


class _Settings(NamedTuple):
    """The settings of :func:`estimate_bla`, checked."""

    refine: Criterion
    weight: Weight | Array | None
    offset: bool
    feedthrough: bool
    max_iter: int


def _stable(
    data: list[Record] | FRF,
    nx: int,
    settings: _Settings,
    direct: int = 0,
    near: LinearModel | None = None,
) -> LinearModel:
    """The model with all poles inside the unit circle.

    Args:
        data: records or a response.
        nx: order.
        settings: checked.
        direct: how many inputs act on the output alone: the last of the records, or differences of
            the inputs of a response, which it need not have.
        near: a model whose A and C the search starts from, too.
    """
    refine, weight, offset, feedthrough, max_iter = settings
    records = [] if isinstance(data, FRF) else data
    notes: list[str] = []
    about: FRF | Record
    if refine == "frequency":
        about = data if isinstance(data, FRF) else estimate_frf(records)
        differences = direct // len(about.inputs)
        spectra, scaler, known, more = spectral_data_of_response(
            about, weight, offset=offset, differences=differences
        )
        about = replace(about, inputs=about.inputs * (1 + differences))
        problem = ResponseFit(spectra, known=known, feedthrough=feedthrough, direct=direct)
        notes += [*about.notes, *more]
    else:
        if refine == "simulation":
            records = steady_state(records) or records
        about = records[0]
        scaler = Scaler.of(records, offset=offset)
        problem = _of_records(
            records,
            scaler,
            offset=offset,
            prediction=refine == "prediction",
            feedthrough=feedthrough,
            direct=direct,
        )
    if isinstance(problem, ResponseFit):
        check_spectral_data(problem.data, nx, direct)
        notes += _band_notes(problem.data, about.fs)
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
    notes += _notes(problem, estimate, found)
    if isinstance(problem, ResponseFit) and problem.data.weight is not None:
        notes += _residual_notes(found.rmse, weight)
    if max_iter and found.iterations >= max_iter:
        notes.append(
            f"the search was stopped after {max_iter} iterations: "
            f"use estimate_bla(max_iter={2 * max_iter})."
        )
    model = physical(found, scaler, about)
    model = model.transformed(*transformation(problem, found.matrices))
    rmse = found.rmse
    if found.constant is not None:
        model = replace(model, y_offset=model.y_offset + scaler.y_scale * found.constant)
    if records and refine != "prediction":
        errors = np.concatenate([(r.y - model.simulate(r))[r.skip :] for r in records])
        if offset and found.constant is None:  # the fit to spectra has eliminated it
            model = replace(model, y_offset=model.y_offset + errors.mean(axis=0))
            errors = errors - errors.mean(axis=0)
        if refine == "simulation":
            rmse = float(rms(errors / scaler.y_scale))
    return replace(
        model,
        fit=LinearFit(
            criterion=refine,
            rmse=rmse,
            iterations=found.iterations,
            reason=found.reason,
            seconds=0.0,
            singular_values=tuple(map(float, estimate.singular_values)),
            notes=tuple(notes),
        ),
    )


def _integrating(
    data: list[Record] | FRF, nx: int, settings: _Settings, integrators: int
) -> LinearModel:
    """The model of the differenced output, with the integrators behind it."""
    about = data if isinstance(data, FRF) else data[0]
    nu, ny = len(about.inputs), len(about.outputs)
    added, refine = integrators * ny, settings.refine
    order, records = nx - added, [] if isinstance(data, FRF) else data
    if order < (refine == "frequency"):
        more = ", and a fit to a response takes one more" if refine == "frequency" else ""
        raise InputError(
            f"nx is {nx}, and {integrators} integrator(s) behind each of {ny} output(s) take "
            f"{added} states{more}: raise nx."
        )
    if refine != "frequency" and any(r.start == "periodic" for r in records):
        raise InputError(
            "start is 'periodic', and a system that integrates has no steady state of its own: "
            "use start='estimated'."
        )
    own, response = settings._replace(feedthrough=True), None
    if isinstance(data, FRF):
        response = differenced_response(data, integrators)
        if isinstance(own.weight, np.ndarray):
            own = own._replace(weight=differenced_weight(data, own.weight, integrators))
        elif own.weight is None:  # differences raise the noise of the highest lines
            known = [w for w in ("total", "noise") if getattr(data, f"var_{w}") is not None]
            own = own._replace(weight=known[0] if known else None)
    elif refine == "frequency":
        response = estimate_frf(differenced(data, integrators))

    def found(
        differences: int, own: _Settings, pole: float = 0.0, near: LinearModel | None = None
    ) -> tuple[LinearModel, list[Record]]:
        if response is not None:
            return _stable(response, order, own, nu * differences, near), []
        parts = differenced(records, integrators, differences, pole)
        if not order:
            return gain(parts, offset=own.offset), parts
        return _stable(parts, order, own, len(parts[0].inputs) - nu, near), parts

    differences, pole, models = integrators - 1, 0.0, []
    model, parts = found(differences, own)
    if settings.feedthrough:
        at_once, _ = found(integrators, own._replace(max_iter=0), near=model)
        if _fit(at_once).rmse < AT_ONCE * _fit(model).rmse:
            differences = integrators
            model, parts = found(differences, own, near=model)
    while True:
        whole = integrated(model, about, integrators, differences)
        models.append(placed(whole, records, added, offset=own.offset) if records else whole)
        if refine == "frequency" or len(models) == ROUNDS:
            break
        before, errors = pole, [simulation_errors(model, part) for part in parts]
        pole = whitening_pole(errors, integrators, pole)
        if pole < COLOURED or 1.0 - pole > CLOSER * (1.0 - before):
            break
        model, parts = found(differences, own, pole, model)
    model = min(models, key=lambda each: _fit(each).rmse)
    notes = tuple(f"of the differenced output: {note}" for note in _fit(model).notes)
    return replace(model, fit=replace(_fit(model), criterion=refine, notes=notes))


def _fit(model: LinearModel) -> LinearFit:
    assert model.fit is not None
    return model.fit


def _of_records(
    records: list[Record],
    scaler: Scaler,
    *,
    offset: bool,
    prediction: bool,
    feedthrough: bool,
    direct: int,
) -> Problem:
    """The fit to the spectra of the records if that is the same, else to their signals."""
    normalised = [scaler.normalise(record) for record in records]
    if not prediction:
        spectra = spectral_data_of_records(normalised, offset=offset)
        if spectra is not None:
            return ResponseFit(spectra, known=False, feedthrough=feedthrough)
    return SignalFit(
        normalised, offset=offset, prediction=prediction, feedthrough=feedthrough, direct=direct
    )


def _band_notes(data: SpectralData, fs: float) -> list[str]:
    """What lines are fitted if not all at which the input has some power."""
    if not data.left_out:
        return []
    f = np.abs(np.angle(data.z)) * fs / (2 * np.pi)
    return [
        f"the fit is to the {len(f)} lines that the input excites, {f.min():.4g} to {f.max():.4g} "
        f"Hz; {data.left_out} lines with noise, hum or distortion at the input are left out."
    ]


def _notes(problem: Problem, estimate: SubspaceEstimate, found: Refined) -> list[str]:
    """What the subspace and the poles say of data and order."""
    nx, notes, s = len(found.A), [], estimate.singular_values
    if len(s) >= nx and s[nx - 1] < EMPTY:
        carried = int((s > EMPTY).sum())
        notes.append(
            f"order {nx} is above what the data carry: the subspace has {carried} direction(s) "
            f"above rounding errors; try nx={max(1, carried)}."
        )
    if estimate.unstable is not None and found.rmse > ROUNDING:
        cost, _ = problem.with_input_matrices(estimate.unstable, estimate.C)
        stable, _ = problem.with_input_matrices(found.A, found.C)
        if cost < BETTER * stable:
            slowest = float(np.abs(np.linalg.eigvals(estimate.unstable)).max())
            return [
                *notes,
                f"the data come from an unstable system: a pole of radius {radius(slowest)} "
                "explains them much better than any stable model. Look for drift or feedback.",
            ]
    slowest = float(np.abs(np.linalg.eigvals(found.A)).max())
    if slowest > AT_THE_LIMIT:
        notes.append(
            f"the slowest pole has radius {radius(slowest)}: data that drift or integrate ask for "
            "one, or an order above what they carry; look at the data, or lower nx."
        )
    return notes


def _residual_notes(rmse: float, weight: Weight | Array | None) -> list[str]:
    """What a residual says that is far above what the variances explain."""
    if rmse <= FAR or not isinstance(weight, str | None):
        return []
    cause = "nonlinear distortion or too low an order" if weight == "noise" else "too low an order"
    return [f"the error is {number(rmse)} times its {weight or 'total'} deviation: {cause}."]


def physical(found: Refined, scaler: Scaler, about: FRF | Record) -> LinearModel:
    """The model in physical units, with its covariance."""
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
