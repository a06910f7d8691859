"""Column headers with units: "force (N)", "force [N]" or "force/N"."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence

_SCALED = "m|g|s|A|K|mol|cd|Hz|N|Nm|Pa|J|W|VA|V|F|Ω|[Oo]hm|T|H|Wb|S|rad|bar|l|L|eV|C|B"
_OTHER = "min|h|d|sec|deg|°|°C|°F|deg[CF]|%|rpm|rev|psi|lbf?|in|ft|dB|px|counts?|a\\.u\\.|-|1"
_ATOM = rf"(?:(?:da|[TGMkhdcmuµμnpf])?(?:{_SCALED})|{_OTHER})(?:\^?-?[0-9²³⁻¹]+)?"
_UNIT = re.compile(rf"{_ATOM}(?:[/*·. ]{_ATOM})*")
_BRACKETS = re.compile(r"(.*)[(\[]([^()\[\]]*)[)\]]")


def is_unit(text: str) -> bool:
    """Tell if a text looks like a unit: N, mm or m/s^2."""
    return _UNIT.fullmatch(text) is not None


def bracketed(text: str) -> str | None:
    """Text in brackets, if a header is nothing else."""
    name, inside = _parts(text)
    return inside if inside and not name.strip() else None


def _parts(header: str) -> tuple[str, str]:
    """Parts of a header before and in the brackets at its end, if these are short; else empty."""
    found = _BRACKETS.fullmatch(header)
    inside = found[2].strip() if found else ""
    return (found[1], inside) if found and 0 < len(inside) <= 16 else (header, "")


def names_and_units(
    headers: Sequence[str], units: Mapping[str, str]
) -> tuple[tuple[str, str], ...]:
    """Split headers into names and units; ``units`` are known already, by header."""
    # Brackets stay in the name if names would be equal without them, or if they follow the name
    # directly and hold no unit, as in "y(t)".
    found = [(header, units[header]) if units.get(header) else _split(header) for header in headers]
    count = Counter(channel[0] for channel in found)
    return tuple(
        channel if count[channel[0]] == 1 else (header, units.get(header, ""))
        for header, channel in zip(headers, found, strict=True)
    )


def _split(header: str) -> tuple[str, str]:
    before, inside = _parts(header)
    name = before.rstrip()
    if inside and name and (name != before or is_unit(inside)):
        return name, inside
    name, slash, unit = header.partition("/")
    if slash and name.strip() and is_unit(unit.strip()):
        return name.strip(), unit.strip()
    return header, ""
