"""Words of the command line for Python's arguments."""

from __future__ import annotations

import re

from omegaconf import DictConfig

from lfrtorch.cli.declared import YAML
from lfrtorch.reporting.console import Console

GROUPS = ("bla", "frf", "data", "trainer")
"""Groups whose words are arguments of functions. Of a name in several, the last one is meant."""


def translated(text: str, cfg: DictConfig) -> str:
    """A message with Python's arguments as words of the command line."""
    text = text.replace("init_from=run.model", "init_from=RUN")
    text = re.sub(r"estimate_bla\((\w+=\w+)\)", r"bla.\1", text)
    words = {name: f"{group}.{name}" for group in GROUPS for name in cfg.get(group) or {}}
    words |= {str(name): str(name) for name in cfg}

    def translate(found: re.Match[str]) -> str:
        name, value = found[1], found[2]
        if name not in words:
            return found[0]
        value = value.strip("'\"") if value[:1] in ("'", '"') else value
        return f"{words[name]}={YAML.get(value, value)}"

    return re.sub(rf"(?<![\w.])(\w+)=('\w+'|\"\w+\"|{'|'.join(YAML)}|)", translate, text)


class Terminal(Console):
    """Prints in words of the command line."""

    def __init__(self, cfg: DictConfig) -> None:
        super().__init__()
        self.cfg = cfg

    def say(self, text: str) -> None:
        """Print it."""
        super().say(translated(text, self.cfg))
