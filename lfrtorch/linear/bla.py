"""Parametric best linear approximation: subspace start, refined in one of three errors."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, Protocol, get_args

import numpy as np

from lfrtorch._checks import integer
from lfrtorch._threads import spread_by_hand
from lfrtorch._types import Array
from lfrtorch.linear.frf import FRF, estimate_frf
from lfrtorch.linear.model import LinearFit, LinearModel, balancing
from lfrtorch.linear.refinement import Matrices, Refined, Search
from lfrtorch.linear.requirements import check_length, check_lines, check_signals, narrow
from lfrtorch.linear.response_fit import ResponseFit
from lfrtorch.linear.signal_fit import SignalFit
from lfrtorch.linear.spectral_data import Weight, lines_of, lines_of_response
from lfrtorch.linear.subspace import Start
from lfrtorch.metrics import rms
from lfrtorch.records import Record, Scaler, as_records, rms_scale, without_coordinates

Criterion = Literal["simulation", "prediction", "frequency"]

FIRST_STEPS, FINALISTS = 8, 6
"""Iterations after which the starts are compared, and how many of them go on."""

SAME, AGREED = 1.0 + 2e-6, 3
"""Ratio of the costs of two searches up to which they are in the same minimum, and how many of
them in a row end the race."""

ALIKE, HOPELESS = 1.001, 10.0
"""Starts whose costs differ by a smaller factor count as one; by a larger one, as not worth it."""

EMPTY = 1e-10
"""Relative singular value of an order that the data do not carry: rounding errors."""

AT_THE_LIMIT = 1.0 - 1e-4
"""Pole radius above which a model looks like one of unstable data."""

ROUNDING = 1e-6
"""Relative error below which a fit is perfect."""

POOR = 0.7
"""Error relative to the output above which a model explains little: less than half its power."""

BETTER = 0.25
"""Part of the stable models' cost below which the data are those of an unstable one."""


class LinearLeastSquares(Protocol):
    """Least squares between data and a linear model, in normalised units."""

    def contenders(self, nx: int) -> int:
        """Starts that are worth a refinement: several where an iteration takes milliseconds."""
        ...

    def starts(self, nx: int) -> list[Start]:
        """Subspace estimates of A and C."""
        ...

    def with_input_matrices(self, A: Array, C: Array) -> tuple[float, Matrices]:
        """Cost and system with the best B and D for A and C."""
        ...

    def state_deviation(self, matrices: Matrices) -> Array:
        """Standard deviation (nx,) of the states over the data."""
        ...

    def search(self, matrices: Matrices) -> Search:
        """A search for the minimum near the given system."""
        ...

    def improbability(self, search: Search) -> float:
        """Where a search stands: its cost, and that of start states that no input leads to."""
        ...

    def refined(self, search: Search) -> Refined:
        """What a search has found."""
        ...


@spread_by_hand()
def estimate_bla(
    data: Record | Sequence[Record] | FRF,
    nx: int,
    *,
    refine: Criterion | None = None,
    weight: Weight | Array | None = None,
    offset: bool = True,
    feedthrough: bool = True,
    coordinates: Literal["balanced", "given"] = "balanced",
    max_iter: int = 200,
) -> LinearModel:
    """Best linear approximation of order ``nx``, stable, by least squares.

    Subspace estimates give A and C, a linear least-squares fit B and D; the best of them is refined
    by Levenberg-Marquardt in the error of choice. Unstable poles of a start are reflected into the
    unit circle, and the refinement rejects every step that brings one out.

    - ``"simulation"``, the usual one of records: simulated minus measured output. Periodic records
      in steady state are fitted line by line of their spectra, the same sum of squares at a
      fraction of the work.
    - ``"prediction"``: output predicted one sample ahead by an innovation model: more precise where
      disturbances act on the states. The gain K is part of the model. Records in steady state get
      an estimated start state, as their noise does not repeat.
    - ``"frequency"``, the only one of a response: the nonparametric response, weighted by its
      variance. Records are turned into a response by ``estimate_frf``.

    Args:
        data: records, or a nonparametric response. Start states that are given (in another model's
            coordinates) are estimated.
        nx: order.
        refine: the error.
        weight: of the errors of a response: one over its ``"total"`` or ``"noise"`` variance,
            ``"none"``, or weights of one's own. Where left out the total variance, or the noise's
            where that is all there is, or none.
        offset: whether constants are removed and stored as operating point.
        feedthrough: whether the input acts on the output at once; D is 0 otherwise, as it must be
            for data under feedback, which a prediction fits without bias.
        coordinates: ``"balanced"`` states, or ``"given"`` by the subspace estimate.
        max_iter: iterations of the refinement; 0 leaves the start.

    Shape:
        weight: (F, ny, nu).

    Returns:
        The model, with states of unit standard deviation over the data (of a response: under an
        input of equal power in all lines), the covariance of its parameters, and notes in ``fit``.
        The covariance holds for errors of any spectrum, and for white ones where signals are
        predicted or where there are millions of them.

    Raises:
        ValueError: an order below 1, a constant channel, or data that do not reach for the order.

    References:
        Pintelon and Schoukens, System Identification, 2nd ed., Wiley 2012, chapters 4, 9 and 10.
        Ljung, System Identification, 2nd ed., Prentice Hall 1999, chapters 7 and 10.
    """
    clock = time.perf_counter()
    integer("nx", nx, 1)
    integer("max_iter", max_iter, 0)
    if coordinates not in ("balanced", "given"):
        raise ValueError(f"coordinates is {coordinates!r}; use 'balanced' or 'given'.")
    if refine not in (None, *get_args(Criterion)):
        raise ValueError(f"refine is {refine!r}; use 'simulation', 'prediction' or 'frequency'.")
    records = [] if isinstance(data, FRF) else [without_coordinates(r) for r in as_records(data)]
    notes: list[str] = []
    if records:
        check_signals(records)
    about: FRF | Record
    if isinstance(data, FRF) or refine == "frequency":
        if refine not in (None, "frequency"):
            raise ValueError(f"refine is {refine!r}, an error of records; a response has none.")
        refine = "frequency"
        about = data if isinstance(data, FRF) else estimate_frf(records)
        lines, scaler, known, more = lines_of_response(about, weight, offset=offset)
        problem = ResponseFit(lines, known=known, feedthrough=feedthrough)
        notes += [*about.notes, *more]
    else:
        if weight is not None:
            raise ValueError("weight is that of a response: use refine='frequency'.")
        refine, about = refine or "simulation", records[0]
        scaler = data_scaler(records, offset=offset)
        problem = _of_records(
            records,
            scaler,
            offset=offset,
            prediction=refine == "prediction",
            feedthrough=feedthrough,
        )
    if isinstance(problem, ResponseFit):
        check_lines(problem.lines, nx)
    else:
        check_length(records, nx)
        notes += narrow(records, nx)

    balanced = coordinates == "balanced"
    start, found = _best(problem, _starts(problem, nx), max_iter, balanced=balanced)
    notes += _findings(problem, start, found)
    if max_iter and found.iterations >= max_iter:
        notes.append(f"the search was stopped after {max_iter} iterations: raise max_iter.")
    model = _physical(found, scaler, about)
    model = model.transformed(*_transformation(problem, found.matrices, balanced=balanced))
    rmse = found.rmse
    if found.constant is not None:
        model = replace(model, y_offset=model.y_offset + scaler.y_scale * found.constant)
    elif records:
        errors = np.concatenate([(r.y - model.simulate(r))[r.skip :] for r in records])
        if offset:  # the constant that lines leave out
            model = replace(model, y_offset=model.y_offset + errors.mean(axis=0))
            errors = errors - errors.mean(axis=0)
        if refine == "simulation":
            rmse = float(rms(errors / scaler.y_scale))
    if rmse > POOR and refine != "frequency":
        notes.append(
            f"the model explains little: {100 * rmse:.0f} % of the output's rms remain. Look "
            "at the columns (are input and output swapped?), for drift (try offset=False where "
            "the system integrates), a long delay, strong noise or an even nonlinearity."
        )
    return replace(
        model,
        fit=LinearFit(
            criterion=refine,
            rmse=rmse,
            iterations=found.iterations,
            reason=found.reason,
            seconds=time.perf_counter() - clock,
            singular_values=tuple(map(float, start.singular_values)),
            notes=tuple(notes),
        ),
    )


def data_scaler(records: list[Record], *, offset: bool) -> Scaler:
    """Means (or zeros) of the records' signals, and their rms about them."""
    us, ys = [r.u for r in records], [r.y for r in records]

    def centre(signals: list[Array]) -> Array:
        mean = np.concatenate(signals).mean(axis=0)
        return mean if offset else np.zeros_like(mean)

    u_offset, y_offset = centre(us), centre(ys)
    return Scaler(u_offset, rms_scale(us, u_offset), y_offset, rms_scale(ys, y_offset))


def _of_records(
    records: list[Record], scaler: Scaler, *, offset: bool, prediction: bool, feedthrough: bool
) -> ResponseFit | SignalFit:
    """By their lines, where that is the same, or by their signals."""
    us = [scaler.normalise_u(r.u) for r in records]
    ys = [scaler.normalise_y(r.y) for r in records]
    if not prediction:
        lines = lines_of(us, ys, records, offset=offset)
        if lines is not None:
            return ResponseFit(lines, known=False, feedthrough=feedthrough)
    return SignalFit(us, ys, records, offset=offset, prediction=prediction, feedthrough=feedthrough)


def _starts(problem: LinearLeastSquares, nx: int) -> list[tuple[float, Start, Matrices]]:
    """Cost, A and C, and the system with the best B and D of each subspace estimate, best first."""
    found = []
    for start in problem.starts(nx):
        cost, matrices = problem.with_input_matrices(start.A, start.C)
        if np.isfinite(cost):
            found.append((cost, start, matrices))
    if not found:
        raise ValueError(
            f"no stable linear model of order {nx} could be started from these data; "
            "try a lower nx or a longer record."
        )
    return sorted(found, key=lambda each: each[0])


def _best(
    problem: LinearLeastSquares,
    starts: list[tuple[float, Start, Matrices]],
    max_iter: int,
    *,
    balanced: bool,
) -> tuple[Start, Refined]:
    """The best of the minima that the starts lead to: after a few steps the best few go on.

    The start that fits best may lead to a poor minimum: at the highest level of the parallel
    Wiener-Hammerstein system to one whose error on the data fitted is 4 % above the best one's.

    Where start states are estimated, the most probable minimum is taken. The one of least cost may
    spend a mode on drift: a pole of 0.999996 that the input hardly moves, from 500 times its
    deviation, on seven eighths of the cascaded tanks' record.
    """

    field, last = [], 0.0
    for cost, start, matrices in starts[: problem.contenders(len(starts[0][1].A))]:
        if cost > ALIKE * last and (not field or cost < HOPELESS * starts[0][0]):
            field.append((start, matrices))
            last = cost
    searches: list[tuple[Start, Search]] = []
    for start, matrices in field if max_iter > FIRST_STEPS else field[:1]:
        try:
            search = problem.search(_scaled(problem, matrices, balanced=balanced))
        except ValueError:  # states that the data hardly move: their scaling is all rounding
            search = problem.search(matrices)
        searches.append((start, search.advance(min(FIRST_STEPS, max_iter))))
        costs = [search.state.cost for _, search in searches]
        if len(costs) >= AGREED and max(costs[-AGREED:]) <= SAME * min(costs):
            break  # so many in a row went to the best minimum so far: the others would
    searches.sort(key=lambda each: each[1].state.cost)
    costs = [0.0, *(search.state.cost for _, search in searches)]
    distinct = [
        each
        for each, last in zip(searches, costs, strict=False)
        if each[1].state.cost > SAME * last
    ]
    finalists = (distinct or searches)[:FINALISTS]
    for _, search in finalists:
        search.advance(max_iter)
    start, search = min(finalists, key=lambda each: problem.improbability(each[1]))
    return start, problem.refined(search)


def _findings(problem: LinearLeastSquares, start: Start, found: Refined) -> list[str]:
    """What the subspace and the poles say of data and order."""
    nx, notes, s = len(found.A), [], start.singular_values
    if len(s) >= nx and s[nx - 1] < EMPTY:
        carried = int((s > EMPTY).sum())
        notes.append(
            f"order {nx} is above what the data carry: the subspace has {carried} direction(s) "
            f"above rounding errors; try nx={max(1, carried)}."
        )
    if start.unstable is not None and found.rmse > ROUNDING:
        cost, _ = problem.with_input_matrices(start.unstable, start.C)
        stable, _ = problem.with_input_matrices(found.A, found.C)
        if cost < BETTER * stable:
            radius = float(np.abs(np.linalg.eigvals(start.unstable)).max())
            return [
                *notes,
                f"the data come from an unstable system: a pole of radius {radius:.4g} explains "
                "them much better than any stable model. Look for drift, or for feedback around "
                "the system.",
            ]
    radius = float(np.abs(np.linalg.eigvals(found.A)).max())
    if radius > AT_THE_LIMIT:
        notes.append(
            f"the slowest pole has radius {radius:.6f}: data that drift or integrate ask for one, "
            "and so does an order above what they carry; look at the data, or lower nx."
        )
    return notes


def _physical(found: Refined, scaler: Scaler, about: FRF | Record) -> LinearModel:
    """The model in physical units, with all that is known of its uncertainty."""
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


def _scaled(problem: LinearLeastSquares, matrices: Matrices, *, balanced: bool) -> Matrices:
    """The system in balanced coordinates with states of unit deviation."""
    A, B, C, D = matrices
    T, inverse = _transformation(problem, matrices, balanced=balanced)
    return T @ A @ inverse, T @ B, C @ inverse, D


def _transformation(
    problem: LinearLeastSquares, matrices: Matrices, *, balanced: bool
) -> tuple[Array, Array]:
    """T and T⁻¹ (nx, nx) to balanced coordinates, or from the given ones, of unit deviation."""
    A, B, C, D = matrices
    T = inverse = np.eye(len(A))
    if balanced:
        T, inverse = balancing(A, B, C)
    std = problem.state_deviation((T @ A @ inverse, T @ B, C @ inverse, D))
    std = np.where(std > 0, std, 1.0)
    return T / std[:, None], inverse * std
