"""Does the search find the sizes of planted systems?

    python benchmarks/planted_sizes.py --first 12 --systems 8

Each system has nx = 3, nz = nw = 1 and four neurons; 1024 samples in steady state train and
validate, with noise of 1 % of the output. Sizes tried: nx 3, 4, 5, nz and nw 1, 2, 3, with eight
neurons. Iterations are those of all models.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import lfrtorch
from lfrtorch.records import Record

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from reference import (  # pyright: ignore[reportMissingImports]
    measure,
    random_cell,
    random_model,
)


def searched(seed: int) -> tuple[lfrtorch.SizeSearch, float]:
    """The search of one system, and its seconds of the processor."""
    system = random_model(random_cell(1, 1, 3, 1, 1, 4, radius=0.8, feedback=1.0, seed=seed))

    def measured(number: int) -> Record:
        record = measure(system, 1024, seed=number, start="periodic")
        noise = np.random.default_rng(number + 77).standard_normal(record.y.shape)
        return replace(record, y=record.y + 0.01 * record.y.std() * noise)

    train, validation = measured(1), measured(2)
    linear = cache(lambda nx: lfrtorch.estimate_bla(train, nx=nx))

    def start(sizes: dict[str, Any], seed: int) -> lfrtorch.Model:
        own = {name: size for name, size in sizes.items() if name != "nx"}
        return lfrtorch.initialise(linear(sizes["nx"]), train, **own, seed=seed)

    clock = time.process_time()
    found = lfrtorch.search_sizes(
        start, train, validation, nx=(3, 4, 5), nn=8, linear=linear(3), monitor=lambda *_: None
    )
    return found, time.process_time() - clock


def main() -> None:
    """Print a line a system, and how many were found."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--first", type=int, default=12, help="number of the first system")
    parser.add_argument("--systems", type=int, default=8, help="how many")
    args = parser.parse_args()
    exact = 0
    for seed in range(args.first, args.first + args.systems):
        search, seconds = searched(seed)
        sizes = search.chosen.sizes
        exact += sizes == {"nx": 3, "nz": 1, "nw": 1, "nn": 8}
        iterations = sum(each.iterations for each in search.candidates)
        text = ", ".join(f"{name} {size}" for name, size in sizes.items())
        print(
            f"{seed}: {text}, validation {search.chosen.error:.5f}, {iterations} "
            f"iterations, {seconds:.0f} s",
            flush=True,
        )
    print(f"{exact} of {args.systems}")


if __name__ == "__main__":
    main()
