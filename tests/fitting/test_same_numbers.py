"""Short fits and their training errors: code that computes them in another way keeps the numbers.

They do not hang on rounding: outputs that are moved by 1e-11 move an error by 2e-11 at most.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from lfrtorch import (
    LFR,
    Channel,
    Dataset,
    FitResult,
    LevenbergMarquardt,
    LFRCell,
    Model,
    Network,
    Record,
    Scaler,
    Settings,
    fit,
    identify,
)
from lfrtorch._support.types import Array

pytestmark = pytest.mark.numeric

RNG = np.random.default_rng
SEARCH = LevenbergMarquardt(max_iter=6)

Weights = dict[str, Array]


def drawn(nu: int, ny: int, nx: int) -> Weights:
    """An NL-LFR of one z, one w and four neurons that settles in some ten samples."""
    rng = RNG([nu, ny, nx])
    shapes = {
        "A": (nx, nx), "Bu": (nx, nu), "Bw": (nx, 1), "Cz": (1, nx), "Dzu": (1, nu),
        "Cy": (ny, nx), "Dyu": (ny, nu), "Dyw": (ny, 1), "static.Wz": (4, 1), "static.bz": (4,),
        "static.Ww": (1, 4), "static.bw": (1,),
    }  # fmt: skip
    found = {name: rng.normal(size=shape) for name, shape in shapes.items()}
    found["A"] *= 0.7 / np.linalg.norm(found["A"], 2)
    found["Bw"] *= 0.2
    return found


def simulated(p: Weights, u: Array, x: Array) -> Array:
    """The outputs from x, with noise of 0.05."""
    y = []
    for v in u:
        w = p["static.Ww"] @ np.tanh(p["static.Wz"] @ (p["Cz"] @ x + p["Dzu"] @ v) + p["static.bz"])
        w = w + p["static.bw"]
        y.append(p["Cy"] @ x + p["Dyu"] @ v + p["Dyw"] @ w)
        x = p["A"] @ x + p["Bu"] @ v + p["Bw"] @ w
    return np.array(y) + 0.05 * RNG([1, len(u)]).normal(size=(len(u), len(p["Cy"])))


def away(p: Weights, fixed: tuple[str, ...] = ()) -> Model:
    """The model some way off, but for the matrices that are fixed."""
    rng, nu, (ny, nx) = RNG(0), p["Bu"].shape[1], p["Cy"].shape
    cell = LFRCell(nu, ny, nx, 1, 1, Network(1, 1, 4), random=False).double()
    with torch.no_grad():
        for name, weight in cell.named_parameters():
            step = 0.0 if name in fixed else 0.1
            weight.copy_(torch.from_numpy(p[name] + step * rng.normal(size=weight.shape)))
            if name in fixed:
                cell.hold({name: (torch.tensor(True), weight.detach())})
    scaler = Scaler(np.zeros(nu), np.ones(nu), np.zeros(ny), np.ones(ny))
    inputs, outputs = ([Channel(f"{s}{i}") for i in range(n)] for s, n in (("u", nu), ("y", ny)))
    return Model(LFR(cell), scaler, 1.0, tuple(inputs), tuple(outputs))


def ends_at(result: FitResult, error: float):
    assert result.iterations == SEARCH.max_iter
    assert result.history[-1].train == pytest.approx(error, rel=1e-6)


def test_entries_that_are_fixed():
    p, u = drawn(1, 1, 2), RNG(1).normal(size=(400, 1))
    record = Record(u, simulated(p, u, np.zeros(2)))
    free = float("nan")
    fixed: Any = {"A": [[1.0, 0.1], [free, free]], "Cy": [[1.0, 0.0]]}  # leave no coordinates free
    settings = Settings(nx=2, nz=1, nw=1, nn=4, starts=1, fixed=fixed, trainer=SEARCH)
    run = identify(Dataset("planted", [record], [], []), settings)
    ends_at(run.fit, 0.05020442827631512)


def test_samples_that_are_left_out():
    p, records = drawn(2, 2, 3), []
    kinds: Any = [(500, {"skip": 20}), (300, {"start": "estimated", "weight": [1.0, 0.3]})]
    for T, options in kinds:
        u = RNG(T).normal(size=(T, 2))
        y = simulated(p, u, RNG([3, T]).normal(size=3) if "start" in options else np.zeros(3))
        valid = RNG([2, T]).random(y.shape) < 0.8
        records.append(Record(u, np.where(valid, y, 9.0), valid=valid, **options))
    ends_at(fit(away(p), records, trainer=SEARCH), 0.04970948071939024)


def test_starts_that_are_measured():
    p, records = drawn(1, 2, 3), []
    p |= {"Cy": np.eye(2, 3), "Dyu": np.zeros((2, 1)), "Dyw": np.zeros((2, 1))}
    for T in (300, 200):
        u = RNG(T).normal(size=(T, 1))
        y = simulated(p, u, np.append(RNG([3, T]).normal(size=2), 0.0))
        records.append(Record(u, y, start="measured"))
    model = away(p, fixed=("Cy", "Dyu", "Dyw"))
    ends_at(fit(model, records, trainer=SEARCH), 0.05099167625682376)
