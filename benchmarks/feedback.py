"""Data under feedback: the bias of fits of simulations, of predictions and from the reference.

    python benchmarks/feedback.py [--runs 100] [--decibels 20 10 5] [--only linear nonlinear]

A controller sets the input of a planted system, u = r - 0.6 y, in the same sample. The system is an
oscillator of two states without feedthrough (resonance at a twelfth of the rate, radius 0.8),
linear or with a spring that stiffens by z³. Its noise is innovations with the gain K. ``SNR`` is
the power of the output without noise, over that of what noise adds in the loop. Fits of

- simulation: the simulation error of the measured input, as if there were no feedback;
- direct: predictions one sample ahead (refine="prediction", noise="innovation");
- indirect: from the reference. Of the linear system the response that the reference tells. Of the
  nonlinear one in two stages: a model from r to u, whose simulation has no noise, then one from
  that to y. If r repeats, the mean over its periods (Record.mean_period) takes the model's place.

All know that there is no feedthrough. Records have 1024 scored samples: white noise, or 8 periods
of a multisine of 128 samples. Printed, in parts of the truth: the error of one run, the bias (the
mean of the errors over the runs) and the standard error of that, as rms over frequency (linear:
response at 60 frequencies) or time (nonlinear: simulated output for another input). A fit without
bias has a ratio of about 1 of the last two.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import torch

import lfrtorch
from lfrtorch._support.types import Array, Complex
from lfrtorch.data.metrics import rms
from lfrtorch.data.records import Scaler
from lfrtorch.fitting.plain_settings import Noise
from lfrtorch.linear.bla import Criterion

GAIN = 0.6
"""Of the controller."""

K = np.array([[0.4], [0.3]])
"""Of the innovations."""

PERIOD, PERIODS, SETTLING = 128, 8, 128
"""Samples of a period, how many are measured, and the samples before them."""

ANGLES = np.linspace(0.05, 3.0, 60)
"""Frequencies of the response, radians per sample."""

Fitted = lfrtorch.Model | lfrtorch.LinearModel


def system(*, nonlinear: bool) -> lfrtorch.Model:
    """The planted system."""
    static = lfrtorch.Polynomial(1, 1, 3, dtype=torch.float64)
    cell = lfrtorch.LFRCell(1, 1, 2, 1, 1, static, dtype=torch.float64, random=False)
    turn = 0.8 * np.array([[np.cos(0.5), np.sin(0.5)], [-np.sin(0.5), np.cos(0.5)]])
    with torch.no_grad():
        cell.A.copy_(torch.as_tensor(turn))
        cell.Bu.copy_(torch.tensor([[0.0], [0.4]]))
        cell.Bw.copy_(torch.tensor([[0.0], [-0.1 * nonlinear]]))
        cell.Cz.copy_(torch.tensor([[1.0, 0.0]]))
        cell.Cy.copy_(torch.tensor([[1.0, 0.0]]))
        static.C[0, 3] = 1.0
    zero, one = np.zeros(1), np.ones(1)
    channels = (lfrtorch.Channel("u"),), (lfrtorch.Channel("y"),)
    return lfrtorch.Model(lfrtorch.LFR(cell), Scaler(zero, one, zero, one), 1.0, *channels)


@torch.no_grad()
def closed_loop(model: lfrtorch.Model, r: Array, e: Array) -> tuple[Array, Array]:
    """Inputs and outputs of runs with references and innovations, all (runs, T)."""
    cell = model.lfr.cell
    references, innovations, gain = (torch.as_tensor(s) for s in (r, e, K))
    x, u, y = torch.zeros(len(r), 2, dtype=torch.float64), [], []
    for now, noise in zip(references.T[:, :, None], innovations.T[:, :, None], strict=True):
        y.append(x @ cell.Cy.mT + noise)
        u.append(now - GAIN * y[-1])
        x = cell(u[-1], x)[1] + noise @ gain.mT
    return torch.cat(u, dim=1).numpy(), torch.cat(y, dim=1).numpy()


def level_of(model: lfrtorch.Model, decibels: float) -> float:
    """Standard deviation of the innovations that gives a signal-to-noise ratio, to first order."""
    rng = np.random.default_rng(99)
    r, e = rng.standard_normal((2, 1, 5000))
    clean = closed_loop(model, r, 0 * e)[1]
    noise = closed_loop(model, r, 1e-3 * e)[1] - clean
    return 1e-3 * float(rms(clean) / rms(noise)) * 10 ** (-decibels / 20)


def measured(
    model: lfrtorch.Model, level: float, runs: int, seed: int, *, periodic: bool
) -> list[lfrtorch.Record]:
    """A record a run, with its reference."""
    rng = np.random.default_rng([0, seed])
    T = PERIOD * PERIODS
    if periodic:
        periods = [lfrtorch.multisine(PERIOD, seed=run).u[0, :, 0] for run in range(runs)]
        r = np.tile(np.array(periods), (1, PERIODS + SETTLING // PERIOD))
    else:
        r = rng.standard_normal((runs, T + SETTLING))
    u, y = closed_loop(model, r, level * rng.standard_normal(r.shape))
    if periodic:
        made = zip(u[:, SETTLING:], y[:, SETTLING:], r[:, SETTLING:], strict=True)
        return [lfrtorch.Record(*s, start="periodic", period=PERIOD, reference=q) for *s, q in made]
    made = zip(u, y, r, strict=True)
    return [lfrtorch.Record(*s, skip=SETTLING, reference=q) for *s, q in made]


def linear_fits(record: lfrtorch.Record) -> dict[str, Callable[[], Fitted]]:
    """The fits of a linear model."""
    plain = replace(record, reference=None, start="zero", period=None)

    def estimate(data: lfrtorch.Record, refine: Criterion | None = None) -> Fitted:
        return lfrtorch.estimate_bla(data, 2, refine=refine, feedthrough=False)

    return {
        "simulation": lambda: estimate(plain),
        "direct": lambda: estimate(plain, "prediction"),
        "indirect": lambda: estimate(record),
    }


def fitted(
    record: lfrtorch.Record,
    noise: Noise = "output",
    *,
    feedthrough=False,
) -> lfrtorch.Model:
    """An NL-LFR of the record, begun from the linear model."""
    refine = "simulation" if noise == "output" else "prediction"
    linear = lfrtorch.estimate_bla(record, 2, refine=refine, feedthrough=feedthrough)
    static = lfrtorch.Polynomial(1, 1, 3)
    start = lfrtorch.initialise(
        linear,
        record,
        nz=1,
        nw=1,
        static=static,
        z_feedthrough=feedthrough,
        feedthrough=feedthrough,
    )
    trainer = lfrtorch.LevenbergMarquardt(max_iter=30)
    return lfrtorch.fit(start, record, noise=noise, trainer=trainer, monitors=[]).model


def nonlinear_fits(record: lfrtorch.Record) -> dict[str, Callable[[], Fitted]]:
    """The fits of an NL-LFR."""
    plain = replace(record, reference=None)

    def indirect() -> lfrtorch.Model:
        if record.start == "periodic":
            return fitted(plain.mean_period())
        loop = replace(plain, u=record.reference, y=record.u)
        u = fitted(loop, feedthrough=True).simulate(loop)
        return fitted(replace(plain, u=u))

    unsettled = (
        plain if record.start != "periodic" else replace(plain, start="estimated", period=None)
    )
    return {
        "simulation": lambda: fitted(plain),
        "direct": lambda: fitted(unsettled, "innovation"),
        "indirect": indirect,
    }


def response(model: lfrtorch.LinearModel | lfrtorch.LFRCell) -> Complex:
    """Of a linear model, or the linear part of a cell, at ANGLES; no feedthrough."""
    if isinstance(model, lfrtorch.LinearModel):
        A, B, C = model.A, model.B, model.C
    else:
        A, B, C = (p.detach().numpy() for p in (model.A, model.Bu, model.Cy))
    z = np.exp(1j * ANGLES)[:, None, None]
    return np.asarray((C @ np.linalg.solve(z * np.eye(2) - A, B))[:, 0, 0], dtype=np.complex128)


def table(
    references: list[str], *, nonlinear: bool, decibels: list[float], runs: int, seed: int
) -> Iterator[tuple[str, float, str, float, float, float]]:
    """Reference, SNR and fit, then error, bias and standard error of the bias."""
    planted = system(nonlinear=nonlinear)
    u = np.random.default_rng(12345).standard_normal(2000)
    truth = planted.simulate(u) if nonlinear else response(planted.lfr.cell)
    for reference in references:
        for snr in decibels:
            records = measured(
                planted, level_of(planted, snr), runs, seed, periodic=reference == "periodic"
            )
            found: dict[str, list[Any]] = {}
            for record in records:
                fits = nonlinear_fits(record) if nonlinear else linear_fits(record)
                for name, fit in fits.items():
                    model = fit()
                    seen = (
                        model.simulate(u) if isinstance(model, lfrtorch.Model) else response(model)
                    )
                    found.setdefault(name, []).append(seen)
            scale = rms(np.abs(truth))
            for name, each in found.items():
                errors = np.array(each) - truth
                spread = rms(np.abs(errors - errors.mean(axis=0))) / np.sqrt(max(1, runs - 1))
                numbers = rms(np.abs(errors)), rms(np.abs(errors.mean(axis=0))), spread
                error, bias, standard = (float(number / scale) for number in numbers)
                yield reference, snr, name, error, bias, standard


def main() -> int:
    """The tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0, help="of the noise, the same at all levels")
    parser.add_argument("--decibels", type=float, nargs="*", default=[20.0, 10.0, 5.0])
    parser.add_argument("--references", nargs="*", default=["arbitrary", "periodic"])
    parser.add_argument("--only", nargs="*", default=["linear", "nonlinear"])
    options = parser.parse_args()
    for kind in options.only:
        print(
            f"\n| {kind}: reference | SNR (dB) | fit | error | bias | its standard error | ratio |"
        )
        print("|---" * 7 + "|")
        rows = table(
            options.references,
            nonlinear=kind == "nonlinear",
            decibels=options.decibels,
            runs=options.runs,
            seed=options.seed,
        )
        for reference, snr, name, error, bias, standard in rows:
            numbers = f"{error:.4f} | {bias:.4f} | {standard:.4f} | {bias / standard:.1f}"
            print(f"| {reference} | {snr:g} | {name} | {numbers} |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
