"""Does the plain command recommend the right model of a measured system, and does it forget?

    python benchmarks/wild.py DIR [--start auto estimated zero] [--only dc_motor buck ...]

DIR holds a folder for each system with ``train.csv`` and ``test.csv``, inputs first. All sizes are
chosen on the training part, as by ``lfrtorch fit train.csv test=0``. The start of a test is
estimated from its first 50 samples, and the rest is scored. Errors are rms over the output's
deviation on the test. ``apart`` is the distance of outputs from 14 starts in the last third of the
training inputs, and ``refused`` the candidates that do not forget where they began.
"""

from __future__ import annotations

import argparse
import re
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

import lfrtorch
from lfrtorch._support import tables
from lfrtorch._support.types import Array
from lfrtorch.reporting.verdict import NL_LFR

SYSTEMS = {
    "mr_damper": (1, 200.0),
    "dc_motor": (1, 1.0),
    "dryer": (1, 12.5),
    "ballbeam": (1, 10.0),
    "gas_furnace": (1, 1 / 9),
    "flutter": (1, 1.0),
    "actuator": (1, 1.0),
    "buck": (1, 1e5),
    "flexible_arm": (1, 1.0),
    "cd_arm": (2, 1.0),
    "heating": (1, 0.5),
    "exchanger": (1, 1.0),
}
"""Inputs and Hz of each."""

SKIP = 50
"""Samples of a test that tell its start."""


class Notes(lfrtorch.Observer):
    """Keeps what is said."""

    def __init__(self) -> None:
        self.said: list[str] = []

    def say(self, text: str) -> None:
        """Keep a line."""
        self.said.append(text)


def row(folder: Path, nu: int, fs: float, start: str) -> list[tables.Cell]:
    """Scores of one system."""
    began, notes = time.perf_counter(), Notes()
    head = (folder / "train.csv").read_text().splitlines()[0].split(",")
    train = folder / "train.csv"
    options: dict[str, Any] = {"inputs": head[:nu], "outputs": head[nu:], "start": start}
    data = lfrtorch.load_records(train, fs=fs, test=0, **options)
    settings = lfrtorch.Settings(nx="auto", nz="auto", nw="auto", nn="auto")
    run = lfrtorch.identify(data, settings, observer=notes)
    table = np.loadtxt(folder / "test.csv", delimiter=",", skiprows=1, ndmin=2)
    u, y = table[:, :nu], table[:, nu:]
    test = lfrtorch.Record(
        u, y, fs=fs, start="estimated", skip=SKIP,
        inputs=run.model.inputs, outputs=run.model.outputs,
    )  # fmt: skip

    def error(y_hat: Array) -> float:
        return float(np.sqrt(np.mean(((y - y_hat)[SKIP:] / y.std(axis=0)) ** 2)))

    with np.errstate(over="ignore", invalid="ignore"):
        linear, own = (error(model.simulate(test)) for model in (run.linear, run.model))
    refused = re.findall(r"note: (\d+) of \d+ candidates", "\n".join(notes.said))
    assert run.memory is not None
    return [
        folder.name, start, data.train[0].start, linear, own,
        own if run.verdict.use == NL_LFR else linear, run.verdict.kind.value, run.memory.apart,
        run.memory.linear, int(refused[0]) if refused else 0, time.perf_counter() - began,
    ]  # fmt: skip


def main() -> None:
    """Print a table, a line for each system and start."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("root", type=Path)
    parser.add_argument("--start", nargs="+", default=["auto"])
    parser.add_argument("--only", nargs="+", default=list(SYSTEMS), choices=SYSTEMS)
    given = parser.parse_args()
    torch.set_num_threads(1)
    rows = [
        row(given.root / name, *SYSTEMS[name], start)
        for start in given.start
        for name in given.only
    ]
    head = ["system", "asked", "start", "linear", "NL-LFR", "recommended", "verdict", "apart"]
    print(tables.table([*head, "linear's", "refused", "s"], rows))


if __name__ == "__main__":
    main()
