"""Cross-validation of the cascaded tanks' settings, on the estimation record alone.

    python benchmarks/tanks.py --root DIR [--starts 24]

Each eighth of the estimation record is left out once: the rest trains, without a validation part,
and the model simulates the record through what was left out. All begin at the linear model of the
whole record, as that of seven eighths may spend a mode on drift. Prints the RMSE over all eighths,
V: of the median start, of means of 8 and 16 starts (median and range of 20 draws) and of all that
stay stable on inputs twice as loud; and that of the last over the six eighths without a level of
10 V. The official test record is not looked at.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from math import sqrt
from pathlib import Path
from typing import NamedTuple

import numpy as np

import lfrtorch
from lfrtorch._support.types import Array
from lfrtorch.analysis.amplitude_margin import LOUDER, largest_stable_amplitude
from lfrtorch.datasets import cascaded_tanks
from lfrtorch.fitting.folds import Fold, as_folded, folds

PARTS, SKIP = 8, 50
SIZES = {"nz": 2, "nw": 2, "activation": "softplus"}
TRIED = (
    (False, 15, 1.0), (True, 15, 1.0), (True, 15, 3.0), (True, 15, 10.0), (True, 10, 1.0),
    (True, 8, 1.0), (True, 8, 0.3), (True, 8, 3.0), (True, 5, 1.0),
)  # fmt: skip
"""Whether the record has the limit of its sensor, neurons and ridges."""

ITERATIONS = 80
SMALLER, DRAWS = (8, 16), 20


def main() -> int:
    """The table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--root", type=Path, required=True)
    parser.add_argument("--starts", type=int, default=24)
    options = parser.parse_args()
    (measured,) = cascaded_tanks.load(root=options.root, validation=0).train
    heads = ["limit", "neurons", "ridge", "median start"]
    heads += [*(f"mean of {count}" for count in SMALLER), "mean of all", "without a level of 10 V"]
    print(f"| {' | '.join(heads)} |\n" + "|---" * len(heads) + "|")
    for limit, nn, ridge in TRIED:
        whole = measured if limit else replace(measured, limits=None)
        bla = lfrtorch.estimate_bla(whole, nx=2)
        parts = [
            left_out(whole, part, bla, nn, ridge, options.starts)
            for part in folds(as_folded(whole), PARTS)
        ]
        rng = np.random.default_rng(0)
        every, inside = range(options.starts), [part for part in parts if part.highest < 10.0]
        alone = sqrt(np.mean([np.median(np.mean(p.errors**2, axis=1)) for p in parts]))
        cells = [f"{alone:.3f}"]
        for count in SMALLER:
            drawn = [
                rmse(parts, rng.choice(every, min(count, options.starts), replace=False))
                for _ in range(DRAWS)
            ]
            cells.append(f"{np.median(drawn):.3f} ({min(drawn):.3f} .. {max(drawn):.3f})")
        cells += [f"{rmse(some, every):.3f}" for some in (parts, inside)]
        print(
            f"| {'10 V' if limit else 'none'} | {nn} | {ridge} | {' | '.join(cells)} |", flush=True
        )
    return 0


class Part(NamedTuple):
    """Errors (starts, samples) in an eighth, which starts stay stable, and its highest level."""

    errors: Array
    stable: Array
    highest: float


def rmse(parts: Sequence[Part], starts: Sequence[int] | Array) -> float:
    """Error of the mean of some starts, of which those that stay stable count."""
    squares = []
    for part in parts:
        chosen = [i for i in starts if part.stable[i]] or list(starts)
        squares.append(np.mean(np.mean(part.errors[chosen], axis=0) ** 2))
    return sqrt(np.mean(squares))


def left_out_of(whole: lfrtorch.Record, part: Fold) -> lfrtorch.Record:
    """The record up to the end of what was left out, the rest skipped."""
    ((first, last),) = part.windows
    return replace(whole[:last], start=whole.start, x0=whole.x0, skip=max(first, SKIP))


def left_out(
    whole: lfrtorch.Record,
    part: Fold,
    bla: lfrtorch.LinearModel,
    nn: int,
    ridge: float,
    starts: int,
) -> Part:
    """Errors of the starts of settings in what is left out."""
    judged = left_out_of(whole, part)
    trainer = lfrtorch.LevenbergMarquardt(max_iter=ITERATIONS)
    errors, stable = [], []
    for seed in range(starts):
        model = lfrtorch.initialise(bla, part.train, **SIZES, nn=nn, seed=seed)
        lfrtorch.fit(model, part.train, trainer=trainer, ridge=ridge, monitors=[])
        errors.append((judged.y - model.simulate(judged))[judged.skip :, 0])
        stable.append(largest_stable_amplitude(model, part.train) >= max(LOUDER))
    return Part(np.array(errors), np.array(stable), float(judged.y[judged.skip :].max()))


if __name__ == "__main__":
    sys.exit(main())
