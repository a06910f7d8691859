"""Entries of the matrices that are given: a start is put into coordinates that have them.

Matrices of a linear model are known up to the coordinates of its states. So an entry that is given
is first an equation for the coordinates: of all, those are taken whose matrices are nearest to what
is given. The given values are then written, and a fit holds them.
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
"""Matrices of an NL-LFR by name, in physical units; NaN stands for what is free."""

_TRIES = 8
"""Coordinates that the search begins in."""

_ILL = 1e6
"""Condition number of coordinates that are too far from those of the start."""


def with_given(model: Model, given: Given) -> tuple[Model, float]:
    """A model of the same linear part with the entries, and by how much these differed from it.

    Args:
        model: a start; its static map stays as it is.
        given: matrices with u and y in physical units, x, z and w as the model has them.

    Returns:
        The model, and the largest difference before an entry was set, relative to the largest entry
        of its matrix; 0 up to rounding if there are coordinates that have all entries.

    Raises:
        ValueError: no such matrix, another shape, or no finite number at all.
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
    """Starts with the entries of ``fixed``."""

    def check(self, job: Job) -> None:
        """Refuse matrices of other shapes."""
        settings, first = job.settings, job.given.train[0]
        sizes = settings.states, len(first.inputs), len(first.outputs), settings.nz, settings.nw
        checked(settings.fixed, shapes(*sizes))

    def when(self, job: Job) -> bool:
        """Tell if there are such entries."""
        return bool(job.settings.fixed)

    def run(self, job: Job) -> Job:
        """The models with these entries."""
        found = [with_given(model, job.settings.fixed) for model in job.models]
        job.observer.say(
            "fixed: the start differed from what is given by "
            f"{percent(max(apart for _, apart in found))} of a matrix's largest entry at most"
        )
        return replace(job, models=[model for model, _ in found])


def shapes(nx: Any, nu: int, ny: int, nz: Any, nw: Any) -> dict[str, tuple[Any, Any]]:
    """Shapes of the matrices; a size that no given matrix has may be ``"auto"``."""
    into, of = {"A": nx, "Bu": nu, "Bw": nw}, {"Cz": nz, "Cy": ny}
    found = {name: (nx, size) for name, size in into.items()}
    found |= {name: (size, nx) for name, size in of.items()}
    return found | {"Dzu": (nz, nu), "Dyu": (ny, nu), "Dyw": (ny, nw)}


def checked(given: Given, shapes: Mapping[str, tuple[int, int]]) -> dict[str, Array]:
    """The matrices as arrays; refuse those that a model of these shapes has not."""
    found = {}
    for name, value in given.items():
        if name not in Matrices._fields:
            raise InputError(
                f"fixed names '{name}'; the matrices are {', '.join(Matrices._fields)}."
            )
        matrix = reals(f"fixed {name}", value)
        if matrix.shape != shapes[name]:
            raise InputError(
                f"fixed {name} has the shape {matrix.shape}; the model's has {shapes[name]}, with "
                "NaN for entries that are free."
            )
        if np.isinf(matrix).any() or not np.isfinite(matrix).any():
            raise InputError(
                f"fixed {name} is {matrix.tolist()}; give some finite numbers and NaN."
            )
        found[name] = matrix
    return found


def transformed(own: Mapping[str, Array], T: Float[Array, "nx nx"]) -> dict[str, Array]:
    """The matrices with T x for x."""
    inverse = np.linalg.inv(T)
    left = {name: T @ own[name] for name in ("A", "Bu", "Bw")}
    right = {name: own[name] @ inverse for name in ("Cz", "Cy")}
    return {**own, **left, **right, "A": left["A"] @ inverse}


def coordinates(own: Mapping[str, Array], wanted: Mapping[str, Array]) -> Float[Array, "nx nx"]:
    """The T with which the matrices come nearest to what is wanted, by least squares."""
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
