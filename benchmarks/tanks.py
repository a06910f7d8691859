"""Cross-validation of the cascaded tanks' settings, on the estimation record alone.

    python benchmarks/tanks.py --root DIR [--starts 6]

Each eighth of the estimation record is left out once: the rest trains, without a validation part,
and the model simulates the record through what was left out. All begin at the linear model of the
whole record, as that of seven eighths may spend a mode on drift. Prints the RMSE over all eighths,
V: of the median start, and of the mean of all starts that stay stable on inputs twice as loud; and
that of this mean over the six eighths without a level of 10 V. The official test record is not
looked at.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

import lfrtorch
from lfrtorch.analysis.amplitude_margin import LOUDER, largest_stable_amplitude
from lfrtorch.datasets import cascaded_tanks
from lfrtorch.fitting.folds import Fold, as_folded, folds

PARTS, SKIP = 8, 50
SIZES = {"nz": 2, "nw": 2, "activation": "softplus"}
TRIED = ((False, 15, 1.0), (True, 15, 1.0), (True, 15, 3.0), (True, 15, 10.0), (True, 8, 1.0))
"""Whether the record has the limit of its sensor, neurons and ridges."""

ITERATIONS = 80


def main() -> int:
    """The table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--root", type=Path, required=True)
    parser.add_argument("--starts", type=int, default=6)
    options = parser.parse_args()
    (measured,) = cascaded_tanks.load(root=options.root, validation=0).train
    print("| limit | neurons | ridge | median start | mean of all | without a level of 10 V |")
    print("|---" * 6 + "|")
    for limit, nn, ridge in TRIED:
        whole = measured if limit else replace(measured, limits=None)
        bla = lfrtorch.estimate_bla(whole, nx=2)
        parts = [
            left_out(whole, part, bla, nn, ridge, options.starts)
            for part in folds(as_folded(whole), PARTS)
        ]
        squares, highest = np.array([found for found, _ in parts]), np.array([y for _, y in parts])
        alone, mean = np.sqrt(np.mean(squares, axis=0))
        inside = np.sqrt(np.mean(squares[highest < 10.0, 1]))
        cells = " | ".join(f"{error:.3f}" for error in (alone, mean, inside))
        print(f"| {'10 V' if limit else 'none'} | {nn} | {ridge} | {cells} |", flush=True)
    return 0


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
) -> tuple[tuple[float, float], float]:
    """Mean square errors, of the median start and of the mean, and the highest level there."""
    judged = left_out_of(whole, part)
    trainer = lfrtorch.LevenbergMarquardt(max_iter=ITERATIONS)
    errors, stable = [], []
    for seed in range(starts):
        model = lfrtorch.initialise(bla, part.train, **SIZES, nn=nn, seed=seed)
        lfrtorch.fit(model, part.train, trainer=trainer, ridge=ridge, monitors=[])
        error = (judged.y - model.simulate(judged))[judged.skip :]
        errors.append(error)
        if largest_stable_amplitude(model, part.train) >= max(LOUDER):
            stable.append(error)
    median = float(np.median(np.mean(np.square(errors), axis=(1, 2))))
    mean = float(np.mean(np.square(np.mean(stable or errors, axis=0))))
    return (median, mean), float(judged.y[judged.skip :].max())


if __name__ == "__main__":
    sys.exit(main())
