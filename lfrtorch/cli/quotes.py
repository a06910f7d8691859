"""Words of the command line with any letters, quoted for Hydra, which reads only ASCII."""

from __future__ import annotations

import re
from functools import cache
from importlib.metadata import version

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, Quote, QuotedString
from hydra.errors import HydraException
from omegaconf import OmegaConf

_TEXT = r"""'(?:\\.|[^'\\])*'|"(?:\\.|[^"\\])*\""""  # in quotes
_ENDS = r"(?=\s*(?:[\],})]|$))"
_PART = r"\$\{[^{}]*\}|\([^()]*\)"  # of a name: ${...}, (N)
_KEPT = rf"""
    \s+ | [\[\]{{}},)] | (?:{_TEXT}){_ENDS}
    | (?:choice|range|interval|glob|sort|shuffle|tag|int|float|bool|str|json_str|extend_list)\(
"""
_PIECES = re.compile(
    rf"(?:{_KEPT}) | (?P<name>(?:{_PART}|[^\[\]{{}},()])(?:{_PART}|\[\d+\]|[^\[\]{{}},()])*)",
    re.VERBOSE,
)
"""Signs, quoted strings and functions in a value; between them, names such as Force (N), acc[0]."""

_PAIR = re.compile(rf"""\s*({_TEXT}|[^:,'"]+?)\s*:\s*({_TEXT}|[^,'"]+?)\s*(?:,|$)""")

_RENAMED = tuple(map(int, version("omegaconf").split(".")[:2])) >= (2, 4)
register_resolver = getattr(OmegaConf, f"register_{'' if _RENAMED else 'new_'}resolver")
"""Name of a function in settings."""

register_resolver(
    "table", lambda *pairs: dict(zip(pairs[::2], pairs[1::2], strict=True)), replace=True
)


@cache
def read(word: str) -> Override | None:
    """The word as Hydra reads it, or None."""
    try:
        return OverridesParser.create().parse_override(word)
    except HydraException:
        return None


def quoted(word: str) -> str:
    """The word with quotes around names in its value that Hydra cannot read without quotes."""
    # A word that Hydra can read, or cannot read with quotes either, is returned as it is.
    name, equals, value = word.partition("=")
    if not equals or read(word):
        return word
    table = re.fullmatch(r"\{([^{}\[\]]*)\}", value)
    spelt = f"{name}={_table(table[1]) if table else _PIECES.sub(_piece, value)}"
    return spelt if read(spelt) else word


def _piece(found: re.Match[str]) -> str:
    """A piece of a value; blanks after a name are not part of the name."""
    name = (found["name"] or "").rstrip()
    return found[0].replace(name, in_quotes(name)) if name and not read(f"x=[{name}]") else found[0]


def _table(text: str) -> str:
    """A table of names: Hydra cannot read its keys, even in quotes."""
    cells = [cell for pair in _PAIR.findall(text) for cell in pair]
    spelt = ",".join(cell if cell[0] in "'\"" else in_quotes(cell) for cell in cells)
    return f"{{{text}}}" if _PAIR.sub("", text) else f"${{table:{spelt}}}"


def in_quotes(text: str) -> str:
    """Any text in quotes that Hydra reads."""
    return QuotedString(text, Quote.single).with_quotes()
