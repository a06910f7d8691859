"""Settings that exclude each other: a row for each pair, with the reason."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any, NamedTuple

from lfrtorch._support.errors import InputError
from lfrtorch.fitting.plain_settings import PlainSettings

USUAL = {one.name: one.default for one in fields(PlainSettings)} | {
    "static": "network", "guarantee": None, "integrators": 0, "known": None, "init_from": None,
    "fixed": {},
}  # fmt: skip
"""Values that exclude nothing: the defaults."""


class Exclusion(NamedTuple):
    """Two settings of which at least one must keep its default.

    Args:
        first, second: names of the settings.
        reason: why a fit cannot have both.
        values: the values of the first setting, or their types, that exclude the second. Default:
            all but the default value.
    """

    first: str
    second: str
    reason: str
    values: tuple[Any, ...] = ()

    def holds(self, given: dict[str, Any]) -> bool:
        """Tell if both settings are given, with values that exclude each other."""
        if not {self.first, self.second} <= {*given}:
            return False
        first, second = given[self.first], given[self.second]
        apart = first != USUAL[self.first]
        if self.values:
            apart = first in self.values or type(first) in self.values
        return bool(apart and second != USUAL[self.second])


_PROVEN = ("contracting", float)

EXCLUSIONS = (
    Exclusion("guarantee", "noise", "a predictor that is stable says nothing of its system"),
    Exclusion("guarantee", "integrators", "no integrator contracts", _PROVEN),
    Exclusion("guarantee", "static", "only slopes of networks are bounded", _PROVEN),
    Exclusion("structure", "relaxations", "its w drives no states", ("wiener",)),
    Exclusion("structure", "modes", "its w drives no states", ("wiener",)),
    Exclusion("structure", "z_feedthrough", "its z is of the inputs alone", ("hammerstein",)),
    Exclusion("known", "guarantee", "nothing is proven of a known model"),
    Exclusion("known", "structure", "its matrices are given"),
    Exclusion("known", "average", "a mean of models has no parameters of its own"),
    Exclusion("known", "fixed", "its matrices are given"),
    Exclusion("known", "init_from", "the model brings what is known of it"),
)


def allowed(name: str, value: Any, given: Mapping[str, Any]) -> bool:
    """Tell if a setting may have a value beside the other settings, which are given."""
    rows = [row for row in EXCLUSIONS if name in (row.first, row.second)]
    return not any(row.holds({**given, name: value}) for row in rows)


def refuse_together(**given: Any) -> None:
    """Raise a ValueError if given settings exclude each other; not all settings must be given."""
    for row in EXCLUSIONS:
        if row.holds(given):
            pair = (row.first, row.second)
            both = " and ".join(f"{name} is {_shown(given[name])}" for name in pair)
            advice = " or ".join(f"{name}={USUAL[name]!r}" for name in pair)
            raise InputError(f"{both}: {row.reason}; give {advice}.")


def _shown(value: Any) -> str:
    """Return a value as a message shows it; a static map may be an object."""
    return "a module" if callable(value) else repr(value)
