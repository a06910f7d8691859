"""Linear models of several orders, each started from those below it and from one subspace.

All orders share the spectra, and one decomposition that holds estimates of every order. A model of
a lower order, extended by the states that describe its errors best, is a start that is at least as
good as that model. So the fitted error falls with the order.

Records that are not periodic are fitted by their spectra, too, from initial states that are free at
the first scored sample: see ``spectral_data_of_parts``. The sum of squares is that of a simulation.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Self

import numpy as np

from lfrtorch._support.threads import spread_by_hand
from lfrtorch._support.types import Array
from lfrtorch.data.metrics import rms
from lfrtorch.data.records import Record, Scaler
from lfrtorch.least_squares.search import Search
from lfrtorch.linear.bla import Settings, default_criterion, physical, pose
from lfrtorch.linear.frf import FRF
from lfrtorch.linear.minima import ALIKE, distinct, no_start, search_from, transformation
from lfrtorch.linear.model import LinearFit, LinearModel
from lfrtorch.linear.refinement import Matrices, Refined
from lfrtorch.linear.requirements import check_spectral_data
from lfrtorch.linear.response_fit import ResponseFit
from lfrtorch.linear.signal_fit import SignalFit
from lfrtorch.linear.spectral_data import spectral_data_of_parts
from lfrtorch.linear.subspace import SpectralSubspace, spectral_subspaces

Window = tuple[int, int]
"""Index of the first sample, and of the one after the last."""

_MOST_STEPS = 80
"""Iterations of a search."""

_SETTLED = 1e-4
"""Relative decrease of the cost over ``_STRIDE`` iterations below which the search ends."""

_STRIDE = 4
"""Iterations between two checks of the decrease."""


def description_length(rmse: float, parameters: int, equations: float) -> float:
    """Return the error times M^(p / 2M), for p parameters and M independent equations.

    Its logarithm is the description length M ln V + p ln M of a mean square V, over 2M (Rissanen,
    Automatica 14, 1978). It chose the true order in 18 of 20 cases, the usual factor
    √(1 + p ln M / M) in 13.
    """
    return rmse * equations ** (parameters / (2.0 * equations))


def fitted(model: LinearModel) -> float:
    """Return the error of the fit."""
    assert model.fit is not None
    return model.fit.rmse


class OrderFits:
    """Fits of several orders to the same data.

    ``train`` holds the records and their windows, over which the mean error becomes the offset of
    the output. It is empty for a response.
    """

    def __init__(
        self,
        problem: ResponseFit,
        scaler: Scaler,
        about: FRF | Record,
        train: Sequence[tuple[Record, Sequence[Window]]],
        *,
        offset: bool,
        most: int,
        max_iter: int,
    ) -> None:
        self.problem, self._scaler, self._about = problem, scaler, about
        self._train, self._offset, self._max_iter = train, offset, max_iter
        inputs = problem.data.U.shape[1] - problem.starts
        self._driven = ResponseFit(
            replace(problem.data, U=problem.data.U[:, :inputs]), known=problem.known
        )
        self._most = most
        self._subspaces: dict[int, list[SpectralSubspace]] = {}
        self._found: dict[int, Matrices] = {}
        self._y_offset = scaler.y_offset

    def _subspaces_for(self, nx: int) -> list[SpectralSubspace]:
        """Return subspaces that hold the order: small subspaces for low orders."""
        most = 12
        while most < nx:
            most *= 2
        most = min(most, self._most)
        if most not in self._subspaces:
            problem = self.problem
            self._subspaces[most] = spectral_subspaces(*problem.equal_noise(problem.data.Y), most)
        return self._subspaces[most]

    @classmethod
    def of(cls, data: list[Record] | FRF, most: int, options: Mapping[str, Any]) -> Self | None:
        """Return the fits of ``estimate_bla``, or ``None`` if it has to fit them one by one."""
        given = {name: value for name, value in options.items() if value is not None}
        if given.get("refine") == "prediction" or np.any(given.get("integrators", 0)):
            return None
        default = "frequency" if isinstance(data, FRF) else default_criterion(data)
        offset, through = given.get("offset", True), given.get("feedthrough", True)
        most_steps = given.get("max_iter", _MOST_STEPS)
        settings = Settings(
            given.get("refine", default), given.get("weight"), offset, through, most_steps
        )
        problem, scaler, about, records, _ = pose(data, settings)
        common: dict[str, Any] = {"offset": offset, "most": most, "max_iter": most_steps}
        if isinstance(problem, SignalFit):
            windows = [[(record.skip, record.samples)] for record in records]
            return cls.of_windows(records, windows, **common, feedthrough=through)
        whole = [(record, [(0, record.samples)]) for record in records]
        return cls(
            problem, scaler, about, whole if settings.refine == "simulation" else (), **common
        )

    @classmethod
    def of_windows(
        cls,
        records: Sequence[Record],
        windows: Sequence[Sequence[Window]],
        *,
        offset: bool,
        feedthrough: bool,
        most: int,
        max_iter: int = _MOST_STEPS,
    ) -> Self:
        """Return the fits of parts of records, each with its initial state as a parameter."""
        scaler = Scaler.of(records, offset=offset)
        parts, weights = [], []
        for record, own in zip(records, windows, strict=True):
            normalised = scaler.normalise(record)
            for first, last in own:
                parts.append((normalised.u[first:last], normalised.y[first:last]))
                weights.append(float(np.max(record.weight)))
        longest = max(len(u) for u, _ in parts)
        enough = min(longest, 4 * (most + 1))  # samples of a part that is fitted
        kept = [i for i, (u, _) in enumerate(parts) if len(u) >= enough]
        # Initial states are unknowns: at most eight parts are fitted, evenly spaced.
        kept = [kept[i] for i in np.unique(np.linspace(0, len(kept) - 1, 8).astype(int))]
        spectra = spectral_data_of_parts(
            [parts[i] for i in kept], [weights[i] for i in kept], offset=offset
        )
        problem = ResponseFit(spectra, known=False, feedthrough=feedthrough, starts=len(kept))
        whole = list(zip(records, windows, strict=True))
        common: dict[str, Any] = {"offset": offset, "most": most, "max_iter": max_iter}
        return cls(problem, scaler, records[0], whole, **common)

    @spread_by_hand()
    def fit(self, nx: int) -> tuple[LinearModel, float]:
        """Fit an order, also from the fits of lower ones; return its description length, too."""
        clock = time.perf_counter()
        check_spectral_data(self.problem.data, nx)
        searches = [search_from(self.problem, matrices) for matrices in self._starts(nx)]
        found = [self.problem.refined(searches[0])]
        for search in searches:
            self._advance(search, 4)  # after which the best few go on
        first, *others = sorted(searches, key=lambda search: search.state.cost)
        same = (1.0 + _SETTLED) * first.state.cost
        finalists = [first, *(search for search in others if search.state.cost > same)]
        for search in finalists[:2]:
            self._advance(search, _MOST_STEPS)
            found.append(self.problem.refined(search))
        best, model, _ = self._best(found, clock, self._y_offset)
        self._found[nx], self._y_offset = best.matrices, model.y_offset
        subspace = self._subspaces_for(nx)[0]
        assert model.fit is not None
        values = tuple(map(float, subspace.singular_values / subspace.size))
        model = replace(model, fit=replace(model.fit, singular_values=values))
        data = self.problem.data
        columns, ny = data.U.shape[1], data.Y.shape[1]  # each initial state has an input
        p = nx * (columns + ny) + (columns - self.problem.starts) * ny
        error = best.rmse * (float(np.sqrt(data.Y.size / ny)) if self._train else 1.0)
        return model, description_length(error, p, data.independent)

    @spread_by_hand()
    def fit_near(self, model: LinearModel) -> tuple[LinearModel, list[Array]]:
        """Fit from a model; return the errors over each whole record, too."""
        clock = time.perf_counter()
        check_spectral_data(self.problem.data, model.nx)
        C = model.C / self._scaler.y_scale[:, None]
        search = search_from(self.problem, self.problem.with_input_matrices(model.A, C)[1])
        found = [self.problem.refined(search)]
        self._advance(search, 12)  # it is near the minimum
        found.append(self.problem.refined(search))
        return self._best(found, clock, model.y_offset)[1:]

    def _best(
        self, found: Sequence[Refined], clock: float, y_offset: Array
    ) -> tuple[Refined, LinearModel, list[Array]]:
        """Choose the system of least simulation error or, for a response, of least criterion."""
        # With free initial states a minimum may have a mode that explains drift and fails in a
        # simulation; the start of a search has less of it.
        models = [self._model(each, clock, y_offset) for each in found]
        best = int(np.argmin([fitted(model) for model, _ in models]))
        return found[best], *models[best]

    def _starts(self, nx: int) -> list[Matrices]:
        """Return starts of finite cost, the best first, and one of each group that is alike."""
        pairs = [
            pair
            for below in (nx - 2, nx - 1)
            if below in self._found
            for pair in self._extended(self._found[below], nx - below)
        ]
        estimates = [subspace.estimate(nx) for subspace in self._subspaces_for(nx)]
        pairs += [(e.A, e.C) for e in estimates if e is not None and len(e.A) == nx]
        found = [self.problem.with_input_matrices(A, C) for A, C in pairs]
        ranked = sorted((each for each in found if np.isfinite(each[0])), key=lambda each: each[0])
        if not ranked:
            raise no_start(nx)
        apart = distinct([cost for cost, _ in ranked], ALIKE) or range(len(ranked))
        return [ranked[i][1] for i in apart][:4]

    def _extended(self, below: Matrices, more: int) -> list[tuple[Array, Array]]:
        """Return A and C of a model with ``more`` states that describe its errors."""
        errors = self.problem.equal_noise(self.problem.errors(below))
        estimates = [each.estimate(more) for each in spectral_subspaces(*errors, more)]
        A, _, C, _ = below
        zeros = np.zeros((len(A), more))
        return [
            (np.block([[A, zeros], [zeros.T, e.A]]), np.hstack([C, e.C]))
            for e in estimates
            if e is not None
        ]

    def _advance(self, search: Search, steps: int) -> None:
        steps = min(steps, self._max_iter)
        while not search.state.reason and search.state.iteration < steps:
            before = search.state.cost
            search.advance(min(steps, search.state.iteration + _STRIDE))
            if search.state.cost > (1.0 - _SETTLED) * before:
                break

    def _model(
        self, found: Refined, clock: float, y_offset: Array
    ) -> tuple[LinearModel, list[Array]]:
        """Return the model in physical units, and its errors in each record."""
        # Estimated initial states depend on the output's offset, so that a guess of it comes first.
        found = self._without_starts(found)
        model = physical(found, self._scaler, self._about)
        model = model.transformed(*transformation(self._driven, found.matrices))
        rmse = found.rmse
        if self._train:
            model = replace(model, y_offset=y_offset)
        errors = [record.y - model.simulate(record) for record, _ in self._train]
        if errors:
            pairs = zip(errors, self._train, strict=True)
            inside = np.concatenate([e[a:b] for e, (_, windows) in pairs for a, b in windows])
            if self._offset:
                mean = inside.mean(axis=0)
                model = replace(model, y_offset=model.y_offset + mean)
                inside, errors = inside - mean, [each - mean for each in errors]
            rmse = float(rms(inside / self._scaler.y_scale))
        criterion, spent = "simulation" if self._train else "frequency", time.perf_counter() - clock
        fit = LinearFit(criterion, rmse, found.iterations, found.reason, spent)
        return replace(model, fit=fit), errors

    def _without_starts(self, found: Refined) -> Refined:
        """Return the system without the inputs that make its initial states."""
        _, B, _, D = found.matrices
        inputs = B.shape[1] - self.problem.starts
        kept = [np.ones_like(m, dtype=bool) for m in found.matrices]
        for matrix in (kept[1], kept[3]):
            matrix[:, inputs:] = False
        entries = np.concatenate([matrix.ravel() for matrix in kept])
        covariance = found.covariance
        if covariance is not None:
            covariance = covariance[np.ix_(entries, entries)]
        return replace(found, B=B[:, :inputs], D=D[:, :inputs], covariance=covariance)
