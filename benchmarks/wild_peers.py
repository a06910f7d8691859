"""Peers on twelve measured systems with their tests, beside ``wild.py``.

    python benchmarks/wild_peers.py DIR --peers DIR [--scripts jax_sysid_seeds ...]

DIR is that of ``wild.py``. A script of contestants/ gets the training part and simulates its input
and that of the test in a row, in two minutes. The first 50 samples of the test are not scored.
Peers are told the order 3. Errors are rms over the output's deviation on the test.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from comparison import simulated
from wild import SKIP, SYSTEMS

from lfrtorch._support import tables

SCRIPTS = (
    "sysidentpy_default",
    "sysidentpy_book",
    "jax_sysid_seeds",
    "freq_statespace_network",
)


def error(folder: Path, script: str, peers: Path) -> tables.Cell:
    """Error of a contestant on the test of a system, or a dash."""
    nu, fs = SYSTEMS[folder.name]
    parts = [
        np.loadtxt(folder / f"{part}.csv", delimiter=",", skiprows=1, ndmin=2)
        for part in ("train", "test")
    ]
    (u, y), (new_u, new_y) = ((part[:, :nu], part[:, nu:]) for part in parts)
    given = {"u": u, "y": y, "every_u": np.vstack((u, new_u)), "fs": fs, "order": 3}
    given |= {"period": 0, "first": 0, "gap": 0}
    found, _ = simulated(script, given, peers)
    if isinstance(found, str):
        return tables.UNKNOWN
    with np.errstate(over="ignore", invalid="ignore"):
        errors = (found[len(u) :] - new_y)[SKIP:] / new_y.std(axis=0)
        rms = float(np.sqrt(np.mean(errors**2)))
    return rms if rms < 100.0 else tables.UNKNOWN


def main() -> None:
    """Print a table, a line for each system."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("root", type=Path)
    parser.add_argument("--peers", type=Path, required=True)
    parser.add_argument("--scripts", nargs="+", default=list(SCRIPTS))
    given = parser.parse_args()
    rows = [
        [name, *(error(given.root / name, script, given.peers) for script in given.scripts)]
        for name in SYSTEMS
    ]
    print(tables.table(["system", *given.scripts], rows))


if __name__ == "__main__":
    main()
