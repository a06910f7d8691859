"""Linear models of large systems: the fine steering mirror and the F-16, estimation data alone.

    OMP_NUM_THREADS=1 python benchmarks/large_linear.py DIR [--realisations 5] [--f16 10 14 20]

DIR holds the files of nonlinear_benchmarks. Other checkouts run with PYTHONPATH=CHECKOUT. Prints a
table in Markdown; seconds are those of the processor, after a small fit that compiles. Errors are
those of simulations in steady state: the mean over the records that are fitted, and over others
(the mirror's sixth realisation, the F-16's level 5).
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import scipy.io
import torch

import lfrtorch
from lfrtorch import Channel, Record
from lfrtorch.datasets import fine_steering_mirror

MIRROR_ORDER = 28


def main() -> None:
    """The table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("root", type=Path)
    parser.add_argument("--realisations", type=int, default=5, help="of the mirror, 1 to 5")
    parser.add_argument("--f16", type=int, nargs="*", default=[10, 14, 20], help="orders")
    parser.add_argument("--weights", action="store_true", help="also from responses")
    options = parser.parse_args()
    torch.set_num_threads(1)
    small = Record(*np.random.default_rng(0).normal(size=(2, 512)), start="periodic")
    lfrtorch.estimate_bla(small, 2)
    print("| data | nx | fitted | others | slowest pole | iterations | seconds |")
    print("|---|---|---|---|---|---|---|")
    records = mirror(options.root)
    if options.realisations:
        row("mirror", MIRROR_ORDER, records[: options.realisations], records[5:])
    f16 = [level(options.root, each) for each in (1, 3, 7)]
    other = [level(options.root, 5)]
    for nx in options.f16:
        row("F-16", nx, f16, other)
    if options.weights:
        for weight in ("total", "noise", "none"):
            both = mirror(options.root, periods=2)
            row(f"mirror, {weight}", MIRROR_ORDER, both, records[5:], weight=weight)
            steady = [level(options.root, each, mean=False) for each in (1, 3, 7)]
            for nx in options.f16:
                row(f"F-16, {weight}", nx, steady, other, weight=weight)


def row(name: str, nx: int, fitted: list[Record], others: list[Record], **options: str) -> None:
    """Fit and print."""
    begin = time.process_time()
    data = lfrtorch.estimate_frf(fitted) if options else fitted
    model = lfrtorch.estimate_bla(data, nx, **options)  # pyright: ignore
    seconds = time.process_time() - begin
    errors = [
        f"{np.mean([np.sqrt(np.mean((r.y - model.simulate(r)) ** 2)) for r in records]):.6g}"
        for records in (fitted, others)
    ]
    assert model.fit is not None
    ended = f"{model.fit.iterations}, {model.fit.reason.partition(':')[0]}"
    radius = f"{np.abs(model.poles).max():.6f}"
    print(
        f"| {name} | {nx} | {' | '.join(errors)} | {radius} | {ended} | {seconds:.2f} |", flush=True
    )


def mirror(root: Path, level: int = 300, periods: int = 1) -> list[Record]:
    """Six realisations, V to µm, in steady state: the mean of two periods, or both."""
    data = fine_steering_mirror.load(levels=[level], validation=0, mean=periods == 1, root=root)
    unit = tuple(Channel(channel.name, "µm") for channel in data.train[0].outputs)
    return [replace(r, y=1e6 * r.y, outputs=unit, weight=1.0) for r in data.train]


def level(root: Path, number: int, *, mean: bool = True) -> Record:
    """Force to accelerations in steady state: the last eight of nine periods, or their mean."""
    file = f"F16Data_FullMSine_Level{number}.mat"
    data = scipy.io.loadmat(root / "F16" / "F16GVT_Files" / "BenchmarkData" / file)
    N = 8192
    signals = [data[name].T[N : 9 * N] for name in ("Force", "Acceleration")]
    if mean:
        signals = [s.reshape(8, N, -1).mean(axis=0) for s in signals]
    return Record(*signals, fs=400.0, start="periodic", period=N, name=f"level_{number}")


if __name__ == "__main__":
    main()
