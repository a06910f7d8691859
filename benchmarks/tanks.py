"""What the cascaded tanks' iterates and starts are judged on: two rules, on estimation data alone.

    python benchmarks/tanks.py --root DIR [--starts 16] [--groups 2]

A quarter of the estimation record is kept as a test, another one is not fitted, the rest trains.
Start and iterate are chosen by the error on the quarter that is not fitted, or by that on all
samples but the test's, simulated in one go from a state fitted to the first 50. Prints the error on
the quarter kept, V. The official test record is not looked at.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

import lfrtorch
from lfrtorch.datasets import cascaded_tanks

QUARTER = 256
CASES = ((3, 1), (3, 2), (0, 2), (0, 3))
"""Quarters kept as test and not fitted: what is left with the latter is one stretch."""

SKIP = 50
SIZES = {"nz": 2, "nw": 2, "nn": 8, "activation": "softplus"}
RIDGE = 0.1


def main() -> int:
    """The table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--root", type=Path, required=True)
    parser.add_argument("--starts", type=int, default=16)
    parser.add_argument("--groups", type=int, default=2, help="of starts, each with a choice")
    options = parser.parse_args()
    torch.set_num_threads(1)
    last = 3 * QUARTER  # its validation record begins at the first sample and ends at the last
    whole = cascaded_tanks.load(root=options.root, first=last).validation[0]
    print("| kept | not fitted | starts | chosen on that quarter | on all | linear |")
    print("|---" * 6 + "|")
    rows = []
    for kept, left_out in CASES:
        for group in range(options.groups):
            seeds = range(options.starts * group, options.starts * (group + 1))
            errors = judged(whole, kept, left_out, seeds)
            rows.append(errors)
            cells = [f"{error:.3f}" for error in errors]
            print(f"| {kept} | {left_out} | {seeds} | {' | '.join(cells)} |", flush=True)
    print(f"| | | median | {' | '.join(f'{e:.3f}' for e in np.median(rows, axis=0))} |")
    return 0


def judged(whole: lfrtorch.Record, kept: int, left_out: int, seeds: range) -> list[float]:
    """Errors on the quarter kept: chosen by either rule, and of the linear model."""

    def cut(first: int, last: int, skip: int = 0) -> lfrtorch.Record:
        return replace(whole[first:last], start="estimated", skip=skip)

    begin, end = (0, QUARTER * kept) if kept else (QUARTER, whole.samples)
    hole = QUARTER * left_out, QUARTER * (left_out + 1)
    train = [cut(a, b) for a, b in ((begin, hole[0]), (hole[1], end)) if a < b]
    rules = [cut(begin, hole[1], hole[0] - begin), cut(begin, end, SKIP)]
    test = cut(0, whole.samples, end) if kept else cut(0, QUARTER, SKIP)
    bla = lfrtorch.estimate_bla(train, nx=2)
    found = []
    for rule in rules:
        models = [lfrtorch.initialise(bla, train, **SIZES, seed=seed) for seed in seeds]
        model = lfrtorch.fit_starts(models, train, [rule], ridge=RIDGE).model
        found.append(lfrtorch.rmse(test, model.simulate(test)))
    return [*found, lfrtorch.rmse(test, bla.simulate(test))]


if __name__ == "__main__":
    sys.exit(main())
