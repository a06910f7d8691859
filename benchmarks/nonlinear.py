"""The parallel Wiener-Hammerstein stand-in beside freq-statespace: errors and time.

    python benchmarks/nonlinear.py --peers DIR [--seeds 1] [--limits 100 50 50] [--peer-only]

DIR holds an environment ``venv`` with freq-statespace, which runs its own recipe on the same
records: best linear approximation, inference and learning, all parameters. Ours is a default run,
on the same core. Prints a table in Markdown.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

import lfrtorch
from lfrtorch.data.dataset import Dataset
from lfrtorch.datasets import parwh

HERE = Path(__file__).resolve().parent
SIZES = {"nx": 12, "nz": 2, "nw": 2}
NEURONS, DEGREE = 15, 3


def main() -> int:
    """The table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--peers", type=Path, required=True)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--peer-only", action="store_true", help="without ours")
    parser.add_argument(
        "--limits", type=int, nargs=3, default=(100, 50, 50), help="iterations of its stages"
    )
    options = parser.parse_args()
    core = {min(os.sched_getaffinity(0))}  # on several cores the peer was seen to wait for ever
    os.sched_setaffinity(0, core)
    torch.set_num_threads(1)
    names = [record.name for record in parwh.load(source="stand-in").tests]
    print(f"| seed | method | {' | '.join(names)} (mV) | iterations | seconds, so far |")
    print("|---" * (len(names) + 4) + "|")
    for seed in range(options.seeds):
        data = parwh.load(source="stand-in", seed=seed)
        if not options.peer_only:
            ours(seed, data)
        theirs(seed, data, options.peers / "venv" / "bin" / "python", options.limits)
    return 0


def ours(seed: int, data: Dataset) -> None:
    """A default run."""
    begin = time.perf_counter()
    bla = lfrtorch.estimate_bla(data.train, SIZES["nx"])
    row(seed, "lfrtorch, BLA", data, bla.simulate, bla.fit and bla.fit.iterations, begin)
    model = lfrtorch.initialise(
        bla, data.train, nz=SIZES["nz"], nw=SIZES["nw"], nn=NEURONS, seed=seed
    )
    for iterations in (50, 150):
        trainer = lfrtorch.LevenbergMarquardt(max_iter=iterations)
        result = lfrtorch.fit(model, data.train, data.validation, trainer=trainer)
        row(seed, "lfrtorch, NL-LFR", data, model.simulate, result.iterations, begin)


def row(seed: int, label: str, data: Dataset, simulate, iterations, begin: float) -> None:
    """A line of the table."""
    errors = [1e3 * lfrtorch.rmse(record, simulate(record)) for record in data.tests]
    cells = [f"{error:.3f}" for error in errors]
    seconds = f"{time.perf_counter() - begin:.0f}"
    print(f"| {seed} | {label} | {' | '.join(cells)} | {iterations} | {seconds} |", flush=True)


def theirs(seed: int, data: Dataset, python: Path, limits: Sequence[int]) -> None:
    """freq-statespace, stage by stage."""
    u, y = (
        np.stack([getattr(r, side) for r in data.train], axis=-1)[..., None] for side in ("u", "y")
    )
    arrays: dict = {f"u_{record.name}": record.u for record in data.tests}
    arrays |= {"lines": np.arange(1, 4096), "fs": data.train[0].fs, "degree": DEGREE, **SIZES}
    with tempfile.TemporaryDirectory() as place:
        given, found = Path(place) / "given.npz", Path(place) / "found.npz"
        np.savez(given, u=u, y=y, limits=limits, **arrays)
        command = [str(python), str(HERE / "peer_nl.py"), str(given), str(found)]
        environment = os.environ | {"PYTHONHASHSEED": "0"}
        done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
        if done.returncode:  # the stages before stand in the file
            print(f"freq-statespace failed: {done.stderr.strip().splitlines()[-1]}")
        if not found.is_file():
            sys.exit(1)
        with np.load(found) as file:
            out = {key: file[key] for key in file.files}
    seconds = 0.0
    for name, about in json.loads(str(out["stages"])).items():
        seconds += about["seconds"]
        cells = [
            f"{1e3 * lfrtorch.rmse(r, out[f'{name}_{r.name}'].reshape(r.y.shape)):.3f}"
            for r in data.tests
        ]
        label = f"freq-statespace, {name}, {about['parameters']} parameters"
        iterations = about["iterations"] or ""
        print(f"| {seed} | {label} | {' | '.join(cells)} | {iterations} | {seconds:.0f} |")


if __name__ == "__main__":
    sys.exit(main())
