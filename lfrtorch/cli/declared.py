"""Settings that Python declares, as nodes of the configuration and lines of the help."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterator
from dataclasses import MISSING, fields
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import OmegaConf

from lfrtorch.fitting.plain_settings import PlainSettings
from lfrtorch.least_squares.options import AdamOptions, LevenbergMarquardtOptions

YAML = {"True": "true", "False": "false", "None": "null"}
"""Values that YAML and Python write differently."""

_KINDS = {
    "settings": PlainSettings,
    "levenberg_marquardt": LevenbergMarquardtOptions,
    "adam": AdamOptions,
}


def register() -> None:
    """Register the declared settings, so that files of ``conf/`` can name them."""
    for node, kind in _KINDS.items():
        cfg = OmegaConf.create()
        for name, default, _ in _declared(kind):
            OmegaConf.update(cfg, name, default)
        ConfigStore.instance().store(node, cfg)
    OmegaConf.register_new_resolver("declared", _lines, replace=True)


def _declared(kind: Any, prefix: str = "") -> Iterator[tuple[str, Any, str]]:
    """Word, default and help of each setting, with the fields of dataclasses one by one."""
    for one in fields(kind):
        if one.default is MISSING:
            yield from _declared(one.default_factory, f"{prefix}{one.name}.")
        else:
            yield prefix + one.name, one.default, one.metadata["help"]


def _lines(node: str, prefix: str = "") -> str:
    """Lines of the help, in words of the command line instead of Python."""
    found: list[str] = []
    for name, default, help in _declared(_KINDS[node], prefix):
        value = list(default) if isinstance(default, tuple) else default
        word = f"{name}={value:g}" if isinstance(value, float) else f"{name}={value}"
        plain = re.sub(r":\w+:`(.+?)`|``", r"\1", f"{word.replace(' ', ''):17} {help}")
        said = re.sub("True|False|None", lambda python: YAML[python[0]], plain)
        found.append(textwrap.fill(said, 100, subsequent_indent=18 * " "))
    return "\n".join(found)
