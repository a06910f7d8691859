"""Declaration of settings: default, help text and limits of a field of a dataclass."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Container
from dataclasses import field, fields
from typing import Any, TypeVar

Kind = TypeVar("Kind", bound=type)


def setting(default: Any, help: str, **limits: Any) -> Any:
    """Declare a field of a dataclass; a default that is a class is called anew for each object.

    Limits are keywords of ``checks.integer`` if they include ``least``, else of ``checks.number``.
    """
    given: dict[str, Any] = {"default_factory" if callable(default) else "default": default}
    return field(**given, metadata={"help": help, "limits": limits})


def check_settings(settings: Any, prefix: str = "", without: Container[str] = ()) -> None:
    """Refuse values beyond their limits; None passes if it is the default."""
    # Numpy is imported with the first check: help texts need the declarations alone.
    from lfrtorch._support.checks import integer, number

    for one in fields(settings):
        value, limits = getattr(settings, one.name), one.metadata.get("limits")
        if limits and one.name not in without and not (value is None and one.default is None):
            check = integer if "least" in limits else number
            check(prefix + one.name, value, **limits)


def documented(kind: Kind) -> Kind:
    """Write the help texts of a dataclass into its docstring, before its other sections."""
    lines = ["    Args:"]
    for one in fields(kind):
        text = textwrap.fill(f"{one.name}: {one.metadata['help']}", 88, break_on_hyphens=False)
        lines.append(textwrap.indent(text, 12 * " ")[4:])
    first, *rest = re.split(r"\n\n(?=    (?:Raises|Example):)", kind.__doc__ or "", maxsplit=1)
    kind.__doc__ = "\n\n".join([first, "\n".join(lines), *rest])
    return kind
