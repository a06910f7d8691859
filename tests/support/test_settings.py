"""Every setting is refused outside the range that it is declared with, and described."""

from __future__ import annotations

import re
from dataclasses import MISSING, Field, dataclass, fields
from typing import Any

import pytest

from lfrtorch import Adam, InputError, LevenbergMarquardt, Settings

DECLARED = [(kind, one) for kind in (Settings, LevenbergMarquardt, Adam) for one in fields(kind)]


def _static(one: Field) -> dict[str, Any]:
    return {"static": "polynomial"} if one.name == "degree" else {}


def edges(one: Field) -> tuple[list[Any], list[Any]]:
    """Values that a setting just takes, and values that it just does not."""
    limits = one.metadata["limits"]
    least, word, positive, most = map(limits.get, ("least", "word", "positive", "most"))
    good, bad = [], []
    if isinstance(one.default, bool):
        good, bad = [True, False], ["yes", 1]
    if least is not None:
        good, bad = [least, *filter(None, [word])], [least - 1, least + 0.5, "some"]
    if positive is not None:
        good, bad = [1e-300 if positive else 0, 0.5], [0 if positive else -1e-300, float("nan")]
    if most is not None:
        good, bad = [*good, most], [*bad, 1.01 * most]
    return good, bad


@pytest.mark.parametrize(("kind", "one"), DECLARED, ids=lambda case: getattr(case, "name", ""))
def test_a_setting_is_taken_up_to_its_limits_alone(kind: Any, one: Field):
    least: dict[str, Any] = {"nx": 2} if kind is Settings else {}
    good, bad = edges(one)
    for value in good:
        kind(**least | _static(one) | {one.name: value})
    for value in bad:
        with pytest.raises(InputError, match=rf"{one.name} is {re.escape(repr(value))}; give "):
            kind(**least | {one.name: value})


@pytest.mark.parametrize(("kind", "one"), DECLARED, ids=lambda case: getattr(case, "name", ""))
def test_a_setting_has_a_default_and_a_line_in_the_docstring(kind: Any, one: Field):
    assert one.default is not MISSING or one.default_factory is not MISSING
    assert f"\n        {one.name}: {one.metadata['help'][:40]}" in kind.__doc__


def test_a_search_of_ones_own_may_have_fields_of_its_own():
    @dataclass(frozen=True)
    class Mine(LevenbergMarquardt):
        every: int = 5

    assert Mine(max_iter=3).every == 5
    with pytest.raises(InputError, match="max_iter is -1"):
        Mine(max_iter=-1)
