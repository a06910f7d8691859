"""Settings that exclude each other are refused wherever both are given."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
import torch

import lfrtorch
from lfrtorch import InputError, LinearModel, Record, Settings, initialise
from lfrtorch.fitting.exclusions import EXCLUSIONS, USUAL, Exclusion
from lfrtorch.linear.bla import estimate_bla

KNOWN = lfrtorch.Known(lambda x, u, p: (0.5 * x.h + u[0],), states=["h"], method="discrete")


def begun() -> lfrtorch.Model:
    """A model for a fit to go on from."""
    u = np.random.default_rng(0).standard_normal(100)
    record = Record(u, np.convolve(u, [0.0, 0.6, 0.3])[:100])
    return initialise(estimate_bla(record, 2, max_iter=3), record, nz=1, nw=1, nn=2)


OTHERS: dict[str, tuple[Any, ...]] = {
    "static": ("polynomial", torch.nn.Linear),
    "structure": ("wiener", "hammerstein", "wiener_hammerstein", "parallel"),
    "relaxations": (1,), "modes": (2,), "z_feedthrough": (False,),
    "noise": ("innovation",), "horizon": (50,), "first_part": (0.5,), "average": (2,),
    "ridge": (0.1, {"static": 0.1}),
    "known": (KNOWN,), "fixed": ({"Cy": [[1.0, 0.0]]},),
    "init": ("paper",), "init_from": (begun(),), "feedthrough": (False,),
    "guarantee": ("stable", "contracting"), "integrators": (1,),
}  # fmt: skip
"""Values that are no defaults."""


PAIRS = [
    (row, {row.first: first, row.second: second})
    for row in EXCLUSIONS
    for first in (0.9 if value is float else value for value in row.values or OTHERS[row.first])
    for second in OTHERS[row.second]
]
"""Every row with every pair of values that it excludes."""

STARTING = {"structure", "relaxations", "modes", "z_feedthrough", "static"}
FITTING = {"noise", "horizon", "average", "guarantee"}


def settings(given: dict[str, Any]) -> Settings:
    own = {name: value for name, value in given.items() if name not in ("guarantee", "integrators")}
    own |= {"linear": {"integrators": given.get("integrators", 0)}}
    trainer = lfrtorch.Adam(20, 1e-2, given.get("guarantee"))
    static = "polynomial" if own.get("degree") == "auto" else "network"
    return Settings(**{"nx": 2, "nz": 1, "static": static, "trainer": trainer} | own)


def message(row: Exclusion) -> str:
    """The pattern of what is said: both settings, the reason, and both ways out."""
    both = rf"{row.first} is .* and {row.second} is .*: {re.escape(row.reason)}; give "
    return both + re.escape(
        f"{row.first}={USUAL[row.first]!r} or {row.second}={USUAL[row.second]!r}."
    )


@pytest.mark.parametrize(("row", "given"), PAIRS, ids=str)
def test_pairs_that_exclude_each_other_are_refused_with_the_reason(row: Exclusion, given: dict):
    with pytest.raises(InputError, match=message(row)):
        settings(given)
    for name, value in given.items():
        settings({name: value})


@pytest.fixture(scope="module")
def record() -> Record:
    u = np.random.default_rng(0).standard_normal(300)
    return Record(u, np.convolve(np.tanh(u), [0.0, 0.6, 0.3])[:300])


@pytest.fixture(scope="module")
def linear(record: Record) -> LinearModel:
    return estimate_bla(record, 2, refine="prediction", max_iter=3)


@pytest.mark.parametrize(
    ("row", "given"), [(row, given) for row, given in PAIRS if {*given} <= STARTING], ids=str
)
def test_a_start_cannot_have_both(row: Exclusion, given: dict, record: Record, linear: LinearModel):
    static = {"static": lfrtorch.Polynomial(1, 1, 2)} if "static" in given else {}
    begin: Any = {"nz": 1, "nw": 1, "nn": 2} | given | static
    with pytest.raises(InputError, match=message(row)):
        initialise(linear, record, **begin)


@pytest.mark.parametrize(
    ("row", "given"),
    [(row, given) for row, given in PAIRS if {*given} <= FITTING],
    ids=str,
)
def test_a_fit_cannot_have_both(row: Exclusion, given: dict, record: Record, linear: LinearModel):
    options = {name: value for name, value in given.items() if name != "guarantee"}
    models = [initialise(linear, record, nz=1, nw=1, nn=2, seed=seed) for seed in range(2)]
    trainer = lfrtorch.Adam(1, 1e-2, given.get("guarantee"))
    with pytest.raises(InputError, match=message(row)):
        lfrtorch.fit(models, record, trainer=trainer, **options)


def test_what_is_usual_is_the_default():
    own = {"static": Settings(nx=2).static, "guarantee": lfrtorch.LevenbergMarquardt().guarantee}
    assert own == {name: USUAL[name] for name in own}
