"""What every script here gets: a record, the time that is left, and where its output goes."""

import os
import sys
import time
from collections.abc import Callable

import numpy as np

with np.load(sys.argv[1]) as _file:
    u: np.ndarray = _file["u"]  # (N, 1), what the model may be estimated from
    y: np.ndarray = _file["y"]
    every_u: np.ndarray = _file["every_u"]  # (N + new, 1), what it is to simulate from the first on
    fs, order = float(_file["fs"]), int(_file["order"])
    period = int(_file["period"])  # samples of one period, 0 if the record has none
    first, gap = int(_file["first"]), int(_file["gap"])  # where periods begin, and between them

_DEADLINE = float(os.environ["DEADLINE"])


def left() -> float:
    """Seconds until the two minutes are over."""
    return _DEADLINE - time.time()


def affordable(train: Callable[[int], object], asked: int, *, first: int = 2) -> int:
    """Of so many iterations, those that the time allows, by two short runs; the first compiles."""
    seconds: list[float] = []
    for iterations in (first, 3 * first):
        begin = time.perf_counter()
        train(iterations)
        seconds.append(time.perf_counter() - begin)
    each = max(seconds[1] - seconds[0], 0.05 * seconds[1]) / (2 * first)
    return max(1, min(asked, int((left() - max(seconds) - 10.0) / each)))


def keep(simulated: np.ndarray) -> None:
    """Write the output, (N + new, 1), to the file that was asked for."""
    np.save(sys.argv[2], np.asarray(simulated, dtype=float).reshape(len(every_u), -1))
