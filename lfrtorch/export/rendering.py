"""The text of an export from its template."""

from __future__ import annotations

from typing import Any


def rendered(template: str, **known: Any) -> str:
    """A template of this room's folder ``templates``, filled."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("lfrtorch.export"),
        trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True,
    )  # fmt: skip
    return environment.get_template(template).render(known)
