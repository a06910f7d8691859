"""How settings of the mirror, the F-16 and EMPS do on estimation records that were left out.

    python benchmarks/boards.py --root DIR [--only mirror f16 drift emps]

Official test records are not looked at; ``boards.md`` has what it printed. Of the mirror two
realisations of each level are fitted and the other four are simulated: µm, mean over realisations,
periods and outputs. Of the F-16 the levels 1, 3 and 7 are fitted and level 5 is simulated: first
acceleration, m/s². Drift: the mean input of EMPS at its highest speed ahead and back in each of
four motions, half their sum (offset) and half their difference (size of the friction), mV. Of EMPS
the first half or three quarters are fitted, and all of it is simulated
from its beginning: mm, in the quarters that were left out, with the input as it is and 10 mV off.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import lfrtorch
import lfrtorch.known_systems
from lfrtorch.datasets import emps, f16, fine_steering_mirror

Sizes = tuple[int, ...]

MIRROR_ITERATIONS = 15
MIRROR: tuple[Sizes, ...] = (
    (4, 4, 20, 0),
    (12, 8, 30, 0),
    (12, 8, 30, 6),
)
"""nz, nw, nn and relaxations."""

F16_ITERATIONS = 60
F16: tuple[Sizes, ...] = ((2, 2, 15, 0), (2, 2, 15, 6))
"""nz, nw, nn and modes."""

MOTION, FAST = 6240, 0.124
"""Samples of a motion of EMPS; speed above which it counts as the highest, m/s."""

EMPS: tuple[tuple[str, float, float], ...] = (
    ("emps_known", 0.0, 10.0),
    ("emps", 0.01, 1.0),
    ("emps", 0.01, 100.0),
)
"""Name of the bench, shift of the input (V), ridge."""


def main() -> int:
    """The tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--root", type=Path, required=True, help="of the official files")
    parser.add_argument("--only", nargs="*", choices=BOARDS, default=list(BOARDS))
    options = parser.parse_args()
    for name in options.only:
        heads, rows = BOARDS[name](options.root)
        print(f"\n{name}\n\n| {' | '.join(heads)} |\n{'|---' * len(heads)}|")
        for row in rows:
            print("|", " | ".join(f"{c:.3f}" if isinstance(c, float) else str(c) for c in row), "|")
            sys.stdout.flush()
    return 0


def of_mirror(root: Path) -> tuple[Sequence[str], Iterable[Sequence[Any]]]:
    """All levels, two realisations of each."""
    data = fine_steering_mirror.load(root=root, validation=4)
    levels = fine_steering_mirror.LEVELS
    heads = "nz, nw, nn", "relaxations", "net parameters", *(f"{a} mV" for a in levels)

    def errors(model: lfrtorch.Model) -> list[float]:
        each = {record.name: error_of(model, record) for record in data.validation}
        grouped = ([each[name] for name in data.groups[f"validation_{a}"]] for a in levels)
        return [1e6 * float(np.mean(found)) for found in grouped]

    def rows() -> Iterable[Sequence[Any]]:
        for *sizes, relaxations in MIRROR:
            settings = lfrtorch.Settings(
                nx=28,
                **named(sizes),
                relaxations=relaxations,
                trainer=lfrtorch.LevenbergMarquardt(max_iter=MIRROR_ITERATIONS),
            )
            model = fitted(data, settings)
            net = model.net_parameter_count
            yield of(sizes), relaxations, net, *errors(model)

    return heads, rows()


def of_f16(root: Path) -> tuple[Sequence[str], Iterable[Sequence[Any]]]:
    """Multisines of three levels."""
    data = f16.load(
        root=root,
        train=[f"multisine_{n}" for n in (1, 3, 7)],
        validation=["multisine_5", "sweep_5"],
    )
    heads = "nz, nw, nn", "modes", "net parameters", *(r.name for r in data.validation)

    def rows() -> Iterable[Sequence[Any]]:
        for *sizes, modes in F16:
            settings = lfrtorch.Settings(
                nx=14,
                **named(sizes),
                modes=modes,
                trainer=lfrtorch.LevenbergMarquardt(max_iter=F16_ITERATIONS),
            )
            model = fitted(data, settings)
            found = [float(error_of(model, record)[0]) for record in data.validation]
            yield of(sizes), modes, model.net_parameter_count, *found

    return heads, rows()


def of_drift(root: Path) -> tuple[Sequence[str], Iterable[Sequence[Any]]]:
    """The input at the highest speed, in each motion."""
    (record,) = emps.load(root=root).train
    u, y = record.u[50:-50, 0], record.y[:, 0]
    speed = (y[100:] - y[:-100]) * record.fs / 100
    heads = "motion", "ahead", "back", "offset", "friction"

    def rows() -> Iterable[Sequence[Any]]:
        for number in range(4):
            part = slice(number * MOTION, (number + 1) * MOTION)
            ahead, back = (1e3 * float(u[part][way * speed[part] > FAST].mean()) for way in (1, -1))
            yield number + 1, ahead, back, (ahead + back) / 2, (ahead - back) / 2

    return heads, rows()


def of_emps(root: Path) -> tuple[Sequence[str], Iterable[Sequence[Any]]]:
    """The first part of the record: what follows, simulated from the beginning of the record."""
    (whole,) = emps.load(root=root).train
    parts, shifts = (whole.samples // 2, 3 * whole.samples // 4), (0.0, -0.01, 0.01)
    heads = "bench", "shift, V", "ridge", "seed", "rest after 1/2", "rest after 3/4"

    def left_out(settings: lfrtorch.Settings, drift: float, samples: int) -> str:
        part = whole[:samples]
        copies = [part, *(replace(part, u=part.u + d, name=f"{d:g}") for d in (drift, -drift) if d)]
        model = fitted(lfrtorch.Dataset("emps", copies, validation=[], tests=[]), settings)
        shifted = [replace(whole, u=whole.u + shift, skip=samples) for shift in shifts]
        return ", ".join(f"{1e3 * error_of(model, record)[0]:.2f}" for record in shifted)

    def rows() -> Iterable[Sequence[Any]]:
        trainer = lfrtorch.LevenbergMarquardt(max_iter=60)
        alone: dict[str, Any] = {"nx": 0, "nz": 1, "nw": 1, "nn": 4, "horizon": 3000, "starts": 3}
        beside: dict[str, Any] = {"nx": 1, "nz": 3, "nw": 3, "nn": 8, "starts": 4}
        for name, drift, ridge in EMPS:
            sizes = {**(beside if drift else alone), "ridge": ridge, "trainer": trainer}
            for seed in (0, 1) if drift else (0,):
                known = lfrtorch.known_systems.emps(free=drift > 0)
                settings = lfrtorch.Settings(known=known, seed=seed, **sizes)
                found = [left_out(settings, drift, samples) for samples in parts]
                yield name, drift, ridge, seed, *found

    return heads, rows()


BOARDS: dict[str, Callable[[Path], tuple[Sequence[str], Iterable[Sequence[Any]]]]] = {
    "mirror": of_mirror,
    "f16": of_f16,
    "drift": of_drift,
    "emps": of_emps,
}


def fitted(data: lfrtorch.Dataset, settings: lfrtorch.Settings) -> lfrtorch.Model:
    """The model of one run, of which nothing is printed."""
    return lfrtorch.identify(data, settings, observer=lfrtorch.Observer()).model


def error_of(model: lfrtorch.Model, record: lfrtorch.Record) -> Any:
    """RMSE of each output."""
    error = (record.y - model.simulate(record))[record.skip :]
    return np.sqrt(np.mean(np.square(error), axis=0))


def named(sizes: Sequence[int]) -> dict[str, Any]:
    """Sizes of the static map."""
    return dict(zip(("nz", "nw", "nn"), sizes, strict=True))


def of(sizes: Sequence[int]) -> str:
    """Sizes as a cell of a table."""
    return ", ".join(map(str, sizes))


if __name__ == "__main__":
    sys.exit(main())
