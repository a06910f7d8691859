"""Arguments that Hydra 1.4 requires, but Hydra 1.3 does not know."""

from __future__ import annotations

from importlib.metadata import version
from typing import Any

import hydra.utils
from hydra.errors import InstantiationException

IS_1_3 = version("hydra-core").startswith("1.3")

NODE = "full_key: "
"""Beginning of a note on an error, which names the node of the settings."""

COMPOSED: dict[str, Any] = {"version_base": "1.3"} if IS_1_3 else {}
"""Arguments of ``initialize_config_dir``."""

_TRUSTED = None if IS_1_3 else getattr(hydra.utils, "UNSAFE_DISABLE_EXECUTION_CHECKS", None)
# Targets come from the settings in conf/ and from the user's command line, never from data or a
# checkpoint. A static map of the user's own may come from any module.

MAIN: dict[str, Any] = COMPOSED if _TRUSTED is None else {"execution_whitelist": _TRUSTED}
"""Arguments of ``hydra.main``, which may call all targets in the settings."""


def instantiate(node: Any, *args: Any, **options: Any) -> Any:
    """Instantiate a node of the settings; errors get a note, ``full_key: data``."""
    if _TRUSTED is not None:
        options["_execution_whitelist_"] = _TRUSTED
    try:
        return hydra.utils.instantiate(node, *args, **options)
    except Exception as failed:
        cause = failed.__cause__ if isinstance(failed, InstantiationException) else None
        error = failed if cause is None else cause  # Hydra 1.3 wraps the error
        lines = [*notes_of(failed), *str(failed).splitlines()]
        note = next((line for line in lines if line.startswith(NODE)), NODE)
        if note not in notes_of(error):
            error.add_note(note)
        raise error from error.__cause__


def notes_of(error: BaseException) -> list[str]:
    """Notes that were added to an error."""
    return getattr(error, "__notes__", [])
