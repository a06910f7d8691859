"""Parameters of a known model: values, standard errors, and what the data cannot tell apart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from lfrtorch._support.arguments import typed
from lfrtorch._support.errors import InputError
from lfrtorch._support.tables import Cell, in_lines, number, table
from lfrtorch._support.types import Array
from lfrtorch.analysis.confidence_bands import NOT_AT_MINIMUM, uncertainty
from lfrtorch.data.records import Record, as_records
from lfrtorch.model.model import Model

_ALIKE = 0.95
"""Smallest correlation at which a note names two parameters."""

_TAKEN_OVER = 5.0
"""A note names a parameter whose standard error is so many times that with a fixed learned part."""

_AT_BOUND = 1e-6
"""A parameter is at a bound if it is closer than this part of its scale."""


@dataclass(frozen=True, eq=False)
class PhysicalParameters:
    """Parameters of a known model in their units; ``print(found)`` shows them with notes.

    Args:
        names, units: names and units of the parameters.
        values: as fitted.
        errors: standard errors for noise of any colour; NaN if not known.
        correlation: correlation of the estimates.
        alone: standard errors if the learned part were known, where that has a meaning.
        notes: remarks on the parameters; empty if there are none.

    Shape:
        values, errors, alone: (n,), correlation: (n, n).

    Example:
        >>> run = lfrtorch.identify(dataset, lfrtorch.Settings(known=known, nn=0, starts=1))
        >>> run.parameters.names, run.parameters.values.round(4).tolist()
        (('stays', 'gain'), [0.7, 0.3])
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    values: Float[Array, " n"]
    errors: Float[Array, " n"]
    correlation: Float[Array, "n n"]
    alone: Float[Array, " n"]
    notes: tuple[str, ...]

    def rows(self) -> tuple[list[str], list[list[Cell]]]:
        """Head and rows of a table."""
        found = [number(v, 4) for v in self.values], [number(e, 2) for e in self.errors]
        columns = zip(self.names, *found, self.units, strict=True)
        rows: list[list[Cell]] = [[*row] for row in columns]
        return ["parameter", "value", "standard error", "unit"], rows

    def __str__(self) -> str:
        shown = table(*self.rows())
        return "\n".join([shown, *(in_lines(f"note: {note}") for note in self.notes)])

    def entries(self) -> dict[str, Any]:
        """Values, standard errors, correlation and notes, for JSON."""
        columns = zip(self.names, self.values, self.errors, self.units, strict=True)
        each = {n: {"value": float(v), "error": float(e), "unit": u} for n, v, e, u in columns}
        return {
            "values": each,
            "correlation": self.correlation.tolist(),
            "notes": list(self.notes),
        }


@typed()
def physical_parameters(
    model: Model, records: Record | Sequence[Record], *, ridge: float = 0.0
) -> PhysicalParameters:
    """The parameters of a fitted known model, with standard errors.

    The errors are due to noise, corrected for its colour, in all that was fitted together: if the
    learned part can replace a parameter, the error of that parameter is large.

    Args:
        model: a model with known equations.
        records: records of the fit, with starts, skips and weights as in the fit.
        ridge: ridge of the fit; it limits how far parameters move from where the search began, and
            so separates what the data do not.

    Raises:
        ValueError: a model without known equations.

    References:
        Ljung, "System Identification: Theory for the User", 2nd ed., 1999, chapter 9.
        Györök, Hoekstra, Kon, Péni, Schoukens and Tóth, "Orthogonal projection-based regularization
        for efficient model augmentation", 2025 (what to do about it).

    Example:
        >>> run = lfrtorch.identify(dataset, lfrtorch.Settings(known=known, nn=0, starts=1))
        >>> print(lfrtorch.analysis.physical_parameters(run.model, record))
        parameter      value    standard error  unit
        ...
    """
    known, learned = model.lfr.cell.map.known, model.lfr.cell.map.learned
    if known is None:
        raise InputError(
            "the model has no known part, so no physical parameters; give Settings(known=...)."
        )
    names, units = known.physics.parameters, known.physics.units
    scale = known.p_scale.detach().double().cpu().numpy()
    values = np.array([*known.physical.values()])
    n = len(names)
    errors = alone = np.full(n, np.nan)
    correlation, notes = np.eye(n), []
    try:
        found = uncertainty(model, records)
    except InputError as error:
        notes.append(f"no standard errors: {error}")
    else:
        free = [p for p in model.lfr.cell.parameters() if p.requires_grad]
        is_own = np.repeat([p is known.p for p in free], [p.numel() for p in free])
        is_own = is_own[found.kept.numpy()]
        doubts, knows = found.doubts, np.linalg.pinv(found.factor.numpy())  # a root of J' J
        if ridge:
            misses = [record.y - model.simulate(record) for record in as_records(records)]
            deviation = np.sqrt(np.nanmean((np.concatenate(misses) / model.scaler.y_scale) ** 2))
            knows = np.concatenate([knows, np.sqrt(ridge) / deviation * np.eye(len(is_own))])
            doubts = [doubt for doubt in doubts if not doubt.startswith(NOT_AT_MINIMUM)]
            notes.append(
                "these standard errors take the ridge as knowledge, of values near those of the "
                "parameters alone; a fit with nn=0, nx=0 says how well the data tell these."
            )
        root = scale[:, None] * np.linalg.pinv(knows)[is_own]
        errors = np.linalg.norm(root, axis=1)
        safe = np.where(errors > 0, errors, 1.0)[:, None]
        correlation = (root / safe) @ (root / safe).T
        alone = scale * np.linalg.norm(np.linalg.pinv(knows[:, is_own]), axis=1)
        notes += _notes(names, errors, correlation, alone, learned=learned.nw > 0)
        notes += doubts
    low, high = known.bounds.detach().double().cpu().numpy().T
    at = np.minimum(np.abs(values - low), np.abs(values - high)) <= _AT_BOUND * scale
    if at.any():
        listed = ", ".join(np.array(names)[at])
        notes.append(f"at a bound, so that the standard errors mean little: {listed}.")
    return PhysicalParameters(names, units, values, errors, correlation, alone, tuple(notes))


def _notes(
    names: Sequence[str],
    errors: Float[Array, " n"],
    correlation: Float[Array, "n n"],
    alone: Float[Array, " n"],
    *,
    learned: bool,
) -> list[str]:
    """Parameters that the data cannot separate."""
    found = []
    pairs = np.argwhere(np.triu(np.abs(correlation) > _ALIKE, 1))
    if len(pairs):
        listed = ", ".join(f"{names[i]} and {names[j]}" for i, j in pairs)
        found.append(
            f"the data tell a combination of these rather than each (correlation above {_ALIKE}): "
            f"{listed}; know one of them, or excite the system in another way."
        )
    over = errors > _TAKEN_OVER * np.where(alone > 0, alone, np.inf)
    if learned and over.any():
        listed = ", ".join(np.array(names)[over])
        found.append(
            f"the learned part can take the place of {listed}: give what a fit with nn=0, nx=0 "
            "has found as a number, or keep the learned part small with a ridge."
        )
    return found
