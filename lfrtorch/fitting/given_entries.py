"""Given entries of the matrices: a start is transformed to state coordinates that have them.

Matrices of a linear model are determined up to the coordinates of its states. So a given entry is
first an equation for the coordinates: the coordinates are chosen whose matrices are nearest to the
given entries. Then the given values are written into the matrices, and a fit holds them.
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import replace
from typing import Any

import numpy as np
import scipy
import torch
from jaxtyping import Float

from lfrtorch._support.checks import reals
from lfrtorch._support.errors import InputError
from lfrtorch._support.tables import percent
from lfrtorch._support.threads import to_float64
from lfrtorch._support.types import Array
from lfrtorch.engine.cell import Matrices
from lfrtorch.fitting.stage import Job, Stage
from lfrtorch.model.model import Model

Given = Mapping[str, Any]
"""Matrices of an NL-LFR by name, in physical units; NaN marks entries that are free."""

_TRIES = 8
"""Number of coordinate changes that the search begins at."""

_ILL = 1e6
"""Largest condition number of a change of coordinates."""


def with_given(model: Model, given: Given) -> tuple[Model, float]:
    """A model with the given entries, and the largest change that setting them made.

    Args:
        model: a start; its static map does not change.
        given: matrices with u and y in physical units, and x, z and w in the model's units.

    Returns:
        The model in other state coordinates, and the largest change of an entry when it was set,
        relative to the largest entry of its matrix. The change is 0 up to rounding if there are
        coordinates that have all given entries.

    Raises:
        ValueError: an unknown matrix, a wrong shape, or a matrix without a finite number.
    """
    if not given:
        return model, 0.0
    cell, s = deepcopy(model.lfr.cell), model.scaler
    one = np.ones(1)
    units = {
        "Bu": (one, s.u_scale), "Dzu": (one, s.u_scale), "Cy": (1 / s.y_scale, one),
        "Dyu": (1 / s.y_scale, s.u_scale), "Dyw": (1 / s.y_scale, one),
    }  # fmt: skip
    sizes = cell.nx, cell.nu, cell.ny, cell.nz, cell.nw
    entries = {}
    for name, matrix in checked(given, shapes(*sizes)).items():
        rows, columns = units.get(name, (one, one))
        normalised = torch.as_tensor(matrix * rows[:, None] * columns)
        entries[name] = torch.isfinite(normalised), normalised
    before = {n: p.detach().clone() for n, p in cell.named_parameters() if n in Matrices._fields}
    own = {name: p.double().cpu().numpy() for name, p in before.items()}
    cell.hold(entries)
    wanted = {
        name: np.where(mask.numpy(), to_float64(cell.get_parameter(name)), np.nan)
        for name, mask in cell.held.items()
        if name in own
    }
    T = coordinates(own, wanted)
    found, worst = transformed(own, T), 0.0
    with torch.no_grad():
        moved = torch.as_tensor(T).to(cell.state_covariance)
        cell.state_covariance.copy_(moved @ cell.state_covariance @ moved.mT)
        for name in Matrices._fields:
            cell.get_parameter(name).copy_(torch.as_tensor(found[name]))
        for name, matrix in wanted.items():
            mask, p = np.isfinite(matrix), cell.get_parameter(name)
            size = max(np.abs(found[name]).max(), np.abs(matrix[mask]).max()) or 1.0
            worst = max(worst, float(np.abs(found[name] - matrix)[mask].max() / size))
            p[torch.as_tensor(mask)] = torch.as_tensor(matrix[mask]).to(p)
    K = None if model.K is None else moved.to(model.K) @ model.K
    return replace(model, lfr=type(model.lfr)(cell), K=K), worst


class GivenEntries(Stage):
    """Starts with the entries that ``fixed`` gives."""

    def check(self, job: Job) -> None:
        """Refuse matrices of wrong shapes."""
        settings, first = job.settings, job.given.train[0]
        sizes = settings.states, len(first.inputs), len(first.outputs), settings.nz, settings.nw
        checked(settings.fixed, shapes(*sizes))

    def when(self, job: Job) -> bool:
        """Tell if entries are given."""
        return bool(job.settings.fixed)

    def run(self, job: Job) -> Job:
        """The models with these entries."""
        found = [with_given(model, job.settings.fixed) for model in job.models]
        job.observer.say(
            "fixed: entries of the start differed from the given ones by at most "
            f"{percent(max(apart for _, apart in found))} of the largest entry of their matrix"
        )
        return replace(job, models=[model for model, _ in found])


def shapes(nx: Any, nu: int, ny: int, nz: Any, nw: Any) -> dict[str, tuple[Any, Any]]:
    """Shapes of the matrices; a size may be ``"auto"`` if no given matrix depends on it."""
    into, of = {"A": nx, "Bu": nu, "Bw": nw}, {"Cz": nz, "Cy": ny}
    found = {name: (nx, size) for name, size in into.items()}
    found |= {name: (size, nx) for name, size in of.items()}
    return found | {"Dzu": (nz, nu), "Dyu": (ny, nu), "Dyw": (ny, nw)}


def checked(given: Given, shapes: Mapping[str, tuple[int, int]]) -> dict[str, Array]:
    """The matrices as arrays; refuse matrices that do not fit a model of these shapes."""
    found = {}
    for name, value in given.items():
        if name not in Matrices._fields:
            raise InputError(
                f"fixed names '{name}'; the matrices are {', '.join(Matrices._fields)}."
            )
        matrix = reals(f"fixed {name}", value)
        if matrix.shape != shapes[name]:
            raise InputError(
                f"fixed {name} has the shape {matrix.shape}; give {shapes[name]}, the model's, "
                "with NaN for entries that are free."
            )
        if np.isinf(matrix).any() or not np.isfinite(matrix).any():
            raise InputError(
                f"fixed {name} is {matrix.tolist()}; give some finite numbers and NaN."
            )
        found[name] = matrix
    return found


def transformed(own: Mapping[str, Array], T: Float[Array, "nx nx"]) -> dict[str, Array]:
    """The matrices of the model whose state is T x."""
    inverse = np.linalg.inv(T)
    left = {name: T @ own[name] for name in ("A", "Bu", "Bw")}
    right = {name: own[name] @ inverse for name in ("Cz", "Cy")}
    return {**own, **left, **right, "A": left["A"] @ inverse}


def coordinates(own: Mapping[str, Array], wanted: Mapping[str, Array]) -> Float[Array, "nx nx"]:
    """The T whose transformed matrices are nearest to the wanted entries, by least squares."""
    nx, random = len(own["A"]), np.random.default_rng(0)
    moved = [name for name in wanted if name in ("A", "Bu", "Bw", "Cz", "Cy")]
    if not moved:
        return np.eye(nx)
    masks = {name: np.isfinite(wanted[name]) for name in moved}
    sizes = {name: np.abs(wanted[name][masks[name]]).max() or 1.0 for name in moved}

    def residual(t: Array) -> Array:
        T = t.reshape(nx, nx)
        if not np.isfinite(T).all() or np.linalg.cond(T) > _ILL:
            return np.full(sum(int(mask.sum()) for mask in masks.values()), 1e3)
        found = transformed(own, T)
        parts = [((found[n] - wanted[n]) / sizes[n])[masks[n]] for n in moved]
        return np.concatenate(parts)

    best, least = np.eye(nx), np.inf
    for number in range(_TRIES):
        T = np.eye(nx) if number == 0 else random.standard_normal((nx, nx))
        tried = scipy.optimize.least_squares(residual, T.ravel(), x_scale="jac", max_nfev=200)
        if tried.cost < least * (1 - 1e-3) - 1e-24:
            best, least = tried.x.reshape(nx, nx), tried.cost
        if least < 1e-20:
            break
    return best
