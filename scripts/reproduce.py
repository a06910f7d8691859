"""The paper's Bouc-Wen table as medians over seeds, from runs of train.py.

    python scripts/reproduce.py data.root=DIR
    python scripts/reproduce.py --seeds 2 --init paper -- trainer.max_iter=100

Each run has a folder of its own below --out and is not repeated where a run of the same command
came to its end there (remove the folder after a change of the package).
Words with an equals sign are passed on to train.py.
"""

from __future__ import annotations

import argparse
import json
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
STARTS = ["zero_output", "paper"]
CASES = ((1, 1), (2, 1), (2, 2))
"""(nz, nw) of the paper's three columns."""


def main() -> int:
    """Run what is missing, then print the medians."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=5, help="seed = data.seed = 0 .. SEEDS - 1")
    parser.add_argument("--init", nargs="+", choices=STARTS, default=STARTS)
    parser.add_argument("--out", type=Path, default=ROOT / "runs" / "reproduce")
    parser.add_argument("overrides", nargs="*", help="settings for train.py, name=value")
    options = parser.parse_intermixed_args()
    if options.seeds < 1:
        parser.error(f"--seeds is {options.seeds}; at least one run is needed")

    print(f"{'init':12} nz nw  {'record':10} {'source':10} {'median':>9} {'best':>9} {'worst':>9}")
    out = options.out.resolve()
    for init in options.init:
        for nz, nw in CASES:
            runs = [
                run(out, seed, [f"init={init}", f"nz={nz}", f"nw={nw}", *options.overrides])
                for seed in range(options.seeds)
            ]
            for name in runs[0]["scores"]:
                show(f"{init:12} {nz:2} {nw:2}", name, [r["scores"][name] for r in runs], "rmse")
            if nz == CASES[-1][0] and nw == CASES[-1][1]:
                for name in runs[0]["scores"]:
                    show(f"{'LTI':18}", name, [r["scores"][name] for r in runs], "lti_rmse")
            seconds = np.median([r["fit"]["seconds"] for r in runs])
            each = np.median([r["fit"]["seconds_per_iteration"] for r in runs])
            print(f"{'':19} fit {seconds:.1f} s, {1e3 * each:.0f} ms an iteration (medians)")
    return 0


def run(out: Path, seed: int, settings: list[str]) -> dict:
    """metrics.json of one run of train.py, which is started where it is missing."""
    words = ["+bench=boucwen", *settings, f"seed={seed}", f"data.seed={seed}"]
    folder = out / "_".join(settings[:3]) / f"seed={seed}"
    file = folder / "metrics.json"
    if file.is_file():
        found = json.loads(file.read_text())
        same = found["command"] == shlex.join(["python", "train.py", *words])
        if same and found["fit"]["reason"] != "interrupted":
            return found
    command = [sys.executable, str(ROOT / "train.py"), *words, f"hydra.run.dir='{folder}'"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"failed: {shlex.join(command)}\n{done.stderr}")
    return json.loads(file.read_text())


def show(label: str, record: str, scores: list[dict], key: str) -> None:
    """One line of the table."""
    values = [score[key] for score in scores]
    figures = " ".join(f"{v:9.2e}" for v in (np.median(values), min(values), max(values)))
    print(f"{label}  {record:10} {scores[0]['source']:10} {figures}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
