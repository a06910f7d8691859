"""Eight measurements as a newcomer would give them: one command each, and what it is worth.

    python benchmarks/first_try.py [CASE ...] [--root DIR]  # runs, beside the grid and the verdicts
    python benchmarks/first_try.py [CASE ...] --grid [--minutes M]  # the grid -> first_try.json

Each case is a CSV file and the command ``lfrtorch fit data=file ... nx=auto nz=auto nw=auto
nn=auto``, whose default is to train on the first 60 %, to choose on the next 20 % and to score the
last 20 %. The records are estimation data alone: no official test record is read.

The grid: every nx of 1 .. 12, nz and nw of 1 .. 3, and 5, 15 and 30 neurons, from three seeds, with
the same parts. Its models are fitted in a random order that is fixed, so that one which is not at
its end is a fair sample of the whole; a later call goes on.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import loadmat

import lfrtorch
from lfrtorch._support import tables
from lfrtorch._support.atomic import whole_file
from lfrtorch._support.types import Array

RESULTS = Path(__file__).with_name("first_try.json")

NX, NZ, NW, NN, SEEDS = range(1, 13), (1, 2, 3), (1, 2, 3), (5, 15, 30), (0, 1000, 2000)
"""The grid."""

ITERATIONS = 60
"""Of each fit of the grid."""

WITHIN = 1.10
"""What is chosen may have this error over that of the best of the grid."""

MINUTES = 10.0
"""A case may take on two cores."""


@dataclass(frozen=True)
class Signals:
    """A measurement, as it stands in a file."""

    u: Array
    y: Array
    fs: float


@dataclass(frozen=True)
class Case:
    """A measurement and what is expected of it.

    Args:
        measure: the files' signals by name; ``root`` is the folder of the benchmarks' files.
        start: how the records begin.
        expected: kind of the verdict, written before the first run.
        limit: minutes that it may take.
    """

    measure: Callable[[Path], dict[str, Signals]]
    start: str
    expected: str
    limit: float = MINUTES


def tanks(root: Path) -> dict[str, Signals]:
    """The whole estimation record of the cascaded tanks, whose levels begin anywhere."""
    return _signals(lfrtorch.datasets.cascaded_tanks.load(root=root).train[0])


def silverbox(root: Path) -> dict[str, Signals]:
    """6000 samples amid the first multisine realisations."""
    record = lfrtorch.datasets.silverbox.load(root=root).train[0]
    return _signals(record[2000:8000])


def wiener_hammerstein(root: Path) -> dict[str, Signals]:
    """6000 samples amid the estimation record."""
    record = lfrtorch.datasets.wiener_hammerstein.load(root=root).train[0]
    return _signals(record[20000:26000])


def emps(root: Path) -> dict[str, Signals]:
    """The estimation record of the positioning system, every fourth sample."""
    file = loadmat(root / "EMPS/DATA_EMPS.mat")
    step = float(np.median(np.diff(file["t"].ravel())))
    u, y = file["vir"][::4] * file["gtau"], file["qm"][::4]
    return {"emps": Signals(u, y, round(1.0 / step / 4.0, 6))}


def f16(root: Path) -> dict[str, Signals]:
    """Three periods at the third level of the aircraft, from rest."""
    file = loadmat(root / "F16/F16GVT_Files/BenchmarkData/F16Data_FullMSine_Level3.mat")
    return {"f16": Signals(file["Force"].T[:24576], file["Acceleration"].T[:24576], 400.0)}


def ced(root: Path) -> dict[str, Signals]:
    """The estimation parts of the coupled drives' uniform records, both levels."""
    found = lfrtorch.datasets.ced.load(root=root).validation
    return {name: signals for record in found for name, signals in _signals(record).items()}


def cart(root: Path) -> dict[str, Signals]:
    """A simulated axis: force -> position, with friction, in a position loop that is closed.

    m dv/dt = F - c v - Fc tanh(v / vs), dx/dt = v, F = Kp (r - x) - Kd v, at 1 kHz, kept at 100 Hz;
    the noise of the position, 20 µm rms, is that of the record alone.
    """
    del root
    rng, fs, steps, T = np.random.default_rng(5), 100.0, 10, 4000
    target = np.repeat(rng.uniform(-0.1, 0.1, T // 100), 100)
    smooth = np.convolve(np.r_[np.zeros(59), target], np.ones(60) / 60, "valid")
    mass, viscous, coulomb, slip, dt = 2.0, 4.0, 3.0, 5e-3, 1.0 / fs / steps
    x = v = 0.0
    u, y = np.zeros((T, 1)), np.zeros((T, 1))
    for k in range(T):
        force = 400.0 * (smooth[k] - x) - 30.0 * v
        u[k], y[k] = force, x
        for _ in range(steps):
            v += dt * (force - viscous * v - coulomb * np.tanh(v / slip)) / mass
            x += dt * v
    return {"cart": Signals(u, y + 20e-6 * rng.standard_normal(y.shape), fs)}


def linear(root: Path) -> dict[str, Signals]:
    """A linear system of two resonances, with white noise of 5 % at its output."""
    del root
    rng, T = np.random.default_rng(7), 3000
    u = rng.standard_normal((T, 1))
    poles = np.array([0.9 * np.exp(0.4j), 0.85 * np.exp(1.1j)])
    state, y = np.zeros(2, complex), np.zeros((T, 1))
    for k in range(T):
        y[k] = np.real(state @ np.array([1.0 + 0.3j, 0.5 - 0.4j]))
        state = poles * state + u[k]
    return {"linear": Signals(u, y + 0.05 * y.std() * rng.standard_normal(y.shape), 100.0)}


CASES = {
    "tanks": Case(tanks, "estimated", "better"),
    "silverbox": Case(silverbox, "estimated", "better"),
    "wiener_hammerstein": Case(wiener_hammerstein, "estimated", "better"),
    "emps": Case(emps, "zero", "better"),
    "f16": Case(f16, "zero", "better", limit=60.0),
    "ced": Case(ced, "estimated", "better"),
    "cart": Case(cart, "zero", "better"),
    "linear": Case(linear, "zero", "linear"),
}


def main() -> int:
    """Run the cases, or the grid."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("cases", nargs="*", metavar="CASE", help=", ".join(CASES))
    parser.add_argument("--root", type=Path, help="folder of the benchmarks' files")
    parser.add_argument("--out", type=Path, help="folder of the runs; default: one that is removed")
    parser.add_argument("--grid", action="store_true", help="fit the grid, and keep its errors")
    parser.add_argument("--results", type=Path, default=RESULTS, help="where they are kept")
    parser.add_argument("--minutes", type=float, default=np.inf, help="of the grid, for each case")
    options = parser.parse_args()
    if unknown := set(options.cases) - set(CASES):
        parser.error(f"no case {', '.join(sorted(unknown))}; there are {', '.join(CASES)}")
    shared = Path(__file__).resolve().parents[2] / "shared" / "data" / "nonlinear_benchmarks"
    root = options.root or Path(os.environ.get("LFRTORCH_DATA", shared))
    names = [name for name in options.cases or CASES if at_hand(name, root)]
    with tempfile.TemporaryDirectory() as temporary:
        out = options.out or Path(temporary)
        if options.grid:
            for name in names:
                grid(name, root, out, options.results, 60.0 * options.minutes)
            return 0
        tried = []
        for name in names:
            tried.append(attempt(name, root, out, options.results))
            print(", ".join(f"{key} {value}" for key, value in tried[-1].items()), flush=True)
    if not tried:
        return 0
    print(tables.table(list(tried[0]), [list(row.values()) for row in tried]))
    return int(any(row["found wrong"] for row in tried))


def at_hand(name: str, root: Path) -> bool:
    """Whether there are the files of a case; says so if not."""
    try:
        CASES[name].measure(root)
    except FileNotFoundError as missing:
        print(f"{name} is left out: {missing}", file=sys.stderr)
        return False
    return True


def attempt(name: str, root: Path, out: Path, results: Path) -> dict[str, Any]:
    """One command, its time, and its errors beside the best of the grid."""
    case, folder = CASES[name], out / name
    command = [sys.executable, "-m", "lfrtorch.cli", "fit", *words(name, root, out)]
    command += [f"{size}=auto" for size in ("nx", "nz", "nw", "nn")]
    begin = time.perf_counter()
    done = subprocess.run(
        [*command, f"hydra.run.dir={folder}"], capture_output=True, text=True, check=False
    )
    minutes = (time.perf_counter() - begin) / 60.0
    (out / f"{name}.log").write_text(done.stdout + done.stderr)
    if done.returncode:
        raise RuntimeError(f"{name} failed:\n{done.stdout}{done.stderr}")
    metrics = json.loads((folder / "metrics.json").read_text())
    verdict = metrics["verdict"]
    scores = metrics["scores"].values()
    linear = verdict["use"] == "linear model"  # which is then chosen, and said
    which = "lti_rmse" if linear else "rmse"
    error = float(np.sqrt(np.mean([score[which] ** 2 for score in scores])))
    fitted = _kept(results).get(name, [])
    best = min((entry["error"] for entry in fitted), default=np.nan)
    wrong = []
    if verdict["kind"] != case.expected:
        wrong.append(f"expected {case.expected}")
    if not linear and error > WITHIN * best:
        wrong.append(f"over {WITHIN:g} of the grid")
    if minutes > case.limit:
        wrong.append(f"over {case.limit:g} min")
    sizes = " ".join(f"{key}={value}" for key, value in metrics["sizes"].items())
    return {
        "case": name,
        "minutes": minutes,
        "sizes": sizes,
        "verdict": verdict["kind"],
        "use": verdict["use"],
        "error": error,
        "grid": best,
        "of": len(fitted),
        "ratio": error / best,
        "found wrong": ", ".join(wrong),
    }


def words(name: str, root: Path, out: Path) -> list[str]:
    """The settings of a case's data, whose files are written below ``out``."""
    case, folder = CASES[name], out / f"{name}_data"
    folder.mkdir(parents=True, exist_ok=True)
    measured = case.measure(root)
    signals = next(iter(measured.values()))
    nu, ny = signals.u.shape[1], signals.y.shape[1]
    for record, signals in measured.items():
        head = [f"u{i}" for i in range(nu)] + [f"y{i}" for i in range(ny)]
        table = np.hstack([signals.u, signals.y])
        np.savetxt(folder / f"{record}.csv", table, "%.9g", ",", header=",".join(head), comments="")
    inputs, outputs = (
        f"[{','.join(f'{letter}{i}' for i in range(count))}]"
        for letter, count in (("u", nu), ("y", ny))
    )
    return [
        "data=file",
        f"data.path='{folder}/*.csv'",
        f"data.inputs={inputs}",
        f"data.outputs={outputs}",
        f"data.fs={signals.fs:g}",
        f"data.start={case.start}",
    ]


def grid(name: str, root: Path, out: Path, results: Path, seconds: float) -> None:
    """Fit the models of the grid that are not yet kept, and keep their errors on the last part."""
    case = CASES[name]
    words(name, root, out)
    measured = case.measure(root)
    signals = next(iter(measured.values()))
    nu, ny = signals.u.shape[1], signals.y.shape[1]
    data = lfrtorch.load_records(
        f"{out / f'{name}_data'}/*.csv",
        inputs=list(range(nu)),
        outputs=list(range(nu, nu + ny)),
        fs=float(f"{signals.fs:g}"),
        start=case.start,  # pyright: ignore[reportArgumentType]
    )

    @cache
    def bla(nx: int) -> lfrtorch.LinearModel:
        return lfrtorch.estimate_bla(data.train, nx=nx)

    candidates = list(itertools.product(NX, NZ, NW, NN, SEEDS))
    np.random.default_rng(0).shuffle(candidates)
    begin = time.perf_counter()
    kept = {_key(entry) for entry in _kept(results).get(name, [])}
    for each in candidates:
        nx, nz, nw, nn, seed = (int(size) for size in each)
        if (nx, nz, nw, nn, seed) in kept:
            continue
        if time.perf_counter() - begin > seconds:
            break
        clock = time.perf_counter()
        try:
            linear = bla(nx)
            model = lfrtorch.initialise(linear, data.train, nz=nz, nw=nw, nn=nn, seed=seed)
            trainer = lfrtorch.LevenbergMarquardt(max_iter=ITERATIONS)
            found = lfrtorch.fit([model], data.train, data.validation, trainer=trainer)
            error = pooled(data.tests, found.model.simulate)
            lti = pooled(data.tests, linear.simulate)
        except ValueError as failure:
            print(f"{name} {each}: {failure}", file=sys.stderr)
            error, lti = np.inf, np.inf
        entry = {
            **{"nx": nx, "nz": nz, "nw": nw, "nn": nn, "seed": seed},
            **{"error": error, "linear": lti, "seconds": time.perf_counter() - clock},
        }
        # Another process may have kept another case's errors since.
        with whole_file(results) as path:
            entries = _kept(results)
            entries.setdefault(name, []).append(entry)
            path.write_text(_lines(entries))


def pooled(records: Sequence[lfrtorch.Record], simulate: Callable[..., Array]) -> float:
    """Root mean square of the records' errors; infinite for a simulation that diverges."""
    errors = [lfrtorch.rmse(record, simulate(record)) for record in records]
    total = float(np.sqrt(np.mean(np.square(errors))))
    return total if np.isfinite(total) else float("inf")


def _signals(record: lfrtorch.Record) -> dict[str, Signals]:
    return {record.name: Signals(record.u, record.y, record.fs)}


def _key(entry: dict[str, Any]) -> tuple[int, ...]:
    return tuple(entry[name] for name in ("nx", "nz", "nw", "nn", "seed"))


def _kept(results: Path) -> dict[str, list[dict[str, Any]]]:
    return json.loads(results.read_text()) if results.exists() else {}


def _lines(entries: dict[str, list[dict[str, Any]]]) -> str:
    """JSON with a line for each model."""
    parts = [
        f'"{name}": [\n' + ",\n".join(json.dumps(entry) for entry in fitted) + "\n]"
        for name, fitted in entries.items()
    ]
    return "{\n" + ",\n".join(parts) + "\n}\n"


if __name__ == "__main__":
    sys.exit(main())
