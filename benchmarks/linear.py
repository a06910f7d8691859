"""Linear models: errors on benchmarks, and beside freq-statespace on the same data and weights.

    python benchmarks/linear.py [--root DIR] [--peers DIR] [--quick]

DIR of --root holds the files of nonlinear_benchmarks, that of --peers an environment ``venv`` with
freq-statespace. Prints tables in Markdown. Everything runs on one core.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import torch

import lfrtorch
from lfrtorch import Record
from lfrtorch._support.types import Array, Complex
from lfrtorch.datasets import boucwen, parwh, silverbox, wiener_hammerstein
from lfrtorch.linear.resolvent import frequency_response

HERE = Path(__file__).resolve().parent


def main() -> int:
    """All tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--root", type=Path, default=None)
    parser.add_argument("--peers", type=Path, default=None)
    parser.add_argument("--quick", action="store_true", help="fewer seeds and realisations")
    parser.add_argument("--only-peers", action="store_true", help="the last table alone")
    options = parser.parse_args()
    torch.set_num_threads(1)
    if not options.only_peers:
        levels(seeds=1 if options.quick else 3, realisations=20 if options.quick else 100)
        hysteresis(options.root, seeds=3 if options.quick else 20)
        measured(options.root)
    beside(options.peers, realisations=20 if options.quick else 100)
    return 0


def rmse(record: Record, model: lfrtorch.LinearModel) -> float:
    """Simulation RMSE after the skip, output unit."""
    return lfrtorch.rmse(record, model.simulate(record))


def levels(seeds: int, realisations: int) -> None:
    """A model a level of the parallel Wiener-Hammerstein stand-in, against the best possible."""
    head("Parallel Wiener-Hammerstein stand-in, nx 12, a model a level, test multisines (mV)")
    row("seed", "", *[f"{level} mV" for level in parwh.LEVELS], "arrow", "seconds")
    rule(9)
    lines = np.arange(1, 4096)
    responses = {}
    for level in parwh.LEVELS:
        total = np.zeros(len(lines), dtype=complex)
        for i in range(realisations):
            u = parwh.multisine(rms=level / 1000, seed=10_000 + i)
            total = total + np.fft.rfft(parwh.simulate(u))[lines] / np.fft.rfft(u)[lines]
        responses[level] = total / realisations
    for seed in range(seeds):
        data = parwh.load(source="stand-in", seed=seed)
        floors, found, seconds, ratios = [], [], [], []
        for i, level in enumerate(parwh.LEVELS):
            test = data.tests[i]
            U, E = np.fft.rfft(test.u[:, 0]), np.fft.rfft(test.y[:, 0])
            E[lines] -= responses[level] * U[lines]
            E[0] = 0.0
            floors.append(np.fft.irfft(E, len(test.u)).std())
            begin = time.perf_counter()
            model = lfrtorch.estimate_bla(data.train[i], 12)
            seconds.append(time.perf_counter() - begin)
            found.append(rmse(test, model))
            ratios.append(found[-1] / floors[-1])
            if level == parwh.LEVELS[-1]:
                found.append(rmse(data.tests[-1], model))
        row(seed, f"nonparametric, {realisations} realisations", *millis(floors), "", "")
        row(seed, "estimate_bla, one realisation", *millis(found), f"{np.mean(seconds):.2f}")
        row(seed, "ratio", *[f"{r:.3f}" for r in ratios], "", "")
    print("\nThe arrow is simulated by the model of the highest level.")


def hysteresis(root: Path | None, seeds: int) -> None:
    """The Bouc-Wen tests from many noise and input realisations."""
    head(f"Bouc-Wen, nx 3, {seeds} seeds of the estimation data, official noise (m)")
    row("test", "source", "median", "best", "worst", "seconds")
    rule(6)
    found: dict[tuple[str, str], list[float]] = {}
    seconds = []
    for seed in range(seeds):
        data = boucwen.load(seed=seed, root=root)
        begin = time.perf_counter()
        model = lfrtorch.estimate_bla(data.train, 3, offset=False)
        seconds.append(time.perf_counter() - begin)
        for test in data.tests:
            found.setdefault((test.name, test.source), []).append(rmse(test, model))
    for (name, source), values in found.items():
        figures = [f"{v:.3g}" for v in (np.median(values), min(values), max(values))]
        row(name, source, *figures, f"{np.median(seconds):.2f}")


def measured(root: Path | None) -> None:
    """The linear models of measured benchmarks."""
    head("Measured benchmarks, official tests, simulation RMSE with offset (mV)")
    row("benchmark", "nx", "error", "tests", "seconds")
    rule(5)
    loads: list[tuple[Callable[..., lfrtorch.Dataset], int]] = [
        (wiener_hammerstein.load, 6),
        (silverbox.load, 2),
    ]
    for load, nx in loads:
        try:
            data = load(root=root)
        except FileNotFoundError as error:
            print(f"| {load.__module__.rpartition('.')[2]} | {error} |")
            continue
        for refine in ("simulation", "prediction", "frequency"):
            begin = time.perf_counter()
            model = lfrtorch.estimate_bla(data.train, nx, refine=refine)
            seconds = time.perf_counter() - begin
            tests = ", ".join(f"{t.name} {1e3 * rmse(t, model):.2f}" for t in data.tests)
            row(data.name, nx, refine, tests, f"{seconds:.2f}")


def beside(folder: Path | None, realisations: int) -> None:
    """freq-statespace on the same responses with the same weights."""
    head("Beside freq-statespace: same response, same weights, one core")
    python = folder and folder / "venv" / "bin" / "python"
    if python is None or not python.is_file():
        print("No freq-statespace: --peers DIR names a folder with its environment.")
        return
    row("data", "method", "weighted error", "error to the true BLA", "first call, s", "again, s")
    rule(6)
    for name, nx, records, truth in problems(realisations):
        frf = lfrtorch.estimate_frf(records)
        theirs = their_fit(python, records, frf, nx)
        variance = theirs.get("var_total")
        weight = np.ones(frf.G.shape) if variance is None else 1.0 / variance

        def errors(
            G: Complex, weight: Array = weight, frf: lfrtorch.FRF = frf, G0: Complex = truth
        ) -> tuple[str, str]:
            fit = np.sqrt(np.mean(weight * np.abs(G - frf.G) ** 2))
            if weight.min() == 1.0:
                fit /= np.sqrt(np.mean(np.abs(frf.G) ** 2))
            true = np.sqrt(np.sum(np.abs(G - G0) ** 2) / np.sum(np.abs(G0) ** 2))
            return f"{fit:.5f}", f"{100 * true:.4f} %"

        assert np.allclose(theirs["G_bla"], frf.G, rtol=1e-6), "not the same response"
        for solver in ("default", "converged"):
            if f"{solver}_G" not in theirs:
                continue
            label = f"freq-statespace, {solver}, {int(theirs[f'{solver}_iterations'])} iterations"
            turns = (theirs.get(f"{solver}_{turn}") for turn in ("first", "again"))
            seconds = ["" if turn is None else f"{turn:.2f}" for turn in turns]
            row(name, label, *errors(theirs[f"{solver}_G"]), *seconds)
        seconds, models = [], []
        for _ in range(4):
            begin = time.perf_counter()
            frf = lfrtorch.estimate_frf(records)
            models.append(lfrtorch.estimate_bla(frf, nx, weight=weight))
            seconds.append(time.perf_counter() - begin)
        model = models[-1]
        assert model.fit is not None
        label = f"lfrtorch, {model.fit.iterations} iterations"
        again = f"{np.median(seconds[1:]):.2f}"
        row(name, label, *errors(model.frf(frf.frequencies)), f"{seconds[0]:.2f}", again)


def their_fit(python: Path, records: list[Record], frf: lfrtorch.FRF, nx: int) -> dict:
    """What freq-statespace makes of the records."""
    N = records[0].period or records[0].samples
    lines = np.round(frf.frequencies * N / frf.fs).astype(int)
    arrays = {}
    for side in ("u", "y"):
        periods = [getattr(r, side).reshape(-1, N, getattr(r, side).shape[1]) for r in records]
        arrays[side] = np.stack(periods).transpose(2, 3, 0, 1)
    with tempfile.TemporaryDirectory() as place:
        given, found = Path(place) / "given.npz", Path(place) / "found.npz"
        np.savez(given, lines=lines, fs=frf.fs, nx=nx, once=nx == 12, **arrays)
        command = [str(python), str(HERE / "peer_bla.py"), str(given), str(found)]
        core = {min(os.sched_getaffinity(0))}  # on several cores it was seen to wait for ever
        done = subprocess.run(
            command,
            capture_output=True,
            text=True,
            check=False,
            preexec_fn=lambda: os.sched_setaffinity(0, core),
        )
        if done.returncode:
            sys.exit(f"freq-statespace failed: {done.stderr.strip().splitlines()[-1]}")
        with np.load(found) as file:
            return {key: file[key] for key in file.files}


def problems(realisations: int):
    """Name, order, records, and the true response of each comparison."""
    for R, P in ((1, 1), (8, 2)):
        records = [hysteretic(seed, P) for seed in range(R)]
        frf = lfrtorch.estimate_frf([hysteretic(10_000 + i, 1, 0.0) for i in range(realisations)])
        yield f"Bouc-Wen, R {R}, P {P}, nx 3", 3, records, frf.G
    for level in (100, 1000):
        stand_in = partial(parwh.load, source="stand-in", levels=(level,))
        records = stand_in(realisations=8, periods=2).train
        others = stand_in(seed=10_000, realisations=realisations, noise_rms=0.0).train
        truth = lfrtorch.estimate_frf(others).G
        yield f"parallel WH stand-in, {level} mV, R 8, P 2, nx 12", 12, records, truth
    yield two_by_two()


def hysteretic(seed: int, periods: int, noise_rms: float = 8e-6) -> Record:
    """Bouc-Wen in steady state under the official excitation."""
    rng = np.random.default_rng([seed, 1])
    u = boucwen.multisine(seed=rng)
    y = boucwen.simulate(np.tile(u, periods + 2), noise_rms=noise_rms, seed=rng)
    N = len(u) // 20
    y = y[N : (periods + 1) * N]
    return Record(np.tile(u[::20], periods), y, 750.0, "periodic", period=N)


def two_by_two():
    """A random system of order 6, two inputs and outputs, with noise and cubic distortion."""
    rng = np.random.default_rng(5)
    A = rng.normal(size=(6, 6))
    A *= 0.95 / np.abs(np.linalg.eigvals(A)).max()
    system = A, rng.normal(size=(6, 2)), rng.normal(size=(2, 6)), rng.normal(size=(2, 2))
    N, periods, fs = 4096, 2, 1000.0
    design = lfrtorch.multisine(N, fs=fs, band=(1.0, 400.0), nu=2, realisations=4, seed=6)
    z = np.exp(2j * np.pi * np.arange(N // 2 + 1) / N)
    G = frequency_response(*system, z)
    records = []
    for u in design.u:
        Y = (G @ np.fft.rfft(u, axis=0)[..., None])[..., 0]
        clean = np.fft.irfft(Y, N, axis=0)
        distorted = clean + 0.02 * (u**3 - 3 * u)  # of no linear part for a Gaussian input
        y = np.tile(distorted, (periods, 1))
        y = y + 0.01 * rng.normal(size=y.shape)
        records.append(Record(np.tile(u, (periods, 1)), y, fs, "periodic", period=N))
    return "2 x 2, cubic, R 8, P 2, nx 6", 6, records, G[design.lines]


def head(title: str) -> None:
    """A title."""
    print(f"\n### {title}\n", flush=True)


def row(*cells: object) -> None:
    """A line of a table."""
    print("| " + " | ".join(map(str, cells)) + " |", flush=True)


def rule(columns: int) -> None:
    """The line below a table's head."""
    print("|" + "---|" * columns)


def millis(values: list[float]) -> list[str]:
    """The values in thousandths."""
    return [f"{1e3 * v:.3f}" for v in values]


if __name__ == "__main__":
    sys.exit(main())
