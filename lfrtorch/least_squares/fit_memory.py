"""Memory that a fit needs, computed from the sizes of a model."""

from __future__ import annotations

from lfrtorch._support.memory import check_memory
from lfrtorch.engine.cell import LFRCell

SQUARES = 4
"""Number of P x P matrices that a step holds at once: JᵀJ, its columns, JᵀJ + λI and its factor."""

TALL = 3
"""Number of matrices of P x gauge directions that a step holds at once."""


def check_fit_memory(cell: LFRCell, states: int = 0, rows: int = 0) -> None:
    """Raise a ValueError if the fit of a model needs more memory than its device has."""
    # ``states`` is the number of entries of estimated start states. ``rows`` is the number of
    # errors of records with ``line_weight``, whose Jacobian rows are all held at once. Weights may
    # be on torch's ``meta`` device.
    P = sum(p.numel() for p in cell.parameters() if p.requires_grad) + states
    squares = [n**2 for n in (cell.nx, cell.nz, cell.nw)]  # gauge directions of x, z and w
    numbers = SQUARES * P**2 + TALL * P * sum(squares) + max(squares) ** 2 + rows * P
    check_memory(
        numbers * cell.A.element_size(),
        f"a fit of {P} parameters with nx={cell.nx}, nz={cell.nz} and nw={cell.nw}"
        + f" to {rows} samples with line_weight" * (rows > 0),
        "give smaller sizes" + " or fewer periods" * (rows > 0),
        cell.A.device,
    )
