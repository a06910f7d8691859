"""Sentences with numbers by name, for rules that are rows of a table."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from string import Formatter
from typing import Any

from lfrtorch._support.tables import number, percent

Said = str | Callable[[Any], str]
"""A sentence that names attributes of an object, or a function of the object that makes it."""


def said(sentence: Said, of: object, **more: str) -> str:
    """The sentence of an object: {name:%} is in per cent, {name} has three digits, {name:2} two."""
    return sentence(of) if callable(sentence) else _SENTENCES.vformat(sentence, (of,), more)


class _Sentences(Formatter):
    def get_value(self, key: int | str, args: Sequence[Any], kwargs: Mapping[str, Any]) -> Any:
        return kwargs[str(key)] if key in kwargs else getattr(args[0], str(key))

    def format_field(self, value: Any, format_spec: str) -> str:
        if value is not None and not isinstance(value, float):
            return str(value)
        return percent(value) if format_spec == "%" else number(value, int(format_spec or 3))


_SENTENCES = _Sentences()
