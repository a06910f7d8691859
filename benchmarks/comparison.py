"""This package beside its peers: the same records, two minutes on two cores each.

    python benchmarks/comparison.py --root DIR --wild DIR --peers DIR [--only ...]

``--root`` holds the official files, ``--wild`` two_tanks/train.csv and mr_damper/train.csv
(MATLAB's twotankdata at 5 Hz and mrdamper at 200 Hz, 2000 samples each, columns of u and y),
``--peers`` holds a virtual environment for each of freq_statespace, jax_sysid, sysidentpy, tsfast
and neural_ssm (comparison.md has the versions). Every script in contestants/ is what a user types.
Each system is one record for estimation, by the board's own split, of which the last quarter is
new: the scripts get the first three quarters, simulate the input of all four from the first sample
on, and are scored on the last. No test record is read. Results are kept after each run in
comparison.json, and a second call does those that are missing; without any, it prints the table.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lfrtorch import datasets

SCRIPTS = Path(__file__).resolve().parent / "contestants"
RESULTS = Path(__file__).with_suffix(".json")
SECONDS, GRACE = 120.0, 15.0
CONTESTANTS = (
    "lfrtorch_auto",
    "lfrtorch_order",
    "freq_statespace_polynomial",
    "freq_statespace_network",
    "jax_sysid_residual",
    "jax_sysid_seeds",
    "sysidentpy_default",
    "sysidentpy_book",
    "tsfast_quick",
    "tsfast_lstm",
    "neural_ssm_lru",
    "neural_ssm_long",
)
SYSTEMS = {  # states of the literature, unit of the error, its factor
    "silverbox": (2, "mV", 1e3),
    "wiener_hammerstein": (6, "mV", 1e3),
    "cascaded_tanks": (2, "V", 1.0),
    "ced": (3, "ticks/s", 1.0),
    "two_tanks": (2, "m", 1.0),
    "mr_damper": (3, "N", 1.0),
}
WILD = {"two_tanks": 5.0, "mr_damper": 200.0}
"""Systems without a reader, and their rates in Hz."""


def record(name: str, root: Path, wild: Path) -> dict[str, Any]:
    """Signals, (T, 1), rate, and the periods where there are any."""
    about: dict[str, Any] = {"period": 0, "first": 0, "gap": 0}
    if name in WILD:
        u, y = np.loadtxt(wild / name / "train.csv", delimiter=",", skiprows=1).T
        return about | {"u": u[:, None], "y": y[:, None], "fs": WILD[name]}
    data = getattr(datasets, name).load(root=root)
    parts = [r for r in data.train if name != "ced" or r.name == "train_high"]
    if name in ("silverbox", "wiener_hammerstein"):
        parts += data.validation
    skips = [0, *(r.skip for r in parts[1:])]  # those of the validation are in the training, too
    u, y = (
        np.concatenate([getattr(r, signal)[skip:] for r, skip in zip(parts, skips, strict=True)])
        for signal in "uy"
    )
    if name == "silverbox":
        about = {"period": 8192, "first": 164, "gap": 500}
    return about | {"u": u, "y": y, "fs": parts[0].fs}


def run(name: str, script: str, options: argparse.Namespace) -> dict[str, Any]:
    """Error, in the output's deviation and unit, and seconds of one contestant."""
    order, _, factor = SYSTEMS[name]
    given = record(name, options.root, options.wild)
    u, y = given.pop("u"), given.pop("y")
    cut = 3 * len(u) // 4
    given |= {"u": u[:cut], "y": y[:cut], "every_u": u, "order": order}
    found, seconds = simulated(script, given, options.peers)
    if isinstance(found, str):
        return {"failed": found}
    rmse = float(np.sqrt(np.mean((found - y)[cut:] ** 2)))
    if not np.isfinite(rmse) or rmse > 100.0 * np.std(y):
        return {"failed": "diverges", "seconds": round(seconds, 1)}
    return {
        "rmse": factor * rmse,
        "nrmse": rmse / float(np.std(y[cut:])),
        "seconds": round(seconds, 1),
    }


def simulated(
    script: str, given: dict[str, Any], peers: Path
) -> tuple[npt.NDArray[np.float64] | str, float]:
    """What a contestant makes of ``every_u``, or why it did not; and seconds."""
    python = Path(sys.executable)
    if not script.startswith("lfrtorch"):
        python = peers.resolve() / script.rpartition("_")[0] / "bin" / "python"
    with tempfile.TemporaryDirectory() as folder:
        data, out = Path(folder, "given.npz"), Path(folder, "simulated.npy")
        np.savez(data, **given)
        begin = time.time()
        environment = os.environ | {"DEADLINE": str(begin + SECONDS), "PYTHONHASHSEED": "0"}
        try:
            done = subprocess.run(
                [python, SCRIPTS / f"{script}.py", data, out],
                env=environment,
                cwd=folder,
                capture_output=True,
                text=True,
                timeout=SECONDS + GRACE,
                check=False,
            )
        except subprocess.TimeoutExpired:
            return "not done in two minutes", SECONDS
        seconds = time.time() - begin
        if done.returncode and seconds > SECONDS - GRACE:  # it ended itself in time
            return "not done in two minutes", seconds
        if done.returncode or not out.exists():
            return (done.stderr.strip().splitlines() or ["no output"])[-1][:200], seconds
        return np.load(out), seconds


def about(script: str) -> tuple[str, int]:
    """What a script is, from its docstring, and its lines without blanks, docstring, comments."""
    first, *rest = (SCRIPTS / f"{script}.py").read_text().splitlines()
    counted = sum(bool(line.strip()) and not line.lstrip().startswith("#") for line in rest)
    return first.strip('".'), counted


def table(every: dict[str, dict[str, Any]]) -> str:
    """In Markdown: a row for each script, errors and seconds; the best of a column is bold."""
    heads = [f"{name}, {unit}" for name, (_, unit, _) in SYSTEMS.items()]
    rows = [f"| script | lines | {' | '.join(heads)} |", "|---|---|" + "---|" * len(heads)]
    best = {
        name: min((e["rmse"] for e in every.get(name, {}).values() if "rmse" in e), default=0.0)
        for name in SYSTEMS
    }

    def cell(name: str, script: str) -> str:
        entry = every.get(name, {}).get(script, {"failed": "not run"})
        if "failed" in entry:
            return entry["failed"]
        error = f"{entry['rmse']:.3g}"
        error = f"**{error}**" if entry["rmse"] <= best[name] else error
        return f"{error} ({entry['seconds']:.0f} s)"

    for script in CONTESTANTS:
        what, counted = about(script)
        cells = " | ".join(cell(name, script) for name in SYSTEMS)
        rows.append(f"| {what} | {counted} | {cells} |")
    return "\n".join(rows)


def main() -> None:
    """Run what is missing and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--root", type=Path)
    parser.add_argument("--wild", type=Path)
    parser.add_argument("--peers", type=Path)
    parser.add_argument("--only", nargs="*", default=[], help="systems or scripts")
    options = parser.parse_args()
    every = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    if options.root:
        for name in SYSTEMS:
            for script in CONTESTANTS:
                if name in WILD and options.wild is None:
                    continue
                wanted = not options.only or {name, script} & {*options.only}
                if not wanted or script in every.get(name, {}):
                    continue
                entry = run(name, script, options)
                print(name, script, entry, flush=True)
                every.setdefault(name, {})[script] = entry
                RESULTS.write_text(json.dumps(every, indent=1) + "\n")
    print(table(every))


if __name__ == "__main__":
    main()
