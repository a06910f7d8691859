"""Parametric best linear approximation: subspace start, refined in one of three errors."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, Protocol, get_args

import numpy as np
from numpy.typing import NDArray

from lfrtorch.checks import integer
from lfrtorch.frf import FRF, estimate_frf
from lfrtorch.linear_model import LinearFit, LinearModel, balancing
from lfrtorch.linear_search import Matrices, Refined
from lfrtorch.records import Record, Scaler, as_records, rms_scale, without_coordinates
from lfrtorch.response_error import Lines, ResponseFit, lines_of
from lfrtorch.signal_error import SignalFit
from lfrtorch.subspace import Start, shortest
from lfrtorch.threads import spread_by_hand

Array = NDArray[np.float64]
Criterion = Literal["simulation", "prediction", "frequency"]
Weight = Literal["total", "noise", "none"]

EMPTY = 1e-10
"""Relative singular value of an order that the data do not carry: rounding errors."""

AT_THE_LIMIT = 1.0 - 1e-4
"""Pole radius above which a model looks like one of unstable data."""

DEGREES_OF_FREEDOM = 20
"""Of a variance that is used as a weight."""

VANISHING = 1e-12
"""Smallest variance of a line, relative to the largest, that counts as a weight."""

NARROW = 1e-10
"""Relative size of a direction that the input does not excite."""


class LinearLeastSquares(Protocol):
    """Least squares between data and a linear model, in normalised units."""

    def starts(self, nx: int) -> list[Start]:
        """Subspace estimates of A and C."""
        ...

    def with_input_matrices(self, A: Array, C: Array) -> tuple[float, Matrices]:
        """Cost and system with the best B and D for A and C."""
        ...

    def state_deviation(self, matrices: Matrices) -> Array:
        """Standard deviation (nx,) of the states over the data."""
        ...

    def refined(self, matrices: Matrices, max_iter: int) -> Refined:
        """The minimum near the given system."""
        ...


@spread_by_hand()
def estimate_bla(
    data: Record | Sequence[Record] | FRF,
    nx: int,
    *,
    refine: Criterion | None = None,
    weight: Weight | Array | None = None,
    offset: bool = True,
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
        coordinates: ``"balanced"`` states, or ``"given"`` by the subspace estimate.
        max_iter: iterations of the refinement; 0 leaves the start.

    Shape:
        weight: (F, ny, nu).

    Returns:
        The model, with states of unit standard deviation over the data (of a response: under an
        input of equal power in all lines), the covariance of its parameters, and notes in ``fit``.
        The covariance holds for errors of any spectrum where lines are fitted, and for white ones
        where signals are.

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
        _check_signals(records)
    about: FRF | Record
    if isinstance(data, FRF) or refine == "frequency":
        if refine not in (None, "frequency"):
            raise ValueError(f"refine is {refine!r}, an error of records; a response has none.")
        refine = "frequency"
        about = data if isinstance(data, FRF) else estimate_frf(records)
        notes += about.notes
        problem, scaler = _of_response(about, weight, notes, offset=offset)
    else:
        if weight is not None:
            raise ValueError("weight is that of a response: use refine='frequency'.")
        refine, about = refine or "simulation", records[0]
        scaler = data_scaler(records, offset=offset)
        problem = _of_records(records, scaler, offset=offset, prediction=refine == "prediction")
    if isinstance(problem, ResponseFit):
        _check_lines(problem.lines, nx)
    else:
        _check_length(records, nx)
        notes += _narrow(records, nx)

    start, matrices = _best_start(problem, nx)
    balanced = coordinates == "balanced"
    found = problem.refined(_scaled(problem, matrices, balanced=balanced), max_iter)
    notes += _findings(start, found.A)
    if max_iter and found.iterations >= max_iter:
        notes.append(f"the search was stopped after {max_iter} iterations: raise max_iter.")
    model = _physical(found, scaler, about)
    model = model.transformed(*_transformation(problem, found.matrices, balanced=balanced))
    rmse = found.rmse
    if records and refine != "frequency":
        errors = [(r.y - model.simulate(r))[r.skip :] for r in records]
        constant = np.concatenate(errors).mean(axis=0)  # that the fit took off
        if offset:
            model = replace(model, y_offset=model.y_offset + constant)
            errors = [e - constant for e in errors]
        if refine == "simulation":
            rmse = float(np.sqrt(np.mean((np.concatenate(errors) / scaler.y_scale) ** 2)))
    return replace(
        model,
        fit=LinearFit(
            criterion=refine,
            rmse=rmse,
            iterations=found.iterations,
            reason=found.reason,
            seconds=time.perf_counter() - clock,
            singular_values=tuple(map(float, start.singular_values / start.singular_values[0])),
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
    records: list[Record], scaler: Scaler, *, offset: bool, prediction: bool
) -> ResponseFit | SignalFit:
    """By their lines, where that is the same, or by their signals."""
    us = [scaler.normalise_u(r.u) for r in records]
    ys = [scaler.normalise_y(r.y) for r in records]
    if not prediction:
        lines = lines_of(us, ys, records, offset=offset)
        if lines is not None:
            return ResponseFit(lines, known=False)
    return SignalFit(us, ys, records, offset=offset, prediction=prediction)


def _of_response(
    frf: FRF, weight: Weight | Array | None, notes: list[str], *, offset: bool
) -> tuple[ResponseFit, Scaler]:
    """A response with channels of unit size, by its weights."""
    weights, known = _weights(frf, weight, notes)
    u_scale = 1.0 / rms_scale([np.abs(frf.G).reshape(-1, frf.G.shape[2])], np.zeros(1))
    G = frf.G * u_scale
    y_scale = rms_scale([np.abs(G).swapaxes(1, 2).reshape(-1, G.shape[1])], np.zeros(1))
    size = y_scale[:, None] / u_scale
    nu, ny = len(u_scale), len(y_scale)
    offsets = (frf.u_offset, frf.y_offset) if offset else (np.zeros(nu), np.zeros(ny))
    scaler = Scaler(offsets[0], u_scale, offsets[1], y_scale)
    z = np.exp(2j * np.pi * frf.frequencies / frf.fs)
    U = np.broadcast_to(np.eye(nu, dtype=complex), (len(z), nu, nu))
    lines = Lines(z, U, frf.G / size, None if weights is None else weights * size**2)
    return ResponseFit(lines, known=known), scaler


def _weights(
    frf: FRF, weight: Weight | Array | None, notes: list[str]
) -> tuple[Array | None, bool]:
    """Weights (F, ny, nu) of the errors of G, and whether they are inverse variances."""
    if isinstance(weight, np.ndarray):
        if weight.shape != frf.G.shape or not (np.isfinite(weight).all() and (weight >= 0).all()):
            raise ValueError(
                f"weight has shape {weight.shape}; give finite numbers of at least 0 in the shape "
                f"of the response, {frf.G.shape}."
            )
        return weight.astype(np.float64), False
    variances = {"total": frf.var_total, "noise": frf.var_noise}
    if weight is None:
        if frf.var_total is not None:
            weight = "total"
        else:
            weight = "none" if frf.var_noise is None else "noise"
        if weight == "noise":
            notes.append("the fit is weighted by the noise alone: the total variance is not known.")
        elif weight == "none":
            notes.append("all lines count alike in the fit: no variance is known.")
    if weight == "none":
        return None, False
    if not isinstance(weight, str) or weight not in variances:
        raise ValueError(
            f"weight is {weight!r}; use 'total', 'noise', 'none' or an array (F, ny, nu)."
        )
    variance = variances[weight]
    if variance is None:
        raise ValueError(
            f"the {weight} variance of the response is not known: {' '.join(frf.notes)} "
            "Use another weight, or measure more."
        )
    if not (variance > 0).any():
        notes.append("the variance is 0 at all lines, so that they count alike in the fit.")
        return None, False
    smooth = _smoothed(variance, 1 if frf.method == "local_polynomial" else frf.realisations - 1)
    return 1.0 / np.maximum(smooth, VANISHING * smooth.max()), True


def _smoothed(variance: Array, degrees_of_freedom: int) -> Array:
    """Variances (F, ny, nu) averaged over neighbouring lines: a weight must not be drawn by lot.

    One over an estimate of few degrees of freedom has no finite mean.
    """
    half = min((DEGREES_OF_FREEDOM // max(1, degrees_of_freedom)) // 2, (len(variance) - 1) // 2)
    if half == 0:
        return variance
    padded = np.pad(variance, ((half, half), (0, 0), (0, 0)), mode="reflect")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1, axis=0)
    return windows.mean(axis=-1)


def _best_start(problem: LinearLeastSquares, nx: int) -> tuple[Start, Matrices]:
    """The subspace estimate that fits best, with its B and D."""
    found = [
        (start, *problem.with_input_matrices(start.A, start.C)) for start in problem.starts(nx)
    ]
    start, cost, matrices = min(found, key=lambda each: each[1], default=(None, np.inf, None))
    if start is None or matrices is None or not np.isfinite(cost):
        raise ValueError(
            f"no stable linear model of order {nx} could be started from these data; "
            "try a lower nx or a longer record."
        )
    return start, matrices


def _findings(start: Start, A: Array) -> list[str]:
    """What the subspace and the poles say of data and order."""
    nx, notes, s = len(A), [], start.singular_values / start.singular_values[0]
    if len(s) >= nx and s[nx - 1] < EMPTY:
        carried = int((s > EMPTY).sum())
        notes.append(
            f"order {nx} is above what the data carry: the subspace has {carried} direction(s) "
            f"above rounding errors; try nx={carried}."
        )
    radius = float(np.abs(np.linalg.eigvals(A)).max())
    if radius > AT_THE_LIMIT:
        notes.append(
            f"the slowest pole has radius {radius:.6f}: data that drift, integrate or come from an "
            "unstable system ask for one, and so does an order above what they carry; look at the "
            "data, or lower nx."
        )
    return notes


def _check_signals(records: list[Record]) -> None:
    for signals, channels in (
        ([r.u for r in records], records[0].inputs),
        ([r.y for r in records], records[0].outputs),
    ):
        everything = np.concatenate(signals)
        for channel, span in zip(channels, np.ptp(everything, axis=0), strict=True):
            if span == 0:
                raise ValueError(
                    f"signal '{channel.name}' is constant in all records; "
                    "a model needs an input that excites and an output that responds: "
                    "check the columns."
                )


def _check_length(records: list[Record], nx: int) -> None:
    nu, ny = len(records[0].inputs), len(records[0].outputs)
    needed, longest = shortest(nx, nu, ny), max(r.samples for r in records)
    if longest < needed:
        raise ValueError(
            f"the longest record has {longest} samples; order nx={nx} with {nu} input(s) and "
            f"{ny} output(s) needs at least {needed}: record more, or lower nx."
        )


def _check_lines(lines: Lines, nx: int) -> None:
    nu, ny = lines.U.shape[1], lines.Y.shape[1]
    unknowns, equations = nx * (nu + ny) + nu * ny, lines.equations
    if equations < unknowns:
        raise ValueError(
            f"{len(lines.z)} excited line(s) make {equations} equations; order nx={nx} with {nu} "
            f"input(s) and {ny} output(s) has {unknowns} unknowns: excite more lines, or lower nx."
        )


def _narrow(records: list[Record], nx: int) -> list[str]:
    """A note where the input moves in too few directions to tell all parameters apart."""
    nu = records[0].u.shape[1]
    wanted = 2 * nx + 1
    windows = [
        np.lib.stride_tricks.sliding_window_view(r.u - r.u.mean(axis=0), wanted, axis=0)
        for r in records
        if r.samples >= wanted
    ]
    rows = np.concatenate([w.reshape(len(w), -1) for w in windows])
    rows = rows / np.maximum(np.sqrt((rows**2).mean(axis=0)), 1e-300)
    size = np.linalg.eigvalsh(rows.T @ rows)
    rank = int((size > NARROW * size[-1]).sum())
    if rank == nu * wanted:
        return []
    return [
        f"the input is too narrow: it excites {rank} of the {nu * wanted} directions that "
        f"order {nx} has (one a frequency and phase); between its frequencies the model is a guess."
    ]


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
        covariance=size[:, None] * found.covariance * size,
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
