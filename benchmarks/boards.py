"""How settings of the mirror, the F-16 and EMPS do on estimation records that were left out.

    python benchmarks/boards.py --root DIR [--only mirror f16 emps]

Official test records are not looked at; ``boards.md`` has what it printed. Of the mirror two
realisations of each level are fitted and the other four are simulated: µm, mean over realisations,
periods and outputs. Of the F-16 the levels 1, 3 and 7 are fitted and level 5 is simulated: first
acceleration, m/s². Of EMPS three quarters are fitted, and the whole record is simulated from its
first samples: mm, in the quarter that was left out.
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

QUARTERS, STARTS = 4, 8
EMPS: tuple[tuple[Sizes, bool], ...] = (
    ((1, 1, 5), True),
    ((1, 1, 5), False),
    ((1, 2, 10), False),
)
"""nz, nw and nn; z_feedthrough."""


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


def of_emps(root: Path) -> tuple[Sequence[str], Iterable[Sequence[Any]]]:
    """Three quarters of the record: what is before that left out, and what is after it."""
    (whole,) = emps.load(root=root).train
    ends = np.linspace(0, whole.samples, QUARTERS + 1).astype(int)
    heads = "nz, nw, nn", "z_feedthrough", *(f"quarter {i + 1}" for i in range(QUARTERS))

    def left_out(settings: lfrtorch.Settings, quarter: int) -> float:
        first, last = ends[quarter], ends[quarter + 1]
        parts = [whole[a:b] for a, b in ((0, first), (last, whole.samples)) if a < b]
        train = [replace(p, start="estimated", name=f"part {i}") for i, p in enumerate(parts)]
        judged = [replace(p, skip=20, name=f"{p.name} from its first samples") for p in train]
        data = lfrtorch.Dataset("emps", train=train, validation=[], tests=[], selection=judged)
        model = fitted(data, settings)
        error = whole.y - model.simulate(replace(whole, start="estimated", skip=20))
        return 1e3 * float(np.sqrt(np.mean(np.square(error[first:last]))))

    def rows() -> Iterable[Sequence[Any]]:
        for sizes, z_feedthrough in EMPS:
            settings = lfrtorch.Settings(
                nx=2,
                **named(sizes),
                z_feedthrough=z_feedthrough,
                starts=STARTS,
                linear={"integrators": 1, "feedthrough": False},
                trainer=lfrtorch.LevenbergMarquardt(max_iter=60),
            )
            found = [left_out(settings, quarter) for quarter in range(QUARTERS)]
            yield of(sizes), z_feedthrough, *found

    return heads, rows()


BOARDS: dict[str, Callable[[Path], tuple[Sequence[str], Iterable[Sequence[Any]]]]] = {
    "mirror": of_mirror,
    "f16": of_f16,
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
