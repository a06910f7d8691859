"""Cross-validation of the cascaded tanks' settings, on the estimation record alone.

    python benchmarks/tanks.py --root DIR [--starts 8] [--groups 2]

Each eighth of the estimation record is left out once: the rest trains, without a validation part,
and the model simulates the record through what was left out. Prints the RMSE over all eighths, V:
the median of single starts, the start of least training error, and the mean of all starts that stay
stable on inputs twice as loud, as one model. The official test record is not looked at.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

import lfrtorch
from lfrtorch.datasets import cascaded_tanks

PARTS, SKIP = 8, 50
SIZES = {"nz": 2, "nw": 2, "activation": "softplus"}
TRIED = ((8, 0.1), (8, 1.0), (15, 1.0), (30, 0.3), (30, 1.0), (30, 3.0))
"""Neurons and ridges."""

ITERATIONS = 80


def main() -> int:
    """The table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--root", type=Path, required=True)
    parser.add_argument("--starts", type=int, default=8)
    parser.add_argument("--groups", type=int, default=2, help="of starts, each with a mean")
    options = parser.parse_args()
    (whole,) = cascaded_tanks.load(root=options.root, validation=0).train
    print("| neurons | ridge | starts | median start | least training error | mean of all |")
    print("|---" * 6 + "|")
    for nn, ridge in TRIED:
        for group in range(options.groups):
            seeds = range(options.starts * group, options.starts * (group + 1))
            rows = [left_out(whole, part, nn, ridge, seeds) for part in range(PARTS)]
            errors = np.sqrt(np.mean(np.square(rows), axis=0))
            cells = " | ".join(f"{error:.3f}" for error in errors)
            print(f"| {nn} | {ridge} | {seeds} | {cells} |", flush=True)
    return 0


def left_out(
    whole: lfrtorch.Record, part: int, nn: int, ridge: float, seeds: range
) -> tuple[float, float, float]:
    """Errors on an eighth that is not fitted: of the median start, the first and the mean."""
    length = whole.samples // PARTS
    first, last = part * length, (part + 1) * length
    ends = ((0, first), (last, whole.samples))
    train = [replace(whole[a:b], start="estimated") for a, b in ends if a < b]
    judged = replace(whole[:last], start="estimated", skip=first or SKIP)
    bla = lfrtorch.estimate_bla(train, nx=2)
    models = [lfrtorch.initialise(bla, train, **SIZES, nn=nn, seed=seed) for seed in seeds]
    trainer = lfrtorch.LevenbergMarquardt(max_iter=ITERATIONS)
    result = lfrtorch.fit(models, train, trainer=trainer, ridge=ridge, average=len(models))

    def error(model: lfrtorch.Model) -> float:
        return lfrtorch.rmse(judged, model.simulate(judged))

    alone = [error(models[start.number]) for start in result.starts]
    return float(np.median(alone)), alone[0], error(result.model)


if __name__ == "__main__":
    sys.exit(main())
