"""Does a fit find the dead time of planted systems, and are its standard errors right?

    python benchmarks/dead_time.py [--systems 20] [--first 0]
    python benchmarks/dead_time.py --measured DIR

Planted systems have one to three lags, some with a zero, behind a static nonlinearity, before one,
or in feedback with one, and a dead time of 0.3 to 40 samples. A generator holds each value of the
input; the system itself is simulated in continuous time, 8 Runge-Kutta steps a sample and one at
each step of the delayed input. The output has noise at 20 dB. Each system is identified by
``nx="auto", delay="auto"``. ``nx at once`` is the order that is chosen for the same system without
its dead time, and ``without`` that for the system itself without a delay, 12 at most.

``--measured`` compares fits with and without a delay on the heater and the heat exchanger of a
folder as ``benchmarks/wild.py`` takes it, order by order. Errors are relative to the deviation of
the test, whose first 50 samples tell the start.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

import lfrtorch
from benchmarks.wild import SKIP, SYSTEMS
from lfrtorch._support import tables
from lfrtorch._support.types import Array
from lfrtorch.files.split import cut

SAMPLES, STEPS, NOISE = 3000, 8, 0.1
"""Samples of a record, Runge-Kutta steps in each, and the rms of the noise over the output's."""


@dataclass(frozen=True)
class Plant:
    """A chain of lags with a saturation, and a dead time; times are in samples."""

    kind: str
    lags: tuple[float, ...]
    lead: float
    delay: float

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> Plant:
        """A random plant."""
        order = int(rng.integers(1, 4))
        delay = float(np.exp(rng.uniform(np.log(0.3), np.log(40.0))))
        kind = str(rng.choice(["wiener", "hammerstein", "feedback"]))
        slowest = rng.uniform(3.0, 20.0)
        lags = (slowest, *(slowest * rng.uniform(0.1, 0.6) for _ in range(order - 1)))
        lead = rng.uniform(0.0, 0.8) * lags[-1] if order > 1 and rng.random() < 0.5 else 0.0
        return cls(kind, lags, lead, delay)

    def slope(self, x: Array, v: float) -> Array:
        """Derivative of the states under an input."""
        v = float(np.tanh(1.2 * v)) if self.kind == "hammerstein" else v
        v -= 0.8 * x[0] ** 3 if self.kind == "feedback" else 0.0
        return (np.array([v, *x[:-1]]) - x) / np.array(self.lags)

    def output(self, x: Array, v: float) -> float:
        """The output."""
        y = x[-1] + self.lead * self.slope(x, v)[-1]
        return float(np.tanh(1.2 * y)) if self.kind == "wiener" else float(y)

    def simulate(self, u: Array) -> Array:
        """Output at the samples, from rest; each input is held until the next one."""
        whole, x, y = int(np.floor(self.delay)), np.zeros(len(self.lags)), np.zeros(len(u))
        after = self.delay - whole  # the delayed input steps so long after a sample
        late = np.concatenate([np.zeros(whole + 1), u])
        for k in range(len(u)):
            before, now = late[k], late[k + 1]
            y[k] = self.output(x, before)
            x = self._advanced(self._advanced(x, before, after), now, 1.0 - after)
        return y

    def _advanced(self, x: Array, v: float, length: float) -> Array:
        count = max(1, round(STEPS * length))
        h = length / count
        for _ in range(count):
            a = self.slope(x, v)
            b = self.slope(x + h / 2 * a, v)
            c = self.slope(x + h / 2 * b, v)
            x = x + h / 6 * (a + 2 * b + 2 * c + self.slope(x + h * c, v))
        return x


def planted(number: int) -> list[tables.Cell]:
    """Identify a planted system: true and found dead time, and the orders."""
    began, rng = time.perf_counter(), np.random.default_rng(number)
    plant, hold = Plant.drawn(rng), int(rng.integers(1, 6))
    u = np.repeat(rng.uniform(-1.0, 1.0, SAMPLES // hold + 1), hold)[:SAMPLES]
    noise = NOISE * rng.standard_normal(SAMPLES)
    parts, at_once = (
        _parts(u, y + y.std() * noise)
        for y in (plant.simulate(u), replace(plant, delay=0.0).simulate(u))
    )
    orders = [
        lfrtorch.scan_orders(own["train"], validation=own["validation"]).chosen
        for own in (at_once, parts)
    ]
    data = lfrtorch.Dataset("planted", [parts["train"]], [parts["validation"]])
    settings = lfrtorch.Settings(nx="auto", nz=1, nn=8, delay="auto")
    run = lfrtorch.identify(data, settings, observer=lfrtorch.Observer())
    found = run.dead_times[0] if run.dead_times else None
    print(f"dead time of {found}, delay {run.model.delay[0]}")
    samples, std = (found.samples, found.std) if found else (0.0, float("nan"))
    return [
        number, plant.kind, len(plant.lags), plant.delay, samples, std,
        (samples - plant.delay) / std, run.model.sizes["nx"], *orders,
        time.perf_counter() - began,
    ]  # fmt: skip


def _parts(u: Array, y: Array) -> dict[str, lfrtorch.Record]:
    return cut(lfrtorch.Record(u, y, skip=150), 0.25, 0.0)


def measured(root: Path, name: str, nx: int, delay: float | str) -> list[tables.Cell]:
    """Error on the test of a measured system, by a fit with a number of states."""
    nu, fs = SYSTEMS[name]
    head = (root / name / "train.csv").read_text().splitlines()[0].split(",")
    data = lfrtorch.load_records(
        root / name / "train.csv", fs=fs, test=0, inputs=head[:nu], outputs=head[nu:]
    )
    settings = lfrtorch.Settings(nx=nx, nz=1, nn=8, delay=delay)  # type: ignore[arg-type]
    run = lfrtorch.identify(data, settings, observer=lfrtorch.Observer())
    table = np.loadtxt(root / name / "test.csv", delimiter=",", skiprows=1, ndmin=2)
    u, y = table[:, :nu], table[:, nu:]
    test = lfrtorch.Record(u, y, fs=fs, start="estimated", skip=SKIP)

    def error(y_hat: Array) -> float:
        return float(np.sqrt(np.mean(((y - y_hat)[SKIP:] / y.std(axis=0)) ** 2)))

    found = "; ".join(map(str, run.dead_times)) or "none"
    each = (error(model.simulate(test)) for model in (run.linear, run.model))
    return [name, str(delay), nx, *each, found]


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--systems", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--measured", type=Path)
    given = parser.parse_args()
    torch.set_num_threads(1)
    if given.measured is not None:
        rows = [
            measured(given.measured, name, nx, delay)
            for name in ("heating", "exchanger")
            for nx in (1, 2, 3, 4)
            for delay in (0, "auto")
        ]
        head = ["system", "delay", "nx", "linear", "NL-LFR", "dead time"]
        print(tables.table(head, rows))
        return
    rows = []
    for number in range(given.first, given.first + given.systems):
        rows.append(planted(number))
        print(rows[-1], flush=True)
    head = ["system", "kind", "lags", "dead time", "found", "std", "apart / std", "nx"]
    head += ["nx at once", "without", "s"]
    print(tables.table(head, rows))
    apart = np.abs([float(str(row[6])) for row in rows])
    raised = sum(int(str(row[7])) > int(str(row[8])) for row in rows)
    print(f"within two standard errors: {(apart <= 2).sum()} of {len(rows)}")
    print(f"order above that without a dead time: {raised} of {len(rows)}")


if __name__ == "__main__":
    main()
