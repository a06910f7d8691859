"""CPU time of this checkout over that of another one, case by case, with an interval.

    python benchmarks/baseline.py DIR [--pairs 60] [--case "Bouc-Wen, simulation" ...]

``DIR`` is a checkout of lfrtorch, as ``git worktree add DIR COMMIT`` makes it. Each side is one
process that stays, on one thread of the same core. The sides are timed in turn, AB BA AB ..., so
that both meet the same load; a ratio is that of one pair. Exits with 1 if the whole interval of a
case lies beyond the limit.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import problems
from baseline_side import MEASURED
from engine import HERE, available_cores, pinned
from ratios import LEAST_PAIRS, PAIRS, show

from lfrtorch._support.types import Array

SAME = 1e-6
"""Relative difference of two outcomes up to which both sides did the same work."""


class Side:
    """A process that times cases with one of the two checkouts."""

    def __init__(self, checkout: Path, folder: Path) -> None:
        threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
        paths = {"PYTHONPATH": str(checkout), "NUMBA_CACHE_DIR": str(folder / "numba")}
        self.process = subprocess.Popen(
            [sys.executable, str(HERE / "baseline_side.py"), str(folder)],
            env=os.environ | threads | paths,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        package = self._answer()["package"]
        if not Path(package).resolve().is_relative_to(checkout):
            sys.exit(f"Python imports {package} instead of the lfrtorch of '{checkout}'.")

    def time(self, case: str) -> tuple[float, float]:
        """CPU seconds of a case, and its outcome."""
        assert self.process.stdin is not None
        self.process.stdin.write(f"{case}\n")
        self.process.stdin.flush()
        answer = self._answer()
        return answer["seconds"], answer["outcome"]

    def _answer(self) -> dict:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            sys.exit("a side ended early; its message stands above.")
        return json.loads(line)


def main() -> int:
    """Compare all cases and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("checkout", type=Path, metavar="DIR")
    parser.add_argument("--pairs", type=int, default=PAIRS)
    parser.add_argument("--case", nargs="*", choices=MEASURED, default=list(MEASURED))
    options = parser.parse_args()
    checkout = options.checkout.resolve()
    if not (checkout / "lfrtorch" / "__init__.py").is_file():
        parser.error(f"'{checkout}' is no checkout of lfrtorch: git worktree add DIR COMMIT")
    if options.pairs < LEAST_PAIRS:
        parser.error(f"--pairs is {options.pairs}; an interval needs {LEAST_PAIRS} at least.")
    with tempfile.TemporaryDirectory() as scratch, pinned(available_cores()[-1:]):
        folder = Path(scratch)
        problems.write_signals(folder)
        problems.write_large(folder)
        sides = [Side(path, folder) for path in (checkout, HERE.parent)]
        sides[0].time("prepare")  # a later version reads what an earlier one saved
        timed = {case: compare(case, sides, options.pairs) for case in options.case}
        for side in sides:
            side.process.kill()
            side.process.wait()
    return show(timed)


def compare(case: str, sides: Sequence[Side], pairs: int) -> Array:
    """CPU seconds (pairs, 2) of baseline and today."""
    print(f"  {case}", file=sys.stderr, flush=True)
    (_, before), (_, now) = (side.time(case) for side in sides)  # which may compile
    if not math.isclose(before, now, rel_tol=SAME):
        print(f"{case}: the outcomes are {before} and {now}; the two may not do the same work.")
    seconds = np.empty((pairs, 2))
    for pair in range(pairs):
        for side in (0, 1) if pair % 2 == 0 else (1, 0):
            seconds[pair, side] = sides[side].time(case)[0]
    return seconds


if __name__ == "__main__":
    sys.exit(main())
