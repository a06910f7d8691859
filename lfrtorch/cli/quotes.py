"""Words of the command line in letters of any alphabet, quoted for Hydra, which reads ASCII."""

from __future__ import annotations

import re
from collections.abc import Iterator
from importlib.metadata import version

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Quote, QuotedString
from hydra.errors import HydraException
from omegaconf import OmegaConf

_PIECES = re.compile(
    r"""
      (?P<sign> \s+ | [\[\]{},)] )
    | (?P<quoted> '(?:\\.|[^'\\])*'(?=\s*(?:[\],})]|$)) | "(?:\\.|[^"\\])*"(?=\s*(?:[\],})]|$)) )
    | (?P<function> (?:choice|range|interval|glob|sort|shuffle|tag|int|float|bool|str|json_str
                       |extend_list)\( )
    | (?P<plain> (?:\$\{[^{}]*\} | \([^()]*\) | [^\[\]{},()])
                 (?:\$\{[^{}]*\} | \([^()]*\) | \[\d+\] | [^\[\]{},()])* )
    """,
    re.VERBOSE,
)
"""A value's signs, strings in quotes, functions, and what stands between: Force (N), acc[0]."""

_TABLE = re.compile(r"\{([^{}\[\]]*)\}")
_PAIR = re.compile(
    r"""\s*('(?:\\.|[^'\\])*'|"(?:\\.|[^"\\])*"|[^:,'"]+?)\s*:\s*"""
    r"""('(?:\\.|[^'\\])*'|"(?:\\.|[^"\\])*"|[^,'"]+?)\s*(?:,|$)"""
)

_RENAMED = tuple(map(int, version("omegaconf").split(".")[:2])) >= (2, 4)
register_resolver = getattr(OmegaConf, f"register_{'' if _RENAMED else 'new_'}resolver")
"""Gives a function a name in settings."""

register_resolver(
    "table", lambda *pairs: dict(zip(pairs[::2], pairs[1::2], strict=True)), replace=True
)


def quoted(word: str) -> str:
    """The word with quotes around names in its value that Hydra could not read without."""
    # A word that Hydra can read, or that quotes would not help, comes back as it is.
    name, equals, value = word.partition("=")
    if not equals or is_read(word):
        return word
    table = _TABLE.fullmatch(value)
    spelt = _table(table[1]) if table else "".join(_spelt(value))
    return f"{name}={spelt}" if is_read(f"{name}={spelt}") else word


def is_read(word: str) -> bool:
    """Whether Hydra can read it."""
    try:
        OverridesParser.create().parse_override(word)
    except HydraException:
        return False
    return True


def _spelt(value: str) -> Iterator[str]:
    """The pieces of a value, in quotes where they need them."""
    position = 0
    while position < len(value):
        piece = _PIECES.match(value, position)
        if piece is None:
            yield value[position:]
            return
        yield _name(piece[0]) if piece.lastgroup == "plain" else piece[0]
        position = piece.end()


def _name(text: str) -> str:
    """A name between signs; blanks about it are none of it."""
    name = text.strip()
    if not name or is_read(f"x=[{name}]"):
        return text
    return text.replace(name, in_quotes(name))


def _table(text: str) -> str:
    """A table of names, whose keys Hydra cannot read in quotes either."""
    cells, position = [], 0
    while position < len(text):
        pair = _PAIR.match(text, position)
        if pair is None:
            return f"{{{text}}}"
        cells += pair.groups()
        position = pair.end()
    spelt = [cell if cell[0] in "'\"" else in_quotes(cell) for cell in cells]
    return f"${{table:{','.join(spelt)}}}"


def in_quotes(text: str) -> str:
    """A text as Hydra reads it, whatever is in it."""
    return QuotedString(text, Quote.single).with_quotes()
