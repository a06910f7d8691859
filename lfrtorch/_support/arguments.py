"""Check of the arguments of public functions against the types that their hints name."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import is_dataclass
from functools import cache, wraps
from numbers import Integral, Real
from types import NoneType, SimpleNamespace, UnionType
from typing import Any, Literal, TypeVar, Union, cast, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import ArrayLike

from lfrtorch._support.errors import InputError, brief

Function = TypeVar("Function", bound=Callable[..., Any])

_LONGEST = 80  # characters of a value that a message shows
_NUMBERS = {int: Integral, float: Real}
_UNIONS = (Union, UnionType)
_NAMES: dict[Any, str] = {
    NoneType: "None", bool: "True or False", int: "a whole number", float: "a number",
    str: "a text", Mapping: "a dict", Callable: "a function", np.ndarray: "an array",
}  # fmt: skip


def typed(*own: str) -> Callable[[Function], Function]:
    """Make a function or class refuse arguments of other types than its hints name.

    The function itself checks numbers, arrays and the arguments ``own``.
    """

    def decorate(function: Function) -> Function:
        inner = function.__init__ if isinstance(function, type) else function
        signature = inspect.signature(inner)
        starred = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
        several = {name for name, given in signature.parameters.items() if given.kind in starred}

        @cache
        def hints() -> dict[str, Any]:
            left = {"return", *several, *own}
            texts = {name: t for name, t in inner.__annotations__.items() if name not in left}
            names = inspect.unwrap(inner).__globals__
            # The fields of a dataclass may be inherited from one of another module.
            one = function if is_dataclass(function) else SimpleNamespace(__annotations__=texts)
            found = get_type_hints(one, None if is_dataclass(function) else names)
            return {n: hint for n, hint in found.items() if n in texts and hint not in _NUMBERS}

        @wraps(inner)
        def checked(*args: Any, **kwargs: Any) -> Any:
            given = signature.bind(*args, **kwargs).arguments
            for name, hint in hints().items():
                if name in given and not is_of(given[name], hint):
                    raise InputError(
                        f"{name} is {brief(repr(given[name]), _LONGEST)}; give {wanted(hint)}."
                    )
            return inner(*args, **kwargs)

        if not isinstance(function, type):
            return cast(Function, checked)
        function.__init__ = checked
        return cast(Function, function)

    return decorate


def is_of(value: Any, hint: Any) -> bool:
    """Tell if a value is of the type of a hint; True if the hint is not checked."""
    first, *others = _members(hint)
    if others:
        return any(is_of(value, one) for one in (first, *others))
    hint = first
    origin, inner = get_origin(hint), get_args(hint)
    if origin is Literal:
        plain = value.item() if isinstance(value, np.generic) else value
        return any((type(plain), plain) == (type(one), one) for one in inner)
    if origin is Sequence:
        arrays = isinstance(value, np.ndarray) and inner[0] in _NUMBERS
        several = isinstance(value, Sequence) and not isinstance(value, str | bytes)
        return (several or arrays) and all(is_of(one, inner[0]) for one in value)
    if origin is Iterable:
        return isinstance(value, Iterable) and not isinstance(value, str | bytes)
    if origin is Mapping:
        return isinstance(value, Mapping)
    if origin is Callable:
        return callable(value)
    if hint is bool:
        return isinstance(value, bool | np.bool_)
    if hint in _NUMBERS:
        return isinstance(value, _NUMBERS[hint]) and not isinstance(value, bool)
    if getattr(hint, "_is_protocol", False):
        names = (name for name in vars(hint) if not name.startswith("_"))
        return not isinstance(value, type) and all(hasattr(value, name) for name in names)
    return (
        hint is Any or origin is not None or not isinstance(hint, type) or isinstance(value, hint)
    )


def _members(hint: Any) -> tuple[Any, ...]:
    """Return the members of a union and of its aliases; any other hint is its only member."""
    hint = getattr(hint, "__value__", hint)  # numpy's ArrayLike from numpy 2.5 on
    if get_origin(hint) not in _UNIONS:
        return (hint,)
    return tuple(one for each in get_args(hint) for one in _members(each))


def wanted(hint: Any) -> str:
    """Describe the type that a hint asks for."""
    *others, last = _choices(hint)
    return f"{', '.join(others)} or {last}" if others else last


def _choices(hint: Any) -> list[str]:
    """Describe the types that a hint asks for, one text for each kind."""
    kinds, arrays = _members(hint), _members(ArrayLike)
    if len(kinds) > 1:
        if not set(arrays) <= set(kinds):
            return [text for one in kinds for text in _several(one, kinds) or _choices(one)]
        return ["an array", *(text for one in kinds if one not in arrays for text in _choices(one))]
    origin, inner = get_origin(hint), get_args(hint)
    if origin is Literal:
        return [repr(one) for one in inner]
    if origin in (Sequence, Iterable):
        return [f"a list (each: {wanted(inner[0])})"]
    kind = origin or hint
    name = getattr(kind, "__name__", str(kind))
    return [_NAMES.get(kind) or f"{'an' if name[0] in 'AEIO' or name.isupper() else 'a'} {name}"]


def _several(hint: Any, others: tuple[Any, ...]) -> list[str]:
    """Add that several of a kind can be given, if they can."""
    alike = get_origin(hint) is Sequence and set(_choices(get_args(hint)[0])) <= {
        text for one in others if one is not hint for text in _choices(one)
    }
    return ["several of them"] if alike else []
