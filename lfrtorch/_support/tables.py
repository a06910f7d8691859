"""Numbers and tables as text: the same on a terminal and in the report of a run."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable, Sequence
from statistics import median_high

from tabulate import tabulate

UNKNOWN = "–"
"""Text in place of a number that is not known or not finite."""

_DIGITS = 3  # significant digits of a number
_SMALLEST, _LARGEST = 1e-3, 1e5  # numbers in this range are written without an exponent
_PLAIN = 0.1, 1000.0  # numbers in this range need no prefix
_PREFIXES = {-9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M", 9: "G"}  # by power of ten

# Units that may have a prefix; others, such as °C, kg, mm and %, get none.
_PREFIXED = frozenset(
    ("A", "C", "F", "H", "Hz", "J", "N", "N m", "N/m", "N·m", "Nm", "Ohm", "Pa", "T", "V", "W",
     "m", "m/s", "m/s2", "m/s^2", "m/s²", "rad", "rad/s", "rad/s2", "rad/s^2", "rad/s²", "s", "Ω")
)  # fmt: skip
_NEVER_LARGER = ("s", "rad")  # first letters of units that are never kilo or more

# Near the unit circle 1 - |p| is printed instead of four digits of |p|; on the circle, 1 alone.
_NEAR, _ROUNDING = 1e-3, 1e-12

WIDEST = 160
"""Largest number of characters of a line of a message."""

Cell = str | int | float | None


def in_lines(text: str) -> str:
    """Break a long sentence into lines; a table stays as it is."""
    if "\n" in text:
        return text
    return textwrap.fill(
        text, WIDEST, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False
    )


def number(value: float | None, digits: int = _DIGITS) -> str:
    """Write a number with its significant digits: 1235, 12.3, 0.100, 9.40e-5."""
    if value is None or not math.isfinite(value):
        return UNKNOWN
    if value == 0:
        return "0"
    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")  # exponent of the rounded value
    if _SMALLEST <= abs(float(f"{mantissa}e{exponent}")) < _LARGEST:
        return f"{value:.{max(0, digits - 1 - int(exponent))}f}"
    return f"{mantissa}e{int(exponent)}"


def engineering(values: Iterable[float | None], unit: str, shown: str = "") -> tuple[float, str]:
    """Factor and unit with the SI prefix in which numbers of a unit are read best.

    All numbers share the factor, so that they can be compared; it brings their median between 0.1
    and 1000. ``shown`` asks for a certain unit. A unit that takes no prefix stays as it is.
    """
    for power, prefix in _PREFIXES.items():
        if shown and shown == prefix + unit:
            return 10.0**-power, shown
    known = [abs(v) for v in values if v and math.isfinite(v)]
    if not known or unit not in _PREFIXED:
        return 1.0, unit
    typical = median_high(known)
    power = 3 * math.floor(math.log10(typical) / 3)
    never = power not in _PREFIXES or (power > 0 and unit.startswith(_NEVER_LARGER))
    if never or _PLAIN[0] <= typical < _PLAIN[1]:
        return 1.0, unit
    return 10.0**-power, _PREFIXES[power] + unit


def factor_of(unit: str) -> str:
    """Put a unit that is a product or a quotient in brackets: (rad/s)."""
    return f"({unit})" if any(sign in unit for sign in "/ ·*^²") else unit


def times(factor: float, value: float | None) -> float | None:
    """Return the product, if the value is known."""
    return None if value is None else factor * value


def quantities(values: Sequence[float | None], unit: str, digits: int = _DIGITS) -> list[str]:
    """Write numbers with their unit, all with the same SI prefix."""
    factor, unit = engineering(values, unit)
    return [f"{number(times(factor, v), digits)} {unit}".rstrip() for v in values]


def quantity(value: float | None, unit: str) -> str:
    """Write a number with its unit, with the SI prefix that it is read best in."""
    return quantities([value], unit)[0]


def percent(ratio: float | None) -> str:
    """Write 100 times a ratio, with the sign %."""
    shown = number(in_percent(ratio))
    return shown if shown == UNKNOWN else f"{shown} %"


def in_percent(ratio: float | None) -> float | None:
    """Return 100 times a ratio, if it is known."""
    return times(100, ratio)


def cell(value: Cell, digits: int = _DIGITS) -> str:
    """Write a value of a table; texts and whole numbers stay as they are."""
    return str(value) if isinstance(value, str | int) else number(value, digits)


def table(
    head: Sequence[str],
    rows: Sequence[Sequence[Cell]],
    digits: int = _DIGITS,
    layout: str = "simple",
) -> str:
    """Write a head, a rule and rows; columns of words to the left, others to the right."""
    words = [all(isinstance(row[i], str) for row in rows) for i in range(len(head))]
    return tabulate(
        [[cell(value, digits) for value in row] for row in rows],
        head,
        tablefmt=layout,
        disable_numparse=True,
        colalign=["left" if word else "right" for word in words] if rows else None,
    )


def radius(value: float | None) -> str:
    """Write the distance of a root from the origin; near the unit circle as 1 ± a number."""
    beyond = (math.nan if value is None else value) - 1.0
    if abs(beyond) < _ROUNDING:
        return "1"
    if abs(beyond) < _NEAR:
        return f"1 {'-' if beyond < 0 else '+'} {number(abs(beyond), 2)}"
    return number(value, 4)
