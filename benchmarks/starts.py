"""Which start, and which Levenberg-Marquardt, gets there: over many seeds, on two benchmarks.

    python benchmarks/starts.py --out runs/starts.jsonl --jobs 2
    python benchmarks/starts.py --out runs/starts.jsonl --bench parwh --variants paper zero_output

Every fit is one line of the file, and is not repeated if it is there (remove the file after a
change of the package). One start each, seed = data.seed, data with their official noise. The table
has the median and the worst over the seeds, of the iterate that is best on validation; defaults are
chosen by its first column. The tests are noise free, and simulated (parwh: the stand-in) but for
the Bouc-Wen sweep, which is the official one.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch

import lfrtorch
from lfrtorch.cli.composition import composed
from lfrtorch.cli.hydra_versions import instantiate

CONF = Path(__file__).resolve().parents[1] / "conf"

VARIANTS = {
    "zero_output": ["init=zero_output"],
    "paper": ["init=paper"],
    "zero_output, no acceleration": ["init=zero_output", "trainer.acceleration=false"],
    "zero_output, first damping 1e-2": ["init=zero_output", "trainer.least_damping=1e-2"],
    "zero_output, ridge 0": ["init=zero_output", "ridge=0"],
    "zero_output, ridge 1e-2": ["init=zero_output", "ridge=1e-2"],
}
"""Settings of train.py by name."""

BENCHES = {"boucwen": [], "parwh": ["data.source=stand-in"]}
BUDGETS = {50: 20, 300: 5}
"""Seeds by iterations."""


def jobs(benches: list[str], variants: list[str], most: int) -> Iterator[dict]:
    """All fits of the table."""
    for iterations, seeds in BUDGETS.items():
        for bench in benches:
            for variant in variants:
                for seed in range(min(seeds, most)):
                    yield {
                        "bench": bench, "variant": variant, "iterations": iterations, "seed": seed,
                    }  # fmt: skip


def fitted(job: dict) -> dict:
    """The job and what came of it."""
    torch.set_num_threads(1)
    settings = [
        f"+bench={job['bench']}",
        *BENCHES[job["bench"]],
        *VARIANTS[job["variant"]],
        f"trainer.max_iter={job['iterations']}",
        f"seed={job['seed']}",
        f"data.seed={job['seed']}",
    ]
    cfg = composed("config", settings)
    data = instantiate(cfg.data)
    bla = instantiate(cfg.bla, data.train)
    model = instantiate(cfg.init, bla, data.train, nn=cfg.nn, activation=cfg.activation)
    result = lfrtorch.fit(
        model, data.train, data.validation, trainer=instantiate(cfg.trainer), ridge=cfg.ridge
    )
    errors = [lfrtorch.rmse(r, model.simulate(r)) for r in (*data.validation, *data.tests)]
    validation, tests = errors[: len(data.validation)], errors[len(data.validation) :]
    return job | {
        "validation": float(np.sqrt(np.mean(np.square(validation)))),
        "tests": dict(zip([record.name for record in data.tests], tests, strict=True)),
        "seconds": result.seconds,
        "reason": result.reason,
    }


def table(done: list[dict]) -> str:
    """Medians and the worst in brackets, as Markdown."""
    lines = []
    for bench in BENCHES:
        mine = [d for d in done if d["bench"] == bench]
        if not mine:
            continue
        tests = list(mine[0]["tests"])
        lines += [
            f"\n{bench}: RMSE, median (worst)\n",
            "| start | iterations | seeds | validation | " + " | ".join(tests) + " | s |",
            "|---" * (5 + len(tests)) + "|",
        ]
        for iterations in BUDGETS:
            for variant in VARIANTS:
                runs = [d for d in mine if (d["variant"], d["iterations"]) == (variant, iterations)]
                if runs:
                    columns = [[r["validation"] for r in runs]]
                    columns += [[r["tests"][name] for r in runs] for name in tests]
                    columns = [np.nan_to_num(c, nan=np.inf) for c in columns]  # diverged
                    cells = [f"{np.median(c):.3g} ({max(c):.3g})" for c in columns]
                    seconds = np.median([r["seconds"] for r in runs])
                    cells = [variant, str(iterations), str(len(runs)), *cells, f"{seconds:.0f}"]
                    lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> int:
    """Fit what is missing, then print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="file of the fits, one a line")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--bench", nargs="+", choices=BENCHES, default=list(BENCHES))
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, default=list(VARIANTS))
    parser.add_argument("--seeds", type=int, default=20, help="at most")
    options = parser.parse_args()
    options.out.parent.mkdir(parents=True, exist_ok=True)
    done = []
    if options.out.is_file():
        done = [json.loads(line) for line in options.out.read_text().splitlines()]
    keys = ("bench", "variant", "iterations", "seed")
    there = {tuple(d[key] for key in keys) for d in done}
    missing = [
        job
        for job in jobs(options.bench, options.variants, options.seeds)
        if tuple(job[key] for key in keys) not in there
    ]
    with multiprocessing.get_context("spawn").Pool(options.jobs) as pool:
        for result in pool.imap_unordered(fitted, missing):
            with options.out.open("a") as file:
                file.write(json.dumps(result) + "\n")
            done.append(result)
            print(f"{len(done)} of {len(there) + len(missing)}: {result}", flush=True)
    print(table([d for d in done if d["variant"] in options.variants]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
