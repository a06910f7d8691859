"""What a last fit to all estimation records brings, on records that neither trained nor validated.

    python benchmarks/refit.py --root DIR [--only NAME ...] [--seeds 2]
    python benchmarks/refit.py --only boucwen --nn 25 --starts 8

Estimation records alone: a part of each trains, the next validates, the last one is held out.
Official test records are not looked at. Prints the errors on what is held out, of the linear model,
before the refit and after it, in the output's unit.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import lfrtorch
from lfrtorch.datasets import boucwen, ced, silverbox, wiener_hammerstein
from lfrtorch.fitting.refit import all_records

Parts = tuple[lfrtorch.Dataset, lfrtorch.Settings]


def main() -> int:
    """The table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--root", type=Path, help="of the official files")
    parser.add_argument("--only", nargs="*", choices=SETS, default=list(SETS))
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--starts", type=int, default=1)
    parser.add_argument("--nn", type=int, help="neurons. Default: those of the benchmark")
    options = parser.parse_args()
    print("| data | seed | held out | linear | before | after | iterations |")
    print("|---" * 7 + "|")
    for name in options.only:
        for seed in range(options.seeds):
            dataset, settings = SETS[name](options.root, seed)
            changed: dict[str, Any] = {"seed": seed, "starts": options.starts, "refit": True}
            changed |= {} if options.nn is None else {"nn": options.nn}
            run = lfrtorch.identify(
                dataset, replace(settings, **changed), observer=lfrtorch.Observer()
            )
            for record in dataset.tests:
                errors = [
                    f"{lfrtorch.rmse(record, model.simulate(record)):.3g}"
                    for model in (run.linear, run.fit.model, run.model)
                ]
                steps = 0 if run.refit is None else run.refit.iterations
                print("|", " | ".join([name, str(seed), record.name, *errors, str(steps)]), "|")
                sys.stdout.flush()
    return 0


def divided(whole: list[lfrtorch.Record], ends: tuple[int, int], warm_up: int) -> lfrtorch.Dataset:
    """Records cut at two samples; the later parts begin ``warm_up`` unscored samples earlier."""
    first, second = ends

    def part(record: lfrtorch.Record, begin: int, end: int) -> lfrtorch.Record:
        found = record[begin - warm_up : end]
        return replace(found, start=record.start, skip=warm_up)

    return lfrtorch.Dataset(
        "divided",
        train=[replace(r[:first], start=r.start, skip=r.skip) for r in whole],
        validation=[part(r, first, second) for r in whole],
        tests=[part(r, second, r.samples) for r in whole],
    )


def of_wiener_hammerstein(root: Path, seed: int) -> Parts:
    """The circuit of 2009."""
    data = wiener_hammerstein.load(root=root)
    whole = all_records(data.train, data.validation)
    settings = lfrtorch.Settings(nx=7, nz=2, nw=2, trainer=lfrtorch.LevenbergMarquardt(max_iter=80))
    return divided(whole, (45_000, 60_000), 1000), settings


def of_silverbox(root: Path, seed: int) -> Parts:
    """The electronic Duffing oscillator."""
    data = silverbox.load(root=root)
    whole = all_records(data.train, data.validation)
    settings = lfrtorch.Settings(nx=4, nz=2, nw=2, trainer=lfrtorch.LevenbergMarquardt(max_iter=80))
    return divided(whole, (27_000, 35_000), 500), settings


def of_ced(root: Path, seed: int) -> Parts:
    """The coupled drives; where they are cut goes with the seed."""
    data = ced.load(root=root)
    whole = all_records(data.train, data.validation)
    first, second = ((240, 320), (280, 340), (200, 300))[seed % 3]
    settings = lfrtorch.Settings(
        nx=4, nz=1, nw=1, nn=5, ridge=1e-3, trainer=lfrtorch.LevenbergMarquardt(max_iter=100)
    )
    parts = divided(whole, (first, second), first)
    held_out = [replace(r, start="estimated", skip=second) for r in whole]
    return replace(parts, tests=held_out), settings


def of_boucwen(root: Path, seed: int) -> Parts:
    """The hysteretic system: other realisations, and sweeps unlike the test's 40 N; no noise."""
    data, other = boucwen.load(seed=seed), boucwen.load(seed=seed + 555, noise_rms=0.0)
    channels: dict[str, Any] = {
        "inputs": data.train[0].inputs,
        "outputs": data.train[0].outputs,
    }

    def swept(level: float, first: float, rate: float, seconds: float) -> lfrtorch.Record:
        t = np.arange(int(seconds * 15_000)) / 15_000
        u = level * np.sin(2 * np.pi * (first * t + rate * t**2))
        y = boucwen.simulate(u, factors=(20,))
        name = f"sweep of {level:g} N"
        return lfrtorch.Record(u[::20], y, 750.0, skip=2000, name=name, **channels)

    sweeps = [swept(30.0, 16.0, 1 / 8, 110.0), swept(50.0, 20.0, 1 / 10, 110.0)]
    tests = [*other.validation, *other.selection, *sweeps]
    settings = lfrtorch.Settings(nx=3, nz=2, nw=1, ridge=1e-3, linear={"offset": False})
    return replace(data, tests=tests, leaderboard=[], published=()), settings


SETS: dict[str, Callable[[Path, int], Parts]] = {
    "wiener_hammerstein": of_wiener_hammerstein,
    "silverbox": of_silverbox,
    "ced": of_ced,
    "boucwen": of_boucwen,
}

if __name__ == "__main__":
    sys.exit(main())
