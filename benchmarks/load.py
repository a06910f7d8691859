"""Long records, many records, many fits in one process: seconds and memory, on one thread.

    python benchmarks/load.py [long records fits]

Each case runs in a process of its own, whose largest memory is that of the whole process, with the
0.5 GB of its libraries. Data are simulated: a saturating system of second order.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import time

import numpy as np
import torch

import lfrtorch

SAMPLES = 10_000_000
"""Of the long record."""
COUNTS, LENGTH = (250, 500, 1000), 1000
"""Numbers of records whose start states are estimated, and samples of each."""
FITS = (100, 500)
"""Numbers of fits after which the memory is read."""


def main() -> int:
    """The cases asked for, or one of them in this process."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("cases", nargs="*", default=list(CASES), help="default: all")
    parser.add_argument("--here", action="store_true", help=argparse.SUPPRESS)
    asked = parser.parse_args()
    for case in asked.cases:
        if asked.here:
            torch.set_num_threads(1)
            CASES[case]()
        else:
            words = [sys.executable, __file__, case, "--here"]
            subprocess.run(words, env=os.environ | {"OMP_NUM_THREADS": "1"}, check=True)
    return 0


def long() -> None:
    """One record of ten million samples."""
    u, y = measured(SAMPLES)
    begun = time.perf_counter()
    record = lfrtorch.Record(u, y, start="zero")
    taken("record", begun)
    begun = time.perf_counter()
    bla = lfrtorch.estimate_bla(record, nx=2, max_iter=5)
    taken("linear model, 5 iterations", begun)
    model = lfrtorch.initialise(bla, record, nz=1, nw=1, nn=5)
    trainer = lfrtorch.LevenbergMarquardt(max_iter=3)
    begun = time.perf_counter()
    result = lfrtorch.fit(model, record, trainer=trainer, monitors=[])
    taken(f"fit, {result.iterations} iterations", begun)
    print(f"largest memory: {largest_memory():.1f} GB", flush=True)


def records() -> None:
    """Many short records with estimated start states: the work must grow as their number."""
    for count in COUNTS:
        u, y = measured(count * LENGTH)
        parts = [slice(i * LENGTH, (i + 1) * LENGTH) for i in range(count)]
        several = [lfrtorch.Record(u[part], y[part], start="estimated") for part in parts]
        begun = time.perf_counter()
        bla = lfrtorch.estimate_bla(several, nx=2, max_iter=3)
        taken(f"{count} records: linear model, 3 iterations", begun)
        model = lfrtorch.initialise(bla, several, nz=1, nw=1, nn=5)
        trainer = lfrtorch.LevenbergMarquardt(max_iter=5, tolerance=0.0)
        result = lfrtorch.fit(model, several, trainer=trainer, monitors=[])
        each = result.seconds / result.iterations
        print(f"{count} records: {each:.2f} s an iteration, {largest_memory():.1f} GB", flush=True)


def fits() -> None:
    """Fits one after another, whose memory must come back."""
    u, y = measured(1000)
    record = lfrtorch.Record(u, y)
    for number in range(1, FITS[-1] + 1):
        bla = lfrtorch.estimate_bla(record, nx=2)
        model = lfrtorch.initialise(bla, record, nz=1, nw=1, nn=5, seed=number)
        trainer = lfrtorch.LevenbergMarquardt(max_iter=5)
        lfrtorch.fit(model, record, trainer=trainer, monitors=[])
        if number in FITS:
            print(f"{number} fits: {1e3 * memory():.0f} MB", flush=True)


CASES = {"long": long, "records": records, "fits": fits}


def measured(samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Input and output."""
    from scipy.signal import lfilter

    rng = np.random.default_rng(0)
    u = rng.standard_normal(samples)
    linear = lfilter([0.0, 1.0, 0.5], [1.0, -1.4, 0.6], u)
    return u, np.tanh(0.3 * linear) + 0.01 * rng.standard_normal(samples)


def taken(what: str, begun: float) -> None:
    """Print the seconds since then."""
    print(f"{what}: {time.perf_counter() - begun:.1f} s", flush=True)


def largest_memory() -> float:
    """Of this process so far, in GB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def memory() -> float:
    """Of this process now, in GB."""
    with open("/proc/self/statm", encoding="utf-8") as file:
        return int(file.read().split()[1]) * resource.getpagesize() / 1e9


if __name__ == "__main__":
    sys.exit(main())
