"""Calls of the package's functions with arguments that make no sense, one at a time."""

from __future__ import annotations

import inspect
import math
import signal
import warnings
from collections.abc import Callable
from copy import deepcopy
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

import lfrtorch
from lfrtorch import LfrtorchError, Record, analysis

LIMIT = 60
"""Seconds of a call."""

Case = tuple[str, Callable[[], Any]]
"""A name and a call."""


class Tried(NamedTuple):
    """How a call ended: refused in a message, with a fault, or else well."""

    refused: bool
    fault: str = ""


def tried(call: Callable[[], Any]) -> Tried:
    """The end of a call: another error than the package's own, or none in time, is a fault."""
    signal.signal(signal.SIGALRM, _too_long)
    signal.alarm(LIMIT)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            result = call()
    except (LfrtorchError, FileNotFoundError) as error:
        text = str(error)
        fine = text.strip() and len(text) <= 1000
        return Tried(True, "" if fine else f"message {text[:100]!r}")
    except Exception as error:
        return Tried(False, f"{type(error).__name__}: {str(error)[:150]!r}")
    finally:
        signal.alarm(0)
    return Tried(False, "" if is_finite(result) else "taken, and not finite")


def _too_long(*_: Any) -> None:
    raise TimeoutError(f"did not end in {LIMIT} s")


def is_finite(result: Any) -> bool:
    """Whether the signals of a record, or the weights of a model, are."""
    if isinstance(result, Record):
        return bool(np.isfinite(result.u).all() and np.isfinite(result.y).all())
    model = getattr(result, "model", result)
    if isinstance(model, lfrtorch.Model):
        return all(bool(weights.isfinite().all()) for weights in model.lfr.parameters())
    return True


def of_records(_: Path) -> list[Case]:
    """The arguments of a record."""
    rng = np.random.default_rng(0)
    usual = rng.standard_normal(50)
    arrays: list[Any] = [
        None, "wrong", b"bytes", object(), [], {}, set(), 1.0, True, np.zeros(0), np.zeros((0, 1)),
        np.zeros((50, 0)), np.zeros((2, 50, 2)), usual * 1j, usual.astype(str), np.zeros(50, bool),
        usual.astype(object), np.full(50, np.nan), np.full(50, np.inf), usual * 1e200,
        np.full(50, 1e308), np.zeros(50, "M8[s]"), np.zeros(50, "m8[s]"), [[1.0], [2.0, 3.0]],
        np.ma.masked_array(usual, mask=True), lambda: 0, torch.zeros(50, dtype=torch.complex64),
        np.zeros(49), "1" * 50, np.array(["x"] * 50, object), range(0), iter([1.0]),
        np.float64("nan"), -usual[:1],
    ]  # fmt: skip
    names = ("fs", "start", "skip", "period", "limits", "name", "inputs", "outputs")
    given = {"u": usual, "y": usual, "fs": 1.0}
    pairs = [(name, value) for name in ("u", "y", "reference") for value in arrays]
    pairs += [(name, value) for name in names for value in SCALARS]
    return [_case(Record, given, name, value) for name, value in pairs]


def _case(function: Callable[..., Any], given: dict[str, Any], name: str, value: Any) -> Case:
    call: Any = partial(function, **{**given, name: value})
    return f"{name} = {value!r:.40}", call


SCALARS: list[Any] = [
    None, "wrong", 0, -1, 0.5, math.nan, math.inf, 1e308, 1e-320, True, [], [1.0], [0, 1, 2], {},
    1j, object(), 2**70, -(2**70), np.float32("nan"), np.zeros(0), np.array([1, 2]), b"1",
]  # fmt: skip


def of_functions(folder: Path) -> list[Case]:
    """The arguments of each public function, of calls that work otherwise."""
    rng = np.random.default_rng(0)
    u, x, y = rng.standard_normal(200), np.zeros(2), np.zeros(200)
    for t, value in enumerate(u):
        y[t] = np.tanh(x[0]) + 0.01 * rng.standard_normal()
        x = np.array([0.6 * x[0] + 0.3 * x[1] + value, -0.3 * x[0] + 0.8 * x[1]])
    record = Record(u, y, fs=1.0)
    short = Record(u[:100], y[:100], fs=1.0)
    path = folder / "short.csv"
    np.savetxt(path, np.c_[u, y], delimiter=",", header="u,y", comments="")
    bla = lfrtorch.estimate_bla(record, 2, max_iter=3)
    begin = partial(lfrtorch.initialise, bla, record, nz=1, nw=1, nn=2)
    trainer = lfrtorch.LevenbergMarquardt(max_iter=1)
    one = lfrtorch.fit(begin(), record, trainer=trainer, monitors=[])
    several: Any = [begin(seed=seed) for seed in range(2)]
    predicting = lfrtorch.estimate_bla(record, 2, refine="prediction", max_iter=3)
    inside: Any = lfrtorch.initialise(predicting, record, nz=1, nw=1, nn=2)
    inside = lfrtorch.fit(inside, record, noise="innovation", trainer=trainer, monitors=[]).model
    model, flat = one.model, y[:, None]
    start: Any = lambda bla, train, sizes, seed: begin(seed=seed)  # noqa: E731
    choosing = {"orders": [2], "start": start, "given": {"nx": 2, "nz": 1, "nw": 1, "nn": 2}}
    fitted = {"train": record, "trainer": trainer}
    calls: list[tuple[Callable[..., Any], dict[str, Any]]] = [
        (lfrtorch.multisine, {"samples": 64}),
        (lfrtorch.estimate_bla, {"data": record, "nx": 2, "max_iter": 2}),
        (lfrtorch.estimate_bla, {"data": lfrtorch.estimate_frf(record), "nx": 2, "max_iter": 2}),
        (lfrtorch.estimate_frf, {"records": record}),
        (lfrtorch.estimate_noise, {"model": model, "records": record}),
        (lfrtorch.scan_orders, {"data": record, "orders": [1, 2], "max_iter": 2}),
        (lfrtorch.initialise, {"bla": bla, "records": record, "nz": 1, "nw": 1, "nn": 2}),
        (lfrtorch.fit, {"models": model, **fitted}),
        (lfrtorch.refit, {"result": one, "held_out": short, **fitted}),
        (lfrtorch.mean_model, {"models": several}),
        (lfrtorch.choose_sizes, {"records": record, "linear": lambda nx: bla, **choosing}),
        (lfrtorch.rmse, {"record": record, "y_hat": flat}),
        (lfrtorch.nrmse, {"record": record, "y_hat": flat}),
        (lfrtorch.Settings, {"nx": 2}),
        (lfrtorch.LevenbergMarquardt, {}),
        (lfrtorch.Adam, {}),
        (lfrtorch.Network, {"nz": 1, "nw": 1, "nn": 2}),
        (lfrtorch.Polynomial, {"nz": 1, "nw": 1, "degree": 2}),
        (lfrtorch.LFRCell, {"nu": 1, "ny": 1, "nx": 2}),
        (lfrtorch.load_records, {"path": path, "inputs": "u", "outputs": "y", "fs": 1.0}),
        (analysis.bound, {"model": model, "amplitude": 1.0}),
        (analysis.canonical, {"model": model, "records": record}),
        (analysis.linearise, {"model": model}),
        (analysis.lpv, {"model": model}),
        (analysis.pole_bands, {"model": bla}),
        (analysis.residuals, {"model": model, "records": record}),
        (analysis.response_band, {"model": bla, "frequencies": [0.1, 0.2]}),
        (analysis.spread, {"models": several, "data": record}),
        (analysis.uncertainty, {"model": model, "records": record}),
        (model.simulate, {"data": record}),
        (inside.predict, {"record": record}),
        (inside.observer, {}),
    ]
    others: list[Any] = [
        np.zeros((2, 3, 4)), np.full(200, np.nan), np.full((200, 1), 1e300), np.array(["x"]),
        lambda *_, **__: 0, record, Record(0 * u, 0 * u, fs=1.0), Record(u * 1e80, y, fs=1.0),
        Record(np.c_[u, u], y, fs=1.0), Record(u[:3], y[:3], fs=2.0), model, bla, torch.float16,
        torch.zeros(3),
    ]  # fmt: skip
    cases: list[Case] = []
    for function, given in calls:
        function(**deepcopy(given))  # works otherwise
        own = function.__init__ if function is lfrtorch.Settings else function  # __new__ takes all
        names = [name for name in inspect.signature(own).parameters if name not in LEFT_OUT]
        for name in names:
            for value in [*SCALARS, *others]:
                said, call = _case(function, deepcopy(given), name, value)
                cases.append((f"{getattr(function, '__name__', '')}: {said}", call))
    return cases


LEFT_OUT = {"options", "ranks", "snapshots", "stop", "monitors", "monitor", "watch"}
LEFT_OUT |= {"device", "dtype", "self"}
"""Tools, and what torch itself looks at."""

CASES: dict[str, Callable[[Path], list[Case]]] = {
    "arguments of lfrtorch.Record": of_records,
    "arguments of the other public functions": of_functions,
}
