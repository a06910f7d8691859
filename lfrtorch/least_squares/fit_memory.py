"""Memory that a fit takes, from the sizes of a model."""

from __future__ import annotations

from lfrtorch._support.memory import check_memory
from lfrtorch.engine.cell import LFRCell

SQUARES = 4
"""Matrices of P x P that a step holds at once: JᵀJ, its columns, damped, its factor."""

TALL = 3
"""Matrices of P x gauge directions that a step holds at once."""


def check_fit_memory(cell: LFRCell, states: int = 0, rows: int = 0) -> None:
    """Refuse a model whose fit takes more memory than its device has with a ValueError."""
    # ``states`` counts all entries of estimated start states; ``rows`` the errors of records with
    # ``line_weight``, whose rows are all held. Weights may be on torch's ``meta`` device.
    P = sum(p.numel() for p in cell.parameters() if p.requires_grad) + states
    squares = [n**2 for n in (cell.nx, cell.nz, cell.nw)]  # coordinates of x, z and w
    numbers = SQUARES * P**2 + TALL * P * sum(squares) + max(squares) ** 2 + rows * P
    check_memory(
        numbers * cell.A.element_size(),
        f"a fit of {P} parameters with nx={cell.nx}, nz={cell.nz} and nw={cell.nw}"
        + f" to {rows} samples with line_weight" * (rows > 0),
        "give smaller sizes" + " or fewer periods" * (rows > 0),
        cell.A.device,
    )
