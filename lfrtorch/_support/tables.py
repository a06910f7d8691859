"""Numbers and tables for people: the same on a terminal and in the report of a run."""

from __future__ import annotations

import math
from collections.abc import Sequence

from tabulate import tabulate

UNKNOWN = "–"
"""What stands for a number that is not known or not finite."""

DIGITS = 3
"""Significant digits of a number. Poles get four: radii of 0.9991 and 0.9998 differ."""

SMALLEST, LARGEST = 1e-3, 1e5
"""Numbers in this range are written without an exponent."""

Cell = str | int | float | None


def number(value: float | None, digits: int = DIGITS) -> str:
    """A number with its significant digits, trailing zeros included: 1235, 12.3, 0.100, 9.40e-5."""
    if value is None or not math.isfinite(value):
        return UNKNOWN
    if value == 0:
        return "0"
    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")  # of the rounded value
    if SMALLEST <= abs(float(f"{mantissa}e{exponent}")) < LARGEST:
        return f"{value:.{max(0, digits - 1 - int(exponent))}f}"
    return f"{mantissa}e{int(exponent)}"


def quantity(value: float | None, unit: str) -> str:
    """A number with its unit; of a signal without unit the number alone."""
    return f"{number(value)} {unit}".rstrip()


def percent(ratio: float | None) -> str:
    """100 times a ratio, with the sign %."""
    shown = number(in_percent(ratio))
    return shown if shown == UNKNOWN else f"{shown} %"


def in_percent(ratio: float | None) -> float | None:
    """100 times a ratio, if it is known."""
    return None if ratio is None else 100 * ratio


def cell(value: Cell, digits: int = DIGITS) -> str:
    """A value of a table; texts and whole numbers stay as they are."""
    return str(value) if isinstance(value, str | int) else number(value, digits)


def table(head: Sequence[str], rows: Sequence[Sequence[Cell]], digits: int = DIGITS) -> str:
    """Lines of text: a head, a rule, and the rows; columns of words to the left, others right."""
    words = [all(isinstance(row[i], str) for row in rows) for i in range(len(head))]
    return tabulate(
        [[cell(value, digits) for value in row] for row in rows],
        head,
        tablefmt="simple",
        disable_numparse=True,
        colalign=["left" if word else "right" for word in words] if rows else None,
    )
