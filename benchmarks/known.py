"""What it brings to know a part of the system: tables of known.md.

    python benchmarks/known.py boucwen [--realisations 3]
    python benchmarks/known.py tanks --root DIR
    python benchmarks/known.py emps --root DIR
    python benchmarks/known.py speed

boucwen: the error against the number of samples, with mass, spring and damper known, and with
nothing known. Simulated, with the benchmark's noise; the error is that of another realisation's
noise-free multisine. tanks and emps: how the settings of the boards were chosen, on estimation
records alone: each eighth (half) is left out once. speed: an iteration with a known model, in
machine code and in torch, beside one with a network alone.
"""

from __future__ import annotations

import argparse
import copy
import statistics
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tanks import left_out_of

import lfrtorch
from lfrtorch import Known, LevenbergMarquardt, Record, Settings
from lfrtorch.datasets import boucwen, cascaded_tanks, emps
from lfrtorch.fitting.folds import as_folded, folds
from lfrtorch.fitting.known_start import known_model, with_learned
from lfrtorch.known_systems import cascaded_tanks as tanks_model
from lfrtorch.known_systems import emps as emps_model

SAMPLES = (256, 512, 1024, 2048, 4096)
TANKS = (
    ("softplus", 0, 0.0), ("softplus", 8, 10.0), ("softplus", 8, 100.0), ("softplus", 8, 1000.0),
    ("tanh", 8, 10.0), ("tanh", 8, 100.0), ("softplus", 15, 30.0), ("softplus", 15, 300.0),
)  # fmt: skip
EMPS = (
    (0, None, 0.0), (4, None, 10.0), (15, None, 10.0), (0, 3000, 0.0), (4, 3000, 1.0),
    (4, 3000, 10.0), (4, 3000, 100.0),
)  # fmt: skip
"""Neurons, samples of a window, and ridges."""


def main() -> int:
    """One table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("table", choices=["boucwen", "tanks", "emps", "speed"])
    parser.add_argument("--root", type=Path)
    parser.add_argument("--realisations", type=int, default=3)
    options = parser.parse_args()
    if options.table in ("tanks", "emps") and options.root is None:
        parser.error("--root: the folder of the benchmarks' files")
    match options.table:
        case "boucwen":
            learning_curves(options.realisations)
        case "tanks":
            tanks(options.root)
        case "emps":
            axis(options.root)
        case _:
            speed()
    return 0


def identified(train: list[Record], **settings: Any) -> lfrtorch.Run:
    """A fit without a word, to training records alone."""
    dataset = lfrtorch.Dataset("known", train, [], [])
    return lfrtorch.identify(dataset, Settings(**settings), observer=lfrtorch.Observer())


def oscillator() -> Known:
    """The linear part of the Bouc-Wen benchmark; its hysteresis is another force on the mass."""

    def rates(x, u, p):
        return x.speed, (u[0] - 10.0 * x.speed - 5e4 * x.position) / 2.0

    return Known(
        rates,
        states=["position", "speed"],
        outputs=lambda x, u, p: (x.position,),
        sees=["speed"],
        intersample="bl",
    )


def learning_curves(realisations: int) -> None:
    """Error against samples, Bouc-Wen."""
    usual: dict[str, Any] = {
        "nn": 15, "nz": 2, "ridge": 1e-3, "starts": 8, "trainer": LevenbergMarquardt(max_iter=150),
    }  # fmt: skip
    print(
        "| samples | nothing known, m | mass, spring, damper known, m | ratio |\n"
        + "|---" * 4
        + "|"
    )
    for samples in SAMPLES:
        errors: list[list[float]] = []
        for seed in range(realisations):
            noisy, clean = boucwen.load(seed=seed), boucwen.load(seed=seed, noise_rms=0.0)
            (whole,), (judged,) = noisy.train, clean.validation
            part = replace(whole[:samples], start="estimated", skip=0, period=None)
            own = [{"nx": 3, "nw": 1}, {"nx": 1, "nw": 2, "known": oscillator()}]
            runs = [identified([part], **usual, **each) for each in own]
            errors.append([lfrtorch.rmse(judged, run.model.simulate(judged)) for run in runs])
        black, known = np.median(np.nan_to_num(errors, nan=np.inf), axis=0)
        print(f"| {samples} | {black:.3g} | {known:.3g} | {known / black:.2f} |", flush=True)


def tanks(root: Path) -> None:
    """Cross-validation of the known tanks."""
    (whole,) = cascaded_tanks.load(root=root, validation=0).train
    print("| activation | neurons | ridge | error over the eighths, V |\n" + "|---" * 4 + "|")
    for activation, nn, ridge in TANKS:
        squares = []
        for part in folds(as_folded(whole), 8):
            settings: dict[str, Any] = {"nn": nn, "nz": 3, "nw": 2, "activation": activation}
            settings |= {"ridge": ridge, "starts": 6, "trainer": LevenbergMarquardt(max_iter=80)}
            run = identified(part.train, known=tanks_model(), **settings)
            judged = left_out_of(whole, part)
            squares.append(lfrtorch.rmse(judged, run.model.simulate(judged)) ** 2)
        error = np.sqrt(np.mean(squares))
        print(f"| {activation} | {nn} | {ridge:g} | {error:.3f} |", flush=True)


def axis(root: Path) -> None:
    """Halves of the EMPS record, each simulated from a start that its first 20 samples tell."""
    (whole,) = emps.load(root=root).train
    half = len(whole.u) // 2
    halves = whole[:half], whole[half : 2 * half]
    print("| neurons | window | ridge | other half, mm | training, mm |\n" + "|---" * 5 + "|")
    for nn, window, ridge in EMPS:
        found, fitted = [], []
        for train, other in (halves, halves[::-1]):
            settings: dict[str, Any] = {"nn": nn, "nz": 1, "nw": 1, "ridge": ridge, "starts": 3}
            settings |= {"horizon": window, "trainer": LevenbergMarquardt(max_iter=60)}
            run = identified([train], known=emps_model(), **settings)
            judged = replace(other, start="estimated", skip=20)
            found.append(1e3 * lfrtorch.rmse(judged, run.model.simulate(judged)))
            fitted.append(1e3 * run.fit.history[run.fit.chosen_iteration].train)
        cells = [", ".join(f"{error:.2f}" for error in errors) for errors in (found, fitted)]
        print(f"| {nn} | {window or 'none'} | {ridge:g} | {cells[0]} | {cells[1]} |", flush=True)


def speed() -> None:
    """Time of an iteration, one thread, medians of five."""
    torch.set_num_threads(1)
    rng = np.random.default_rng(0)
    u = 3.0 + 2.0 * np.repeat(rng.random(128), 8)
    known = tanks_model()
    record = Record(u, np.zeros(1024), fs=0.25)
    linear = lfrtorch.estimate_bla(replace(record, y=np.convolve(u, [0, 0.5])[:1024, None]), nx=2)
    sizes = Settings(known=known, nx=0, nz=3, nw=2, nn=8)
    grey = known_model(known, linear, [record])
    both = with_learned(grey, [record], sizes, seed=0)
    network = lfrtorch.initialise(linear, record, nz=3, nw=2, nn=8)
    measured = {}
    for name, model in (("network alone", network), ("known and network", both), ("known", grey)):
        measured[name] = iteration(model, record)
    both.lfr.to(dtype=torch.float32)
    measured["known and network, in float32"] = iteration(both, record)
    print("| static map | ms an iteration | times the network's |\n" + "|---" * 3 + "|")
    for name, seconds in measured.items():
        print(f"| {name} | {1e3 * seconds:.3g} | {seconds / measured['network alone']:.2f} |")


def iteration(model: lfrtorch.Model, record: Record) -> float:
    """Seconds of an iteration; ten from the same start, the compilation before."""
    seconds = []
    for repetition in range(6):
        own = replace(model, lfr=copy.deepcopy(model.lfr))
        y = own.simulate(record) + np.random.default_rng(0).standard_normal((1024, 1))
        trainer = LevenbergMarquardt(max_iter=1 if not repetition else 10)
        before = time.perf_counter()
        result = lfrtorch.fit(own, replace(record, y=y), trainer=trainer, monitors=[])
        seconds.append((time.perf_counter() - before) / max(1, len(result.history) - 1))
    return statistics.median(seconds[1:])


if __name__ == "__main__":
    raise SystemExit(main())
