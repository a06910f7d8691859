"""Updates of a model with few data of a changed system, beside a fit to all of its data.

    python benchmarks/update.py [--root DIR] [--only hysteresis motor f16 pieces silence] [--show]

hysteresis   a Bouc-Wen system at 750 Hz, then another whose stiffness and hysteretic force are 20 %
             larger; noise of 8 µm; five multisines of 8192 samples of each
motor        a motor with friction at 500 Hz, then with a load: half as much inertia more, and a
             quarter more dry friction; noise of 1 % of the speed; 20 000 samples of each
f16          the F-16 shaken at the levels 1, 3 and 5, then at level 7: measured, with --root

Printed: the rms error on other data of the new system of the old model, of a model updated with 5 %
of the new data, and of the old model fitted to all of them; and that of the updated model on other
data of the old system, over that of the old model. Errors include the noise of the records.

pieces       the hysteresis: a model of 1000 samples, and 8 pieces of 500 samples more: one step of
             an update for each piece, beside an update with all of them, weight 1
silence      an update with data that tell nothing, an input of zeros: the rms step
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from copy import deepcopy
from typing import Any

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray

import lfrtorch
from lfrtorch import LevenbergMarquardt, Model, Record

PART = 0.05
SHOWN: list[bool] = []  # whether each update is printed
Array = NDArray[np.float64]


@njit
def hysteresis(u: Array, changed: float, h: float) -> Array:
    """Displacement of the Bouc-Wen system under a force held over each of ``h`` seconds."""
    m, c, k, alpha, beta, gamma, delta = 2.0, 10.0, 5e4 * changed, 5e4 * changed, 1e3, 0.8, -1.1
    x, v, z, y = 0.0, 0.0, 0.0, np.empty(len(u))
    for i in range(len(u)):
        y[i] = x
        for _ in range(20):
            v += h / 20 * (u[i] - c * v - k * x - z) / m
            x += h / 20 * v
            z += h / 20 * (alpha * v - beta * (gamma * abs(v) * z + delta * v * abs(z)))
    return y


@njit
def motor(u: Array, changed: float, h: float) -> Array:
    """Speed of a motor under a voltage held over each of ``h`` seconds."""
    J, dry, v, y = 0.005 * changed, 0.5 * (0.5 + 0.5 * changed), 0.0, np.empty(len(u))
    for i in range(len(u)):
        y[i] = v
        for _ in range(20):
            v += h / 20 * (0.5 * u[i] - 0.05 * v - dry * np.tanh(v / 0.5)) / J
    return y


def of_hysteresis(seed: int, changed: float, samples: int = 8192) -> Record:
    """A multisine of 50 N, 5 to 150 Hz; the second of two periods."""
    u = lfrtorch.multisine(samples, band=(5.0, 150.0), fs=750.0, rms=50.0, seed=seed).u[0, :, 0]
    y = hysteresis(np.tile(u, 3), changed, 1 / 750)[2 * samples :]
    y = y + 8e-6 * np.random.default_rng(seed).standard_normal(samples)
    return Record(u, y, fs=750.0, name=f"record {seed}", start="periodic")


def of_motor(seed: int, changed: float, samples: int = 20_000) -> Record:
    """Random levels of a voltage, each held for 0.1 s, from rest."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-12, 12, samples // 50), 50)
    y = motor(u, changed, 1 / 500)
    y = y + 0.01 * y.std() * rng.standard_normal(samples)
    return Record(u, y, fs=500.0, name=f"record {seed}", start="zero", skip=100)


def error(model: Model, records: Sequence[Record]) -> float:
    """The rms error over records of one length."""
    return float(np.sqrt(np.mean([lfrtorch.rmse(r, model.simulate(r)) ** 2 for r in records])))


def fitted(train: Sequence[Record], validation: Sequence[Record], **sizes: Any) -> Model:
    """The model of the old system."""
    data = lfrtorch.Dataset("old", list(train), list(validation), [])
    settings = lfrtorch.Settings(
        **{"starts": 4, "refit": False, "trainer": LevenbergMarquardt(max_iter=100), **sizes}
    )
    return lfrtorch.identify(data, settings, observer=lfrtorch.Observer()).model


def pair(
    name: str,
    old: Model,
    new: Sequence[Record],
    parts: Sequence[Record],
    old_tests: Sequence[Record],
    new_tests: Sequence[Record],
) -> None:
    """Print the errors of one pair of systems, for several parts of the new data."""
    whole = deepcopy(old)
    lfrtorch.fit(whole, new, trainer=LevenbergMarquardt(max_iter=30), monitors=[])
    full, before = error(whole, new_tests), error(old, new_tests)
    for part in parts:
        clock = time.perf_counter()
        result = lfrtorch.update(old, part)
        seconds = time.perf_counter() - clock
        after = error(result.model, new_tests)
        if SHOWN:
            print(result)
        kept = error(result.model, old_tests) / error(old, old_tests)
        print(
            f"{name:12} {before:.4g} -> {after:.4g}, all data {full:.4g}: ratio {after / full:.3f};"
            f" old data {kept:.3f}; weight {result.weight:g}; {seconds:.1f} s", flush=True
        )  # fmt: skip


def cut(record: Record, first: int, samples: int) -> Record:
    """A stretch of a record that begins in an unknown state."""
    u, y = record.u[first : first + samples], record.y[first : first + samples]
    return Record(
        u, y, fs=record.fs, name="part", start="estimated", inputs=record.inputs,
        outputs=record.outputs,
    )  # fmt: skip


def hysteresis_pair() -> None:
    """Another stiffness."""
    old = [of_hysteresis(s, 1.0) for s in range(4)]
    new = [of_hysteresis(s, 1.2) for s in range(10, 17)]
    model = fitted(old[:2], old[2:3], nx=3, nz=3, nw=3, nn=10)
    count = int(PART * 5 * 8192)
    parts = [cut(new[s], 1000, count) for s in range(3)]
    pair("hysteresis", model, new[:5], parts, old[3:], new[5:])


def motor_pair() -> None:
    """Another load."""
    old, new = ([of_motor(s + at, j) for s in range(3)] for at, j in ((0, 1.0), (10, 1.5)))
    model = fitted(old[:1], old[1:2], nx=1, nz=1, nw=1, nn=6)
    parts = [cut(new[0], at, int(PART * 20_000)) for at in (2000, 9000, 15_000)]
    pair("motor", model, new[:1], parts, old[2:], new[1:])


def f16_pair(root: str) -> None:
    """The highest level, which no old record has."""
    low = ("multisine_1", "multisine_3", "multisine_5")
    load = lfrtorch.datasets.f16.load
    old = load(train=low, validation=("sweep_3", "multisine_7", "sweep_7"), root=root)
    slow, new, fast = old.validation
    model = fitted(
        old.train, [slow], nx=14, modes=6, nz=2, nw=2, nn=15, starts=1,
        trainer=LevenbergMarquardt(max_iter=40),
    )  # fmt: skip
    parts = [cut(new, at, int(PART * new.samples)) for at in (8192, 30_000, 50_000)]
    pair("f16", model, [new], parts[:2], old.train, [fast])


def pieces() -> None:
    """Data that come piece by piece."""
    old, new = of_hysteresis(0, 1.0), of_hysteresis(1, 1.0)
    tests = [of_hysteresis(2, 1.0)]
    model = fitted([cut(old, 0, 1000)], [], nx=3, nz=3, nw=3, nn=5)
    cuts = [cut(new, 500 * i, 500) for i in range(8)]
    whole = lfrtorch.update(model, cuts, weight=1.0).model
    step = model
    for each in cuts:
        step = lfrtorch.update(step, each, weight=1.0, trainer=LevenbergMarquardt(max_iter=1)).model
    first, one, many = (error(m, tests) for m in (model, whole, step))
    print(f"pieces       {first:.4g} -> {many:.4g}, all at once {one:.4g}: {many / one:.3f}")


def silence() -> None:
    """Data without information."""
    model = fitted([of_hysteresis(0, 1.0)], [of_hysteresis(1, 1.0)], nx=3, nz=3, nw=3, nn=10)
    noise = 8e-6 * np.random.default_rng(9).standard_normal(2000)
    still = Record(np.zeros(2000), noise + model.simulate(np.zeros(2000))[:, 0], fs=750.0)
    result = lfrtorch.update(model, still)
    step, _ = result.steps["all"]
    print(f"silence      weight {result.weight:g}; rms step {step:.4f} standard errors")


CASES: dict[str, Callable[[], None]] = {
    "hysteresis": hysteresis_pair, "motor": motor_pair, "pieces": pieces, "silence": silence
}  # fmt: skip


def main() -> None:
    """Run the cases."""
    parser = argparse.ArgumentParser(description=str(__doc__).split("\n", maxsplit=1)[0])
    parser.add_argument("--root", help="folder of the benchmarks' files, for f16")
    parser.add_argument("--only", nargs="*", default=[*CASES, "f16"])
    parser.add_argument("--show", action="store_true", help="print each update")
    given = parser.parse_args()
    SHOWN.extend([True] * given.show)
    torch.set_num_threads(2)
    for name in given.only:
        if name in CASES:
            CASES[name]()
        elif given.root:
            f16_pair(given.root)


if __name__ == "__main__":
    main()
