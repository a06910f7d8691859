"""One fit on one and on two processes: seconds, a thread each.

    python benchmarks/processes.py

Starts: 8 starts of the Bouc-Wen case, 40 iterations, whose processes share the starts. Records: 20
iterations of one start at the size of an aircraft, whose processes share three records, and at that
of a mirror, five records. On a machine that others use, the ratio is that of the least seconds of
several turns.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import torch
from problems import AIRCRAFT, MIRROR, SIZES, prepare, records

import lfrtorch
from lfrtorch.distributed import connect

CASES = {"boucwen": 40, AIRCRAFT: 20, MIRROR: 5}
"""Iterations of each."""
TURNS = 3


def main() -> int:
    """The table, or one measurement of it."""
    if "RANK" in os.environ:
        return measured(Path(sys.argv[1]), sys.argv[2])
    print("| case | 1 process | 2 processes | ratio |\n| --- | --- | --- | --- |")
    with tempfile.TemporaryDirectory() as folder:
        prepare(Path(folder), None)
        for name in CASES:
            turns = [[run(folder, name, count) for count in (1, 2)] for _ in range(TURNS)]
            one, two = (min(seconds) for seconds in zip(*turns, strict=True))
            cells = f"{one:.1f} s | {two:.1f} s | {two / one:.2f}"
            print(f"| {name} | {cells} |", flush=True)
    return 0


def run(folder: str, name: str, count: int) -> float:
    """Seconds of the fit on so many processes."""
    words = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(count)]
    done = subprocess.run(
        [sys.executable, *words, __file__, folder, name],
        env=os.environ | {"OMP_NUM_THREADS": "1"}, capture_output=True, text=True, check=True,
    )  # fmt: skip
    return float(done.stdout.split()[-1])


def measured(folder: Path, name: str) -> int:
    """One of the processes."""
    torch.set_num_threads(1)
    data = records(folder, name)
    model = lfrtorch.load(folder / name)
    models = [model]
    if name in SIZES:
        sizes: dict[str, Any] = dict(SIZES[name])
        bla = lfrtorch.estimate_bla(data, sizes.pop("nx"), offset=False, max_iter=3)
        models = [lfrtorch.initialise(bla, data, **sizes, seed=seed) for seed in range(8)]
    trainer = lfrtorch.LevenbergMarquardt(max_iter=2)
    warm = [lfrtorch.load(folder / name)]
    lfrtorch.fit(warm, data, trainer=trainer, monitors=[[]])  # compiles
    trainer = lfrtorch.LevenbergMarquardt(max_iter=CASES[name], tolerance=0.0)
    with connect() as ranks:
        ranks.sum(torch.ones(1))
        begun = time.perf_counter()
        lfrtorch.fit(models, data, trainer=trainer, monitors=[[]] * len(models))
        if ranks.rank == 0:
            print(time.perf_counter() - begun)
    return 0


if __name__ == "__main__":
    sys.exit(main())
